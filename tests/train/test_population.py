"""Several followers in one program: each is its own run, the best is exported, settings may differ."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import toys
from command_line import HASTY
from conftest import with_settings

from mjxball.commands.train import main as train
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.evaluate.scenarios import standard_scenarios
from mjxball.policy import Policy
from mjxball.policy.file import load_file
from mjxball.train import program as programs
from mjxball.train.curves import best_member, read_members
from mjxball.train.extensions import Extensions
from mjxball.train.population import Population, partitioned_by_gspmd
from mjxball.train.run_directory import read_sweep

REPOSITORY = Path(__file__).parents[2]
SMALL = {
    "num_envs": 8,
    "replay_size": 800,
    "batch_size": 16,
    "policy_layers": (8,),
    "critic_layers": (8,),
    "updates_per_step": 1,
    "total_steps": 4000,
    "warmup_steps": 100,
}
FLAGS = [word for name, value in SMALL.items() for word in (f"--sac.{name}", str(value).strip("(),"))]
FLAGS += ["--physics", "newton-euler", "--timing.episode_steps", "60"]
POINT = Extensions(toys.DoubleIntegrator)


@pytest.fixture(scope="module")
def small(transport: Config) -> Config:
    return with_settings(transport, sac=SMALL)


@pytest.fixture(scope="module")
def together(small: Config) -> tuple[Population, Any, Any]:
    """Two members, and what they are after 5 and 20 steps of training, on what compiles soonest."""
    population = Population(small, "newton-euler", 2, extensions=POINT)
    compiled = population.compile(creating=True)
    state, *_ = population.advance(compiled, population.start(compiled, 5), programs.warmup_mode(10))
    state, *_ = population.advance(compiled, state, programs.train_mode(5))
    early = jax.tree.map(np.array, state)  # its memory is given away
    return population, early, population.advance(compiled, state, programs.train_mode(15))[0]


@pytest.mark.slow
def test_members_are_the_runs_of_their_seeds(small: Config, together: tuple[Population, Any, Any]) -> None:
    population, _, late = together
    single = Population(small, "newton-euler", extensions=POINT)
    compiled = single.compile(creating=True)
    for member in range(2):
        state, *_ = single.advance(compiled, single.start(compiled, 5 + member), programs.warmup_mode(10))
        alone, *_ = single.advance(compiled, state, programs.train_mode(20))
        mine = population.member(late, member)
        for a, b in zip(
            jax.tree.leaves(mine.algorithm.learner.policy), jax.tree.leaves(alone.algorithm.learner.policy), strict=True
        ):
            # Batched matrix products may round differently; 20 updates amplify that a little.
            np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.slow
def test_training_that_pauses_goes_on_bit_for_bit(together: tuple[Population, Any, Any]) -> None:
    population, early, late = together
    compiled, asked = population.compile(creating=False), []

    def pause() -> bool:
        asked.append(1)
        return len(asked) == 4

    state, _, _, taken = population.advance(compiled, early, programs.train_mode(15), pause)
    assert taken == len(asked) == 4
    state, _, _, taken = population.advance(compiled, state, programs.train_mode(11), lambda: False)
    assert taken == 11
    jax.tree.map(np.testing.assert_array_equal, state, late)


@pytest.mark.slow
def test_swept_settings_differ_between_members_and_between_traced_programs(
    small: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The swept numbers are constants in the traced program: the cache must tell them apart."""
    monkeypatch.setattr("mjxball.train.compilation.traced_directory", lambda: tmp_path)
    moved = []
    for rates in ([1e-6, 1e-2], [1e-2, 1e-6], [1e-2, 1e-6]):
        population = Population(small, "newton-euler", 2, {"sac.learning_rate": rates})
        assert [population.member_config(k).sac.learning_rate for k in (0, 1)] == rates
        compiled = population.compile(creating=True)
        state = population.start(compiled, 5)
        before = np.asarray(jax.tree.leaves(state.algorithm.learner.policy)[-1])
        state, *_ = population.advance(compiled, state, programs.warmup_mode(10))
        state, *_ = population.advance(compiled, state, programs.train_mode(20))
        moved.append(np.abs(np.asarray(jax.tree.leaves(state.algorithm.learner.policy)[-1]) - before).max(axis=(1, 2)))
    # No traced program says which files of Python made it: XLA would print them all.
    assert not any(b".py" in path.read_bytes() for path in tmp_path.iterdir())
    (still, quick), (quick_too, still_too) = moved[:2]
    assert max(still, still_too) < 1e-4  # 20 steps of 1e-6
    assert min(quick, quick_too) > 1e-2  # 20 steps of 1e-2
    np.testing.assert_array_equal(moved[1], moved[2])  # the third comes from the cache
    assert len(list(tmp_path.glob("update-*"))) == 2


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("{", "cannot be read"),
        ("[]", "object"),
        ("{}", "object"),
        ('{"sac.batch_size": [1, 2]}', "cannot differ"),
        ('{"sac.discount": [0.9]}', "2 numbers"),
        ('{"sac.discount": [0.9, 1.5]}', "not 1.5"),
        ('{"sac.discount": [0.9, "x"]}', "numbers"),
    ],
)
def test_unsound_sweeps_are_refused(small: Config, tmp_path: Path, content: str, word: str) -> None:
    path = tmp_path / "sweep.json"
    path.write_text(content)
    with pytest.raises(InputError, match=word):
        read_sweep(path, 2, small)


