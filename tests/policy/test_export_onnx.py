"""ONNX models beside observations that cannot be, as NumPy and C refuse them: one flight, and several in a batch."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from conftest import Recurrent, noticing_stale, with_repeats
from tables import rows

from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import interface_of, shipped_policy
from mjxball.policy.formats.onnx_model import onnx_model

# Without a memory, with averages of what was seen, with a GRU, and with one that is told its team.
POLICIES = ("paper", "flight", "balance", "universal")
SPOILT = [(value, slot) for value in (np.nan, np.inf, -np.inf, 3e38, 1e6) for slot in range(18)]


def contents_of(name: str) -> PolicyFile:
    contents = load_file(shipped_policy(name))
    return in_team(contents, name, Path("pair")) if name == "universal" else contents


class Model:
    """Flights of a batch on an ONNX model, which is fed its own memory; `start` until a row is valid."""

    def __init__(self, contents: PolicyFile):
        self.size = interface_of(contents.metadata).size
        self.session = onnxruntime.InferenceSession(onnx_model(contents, "follower").SerializeToString())
        self.names = [item.name for item in self.session.get_outputs()]

    def answer(self, seen: np.ndarray, memory: np.ndarray, start: np.ndarray) -> dict[str, np.ndarray]:
        feed: dict[str, np.ndarray] = {"observation": seen.astype(np.float32)}
        feed |= {"memory": memory.astype(np.float32), "start": start} if self.size else {}
        return dict(zip(self.names, self.session.run(None, feed), strict=True))

    def fly(self, flight: np.ndarray) -> dict[str, np.ndarray]:
        """Outputs (T, N, ...) at observations (T, N, 18); the first memory is not to be read."""
        memory, start = np.full((flight.shape[1], self.size), np.nan), np.ones((flight.shape[1], 1), bool)
        found = []
        for seen in flight:
            found.append(self.answer(seen, memory, start))
            memory, start = found[-1].get("next_memory", memory), start & ~found[-1]["valid"]
        return {name: np.array([one[name] for one in found]) for name in self.names}


def walk(steps: int, count: int) -> np.ndarray:
    return np.cumsum(np.random.default_rng(7).normal(scale=0.02, size=(steps, count, 18)), axis=0).astype(np.float32)


@rows("name", POLICIES)
def test_an_observation_that_cannot_be_leaves_no_trace(name: str):
    """At a start and between sound ones: its row says so, is level, and flies on as without; others notice nothing."""
    contents, bad = contents_of(name), np.arange(2 * len(SPOILT)) % 2 == 0
    model, alone = Model(contents), Policy(contents, name)
    assert model.fly(walk(2, 0))["command"].shape == (2, 0, 3)
    for count in (1, 4):
        flight, row = walk(len(bad), count), count // 2
        others, spoilt = np.arange(count) != row, flight.copy()
        for step, (value, slot) in zip(np.flatnonzero(bad), SPOILT, strict=True):
            spoilt[step, row, slot] = value
            with pytest.raises(InputError):
                alone(spoilt[step, row])
        calm, without, found = model.fly(flight), model.fly(flight[~bad]), model.fly(spoilt)
        assert calm["valid"].all()
        np.testing.assert_array_equal(found["valid"][:, row, 0], ~bad)
        for label, values in found.items():
            np.testing.assert_array_equal(values[:, others], calm[label][:, others])
            np.testing.assert_array_equal(values[~bad, row], without[label][:, row])
            assert np.isfinite(values).all()
            assert not values[bad, row].any() or label == "next_memory"
        assert list(found) == ["action", "command", *(["next_memory"] if model.size else []), "valid"]
        if model.size:
            np.testing.assert_array_equal(found["next_memory"][2::2, row], found["next_memory"][1:-1:2, row])


@rows("name", ("recurrent", "paper", "stand", "balance-sac"))  # none of which observes it
def test_a_repeated_measurement_is_noticed_as_by_policy(name: str, recurrent: Recurrent):
    """Each row by itself: of two flights one has repeats, and an observation that cannot be before each."""
    plain = recurrent.contents if name == "recurrent" else contents_of(name)
    contents = noticing_stale(plain)
    seen, repeats = with_repeats(walk(48, 1)[:, 0])
    between = np.insert(seen, np.flatnonzero(repeats), np.nan, axis=0)
    bad, fresh = np.isnan(between[:, 0]), walk(len(between), 1)[:, 0]
    found = Model(contents).fly(np.stack([between, fresh], axis=1))
    assert Model(contents).fly(walk(2, 0))["command"].shape == (2, 0, 3)
    np.testing.assert_array_equal(found["valid"][..., 0], np.stack([~bad, np.ones_like(bad)], axis=1))
    policy, unaware = Policy(contents, name), Policy(plain, name)
    wanted = np.array([policy(one) for one in seen])
    assert np.abs(wanted - [unaware(one) for one in seen])[repeats].max(axis=1).min() > 1e-4
    np.testing.assert_allclose(found["command"][~bad, 0], wanted, rtol=0, atol=2e-5)
    policy.reset(), unaware.reset()
    other = np.array([policy(one) for one in fresh])
    np.testing.assert_allclose(other, [unaware(one) for one in fresh], rtol=0, atol=2e-5)
    np.testing.assert_allclose(found["command"][:, 1], other, rtol=0, atol=2e-5)


@rows("name", POLICIES[1:])
def test_a_memory_that_cannot_be_is_forgotten(name: str):
    """Level, and the next step is that of a flight that has begun there; `start` that was not held does no harm."""
    model, seen = Model(contents_of(name)), walk(4, 2)
    begun = model.answer(seen[0], np.zeros((2, model.size)), np.ones((2, 1), bool))
    memory, going = begun["next_memory"], np.zeros((2, 1), bool)
    calm = model.answer(seen[1], memory, going)
    for value in (np.nan, np.inf, -np.inf):
        for slot in (0, model.size - 1):
            spoilt = memory.copy()
            spoilt[0, slot] = value
            found = model.answer(seen[1], spoilt, going)
            assert found["valid"].tolist() == [[False], [True]]
            assert not found["command"][0].any()
            for label, values in found.items():
                np.testing.assert_array_equal(values[1], calm[label][1])
            after = model.answer(seen[1], found["next_memory"], going)
            wanted = model.answer(seen[1], memory, ~going)
            assert after["valid"].all()
            np.testing.assert_array_equal(after["command"][0], wanted["command"][0])
    first = model.answer(np.full((2, 18), np.nan), memory * np.nan, ~going)
    assert model.answer(seen[1], first["next_memory"], going)["valid"].all()


def test_the_bound_is_numpys_and_a_network_without_an_answer_says_so():
    contents = contents_of("stand")
    model, start = Model(contents), np.ones((1, 1), bool)
    for size, good in ((5.5e4, True), (5.6e4, False)):  # 18 of them below and above 1e6
        found: dict[str, Any] = model.answer(np.full((1, 18), size), np.zeros((1, model.size)), start)
        assert found["valid"].tolist() == [[good]]
        assert bool(found["command"].any()) == good
        if good:
            np.testing.assert_allclose(found["command"][0], Policy(contents, "one")(np.full(18, size)), atol=1e-5)
    huge = tuple(np.full_like(weight, 3e37) * np.sign(weight) for weight in contents.weights)
    broken = Model(dataclasses.replace(contents, weights=huge)).fly(walk(4, 2))
    assert not broken["valid"].any()
    assert not broken["command"].any()
    assert np.isfinite(broken["next_memory"]).all()
