"""The mean of policies that began as one."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from mjxball import export
from mjxball.errors import InputError
from mjxball.policy import PolicyFile, load_file
from mjxball.policy.file import save_file, shipped_policy
from mjxball.policy.mean import mean_policy


def trained_on(policy: PolicyFile, seed: int, **changes: object) -> PolicyFile:
    """`policy` with other weights."""
    random = np.random.default_rng(seed)
    weights, biases = (
        tuple((array + 0.1 * random.standard_normal(array.shape)).astype(np.float32) for array in arrays)
        for arrays in (policy.weights, policy.biases)
    )
    card = {**policy.card, "seed": seed, "curve": {"steps": [seed]}, "population": {"seed": [seed]}}
    return dataclasses.replace(policy, weights=weights, biases=biases, card=card, **changes)


@pytest.fixture
def start() -> PolicyFile:
    return load_file(shipped_policy("balance"))


def test_weights_and_biases_are_means(start: PolicyFile) -> None:
    made = [trained_on(start, seed) for seed in (3, 4, 9)]
    found = mean_policy(made)
    for part in ("weights", "biases"):
        for layer, array in enumerate(getattr(found, part)):
            assert array.dtype == np.float32
            wanted = sum(getattr(one, part)[layer].astype(np.float64) for one in made) / 3
            np.testing.assert_allclose(array, wanted, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(found.observation_scale, start.observation_scale)
    assert found.card["mean_of_seeds"] == [3, 4, 9]
    assert not {"seed", "curve", "population"} & found.card.keys()


def test_policies_that_began_apart_have_no_mean(start: PolicyFile) -> None:
    apart = trained_on(start, 1, observation_mean=start.observation_mean + np.float32(0.01))
    with pytest.raises(InputError, match="did not begin as one"):
        mean_policy([start, apart])
    with pytest.raises(InputError, match="other layers"):
        mean_policy([start, load_file(shipped_policy("transport"))])


def test_command_line(start: PolicyFile, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    members = tmp_path / "run" / "members"
    members.mkdir(parents=True)
    out = tmp_path / "mean.npz"
    for wrong in ("holds no population", "two policies or more"):
        assert export.main([str(tmp_path / "run"), str(out), "--mean"]) == 2
        assert wrong in capsys.readouterr().err
        assert not out.exists()
        save_file(members / "seed10.npz", trained_on(start, 10))
    save_file(members / "seed2.npz", trained_on(start, 2))
    assert export.main([str(tmp_path / "run"), str(out), "--mean"]) == 0
    with np.load(out) as arrays:
        assert json.loads(str(arrays["card"]))["mean_of_seeds"] == [2, 10]