def test_best_member_has_the_highest_finite_return_of_the_last_evaluation() -> None:
    rows = [
        {"steps": 1, "eval_return": 9.0},
        {"steps": 1, "eval_return": 0.0},
        {"steps": 2, "eval_return": float("nan")},
        {"steps": 2, "eval_return": -5.0},
    ]
    assert best_member(rows) == 1
    assert best_member([]) == 0


@pytest.mark.slow
def test_population_run_exports_every_member_and_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Judged by one flight that is just long enough for peaks."""
    shortened = lambda settings: (dataclasses.replace(standard_scenarios(settings)[0], seconds=21.0),)  # noqa: E731
    monkeypatch.setattr("mjxball.commands.compare.standard_scenarios", shortened)
    out, sweep = tmp_path / "run", tmp_path / "sweep.json"
    sweep.write_text(json.dumps({"follower.action_scale_tilt": [0.1, 0.2]}))
    assert train([*FLAGS, "--seeds", "2", "--seed", "7", "--sweep", str(sweep), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "seed7" in printed
    assert "x_peak: median" in printed
    members = [Policy.load(out / "members" / f"seed{seed}.npz") for seed in (7, 8)]
    assert [member.metadata["action_reach"][0] for member in members] == [0.1, 0.2]
    best = best_member(read_members(out))
    exported, own = load_file(out / "policy.npz"), load_file(out / "members" / f"seed{7 + best}.npz")
    for mine, theirs in zip(exported.weights, own.weights, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    spread = exported.metadata.pop("population")
    assert exported.metadata == own.metadata
    assert spread["seed"] == [7, 8]
    assert len(spread["x_peak"]) == len(spread["rmse"]) == 2
    assert own.metadata["curve"]["eval_return"][-1] == pytest.approx(
        max(row["eval_return"] for row in read_members(out) if row["steps"] == own.metadata["training_steps"]), abs=1e-3
    )
    assert own.metadata["hardware"].endswith(" CPU cores")
    assert (out / "eval" / "members.png").stat().st_size > 10_000
    assert train(["--resume", str(out)]) == 0


@pytest.mark.slow
def test_members_are_spread_over_devices(together: tuple[Population, Any, Any], tmp_path: Path) -> None:
    """Two CPU devices in a process of their own: the same members as on one, up to rounding."""
    code = f"""
import sys, jax, numpy as np
sys.path.append({str(REPOSITORY / "tests")!r})
import toys
from mjxball import config as C
from mjxball.train.extensions import Extensions
from mjxball.train.population import Population
from mjxball.train import program as P
config = C.preset("transport")
for name, value in {SMALL!r}.items():
    config = C.replace(config, "sac." + name, value)
point = Extensions(toys.DoubleIntegrator)
population = Population(config, "newton-euler", 2, extensions=point)
assert population.devices == jax.local_device_count() == 2
compiled = population.compile(creating=True)
state, *_ = population.advance(compiled, population.start(compiled, 5), P.warmup_mode(10))
state, *_ = population.advance(compiled, state, P.train_mode(5))
leaves = jax.tree.leaves(state.algorithm.learner.policy)
assert len(leaves[0].sharding.device_set) == 2
assert Population(config, "newton-euler", 2, devices=jax.local_devices()[:1], extensions=point).devices == 1
np.savez({str(tmp_path / "spread.npz")!r}, *map(np.asarray, leaves))
"""
    flags = f"{HASTY} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    population, alone, _ = together
    assert population.devices == 1
    with np.load(tmp_path / "spread.npz") as spread:
        leaves = jax.tree.leaves(alone.algorithm.learner.policy)
        assert len(spread.files) == len(leaves)
        for name, expected in zip(spread.files, leaves, strict=True):
            np.testing.assert_allclose(spread[name], expected, atol=1e-5)


@pytest.mark.parametrize("spread", [True, False])
def test_only_what_is_spread_over_devices_is_left_to_gspmd(spread: bool) -> None:
    mesh, before = jax.make_mesh((1,), ("members",)), jax.config.jax_use_shardy_partitioner
    with partitioned_by_gspmd(mesh if spread else None):
        inside = jax.config.jax_use_shardy_partitioner
    assert (inside, jax.config.jax_use_shardy_partitioner) == (before and not spread, before)
