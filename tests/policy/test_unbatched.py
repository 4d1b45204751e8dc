"""One observation at a time, a policy answers and remembers what the law of arrays does."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Recurrent

from mjxball.cli import plant_setup
from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import law_of, shipped_policy
from mjxball.policy.inference import NetworkLaw
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

UNIVERSAL = load_file(shipped_policy("universal"))
SEEN = np.random.default_rng(7).normal(scale=0.3, size=(2, 18))
TEAMS = {"pair": None, "team3": 1, "team4": 3, "plate4": 2, "team6": 4}  # plant: which of its followers


class Reference:
    """The law of arrays, step by step."""

    def __init__(self, policy: Policy):
        self.law, self.memory = NetworkLaw(policy), None

    def __call__(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(action, command)."""
        if self.memory is None:
            self.memory = self.law.start(observation)
        action, command, self.memory = self.law.answer(self.memory, observation)
        return action, command


def told(plant: str, dtype: type = np.float64, contents: PolicyFile = UNIVERSAL) -> tuple[Policy, Reference]:
    """A policy that is told its team, and what it must do."""
    policy = Policy(in_team(contents, "universal", Path(plant), TEAMS[plant]), "universal", dtype)
    return policy, Reference(policy)


def walk(steps: int, seed: int = 0, size: float = 0.03) -> np.ndarray:
    """Observations (T, 18) that change by `size` in a step."""
    random = np.random.default_rng(seed)
    return np.cumsum(size * random.standard_normal((steps, 18)), axis=0) + 0.3 * random.standard_normal(18)


def agree(
    policy: Policy, reference: Reference, flight: np.ndarray, tolerance: float = 1e-9, remembered: float = 1e-9
) -> None:
    """`policy` commands and remembers what `reference` does, in every step of a `flight` (T, 18)."""
    for seen in flight.astype(policy._dtype):
        wanted, found = reference(seen)[1], policy(seen)
        assert (found.shape, found.dtype) == ((3,), seen.dtype)
        np.testing.assert_allclose(found, wanted, tolerance, tolerance)
        np.testing.assert_allclose(policy.memory, reference.memory, remembered, remembered)


@pytest.mark.parametrize("plant", TEAMS)
@pytest.mark.parametrize("size", [1e-3, 0.03, 3.0])
def test_it_is_the_law_of_arrays(plant: str, size: float) -> None:
    policy, reference = told(plant)
    agree(policy, reference, walk(300, size=size))
    assert policy._ahead  # none of these were answered by the law of arrays


@pytest.mark.parametrize("name", ["flight", "robust", "transport"])
def test_of_a_network_without_a_gru(name: str) -> None:
    policy = Policy(load_file(shipped_policy(name)), name, np.float64)
    agree(policy, Reference(policy), walk(300))
    assert policy._ahead


@pytest.mark.parametrize("plant", ["pair", "team4"])
def test_of_a_flight_it_is_the_law_of_arrays_as_rounded(plant: str) -> None:
    """In float32 the law of arrays rounds what this does not, which a GRU feeds back."""
    config, pilot = plant_setup(Path(plant)), Policy(UNIVERSAL, "universal")
    pilot.join(config.plant)
    flown = simulate(config, pilot, Scenario(omega=1.0, amplitude=0.03, seconds=8.0), "newton-euler")
    flight = flown.observation.reshape(len(flown.observation), -1, 18)[:, -1]
    agree(*told(plant, np.float32), flight, 2e-3, 1e-2)
    agree(*told(plant), flight)


def test_it_does_not_round_between_observation_and_command() -> None:
    policy, (_, reference) = told("team3", np.float32)[0], told("team3")
    for seen in walk(500).astype(np.float32):
        np.testing.assert_allclose(policy(seen), reference(seen.astype(np.float64))[1], 1e-6, 1e-6)


def test_a_pair_that_has_joined_and_what_is_scaled() -> None:
    config, policy = plant_setup(Path("pair")), Policy(UNIVERSAL, "universal", np.float64)
    with pytest.raises(InputError, match="told its team"):
        policy(np.zeros(18))
    policy.join(config.plant)
    reference = Reference(policy)
    for seen in walk(50):
        np.testing.assert_allclose(policy.scaled(seen), reference(seen)[0], 1e-9, 1e-9)


def test_alone_and_in_a_batch_by_turns() -> None:
    """A memory may be read, kept, set again, and go on in a batch and back."""
    policy, reference = told("team6")
    flight = walk(120)
    agree(policy, reference, flight[:20])
    kept, wanted = policy.memory, reference.memory
    for first in (20, 40):
        agree(policy, reference, flight[first : first + 10])
        assert policy._ahead
        policy.memory = np.stack([policy.memory] * 2)
        reference.memory = np.stack([reference.memory] * 2)
        for seen in flight[first + 10 : first + 20]:
            both = np.stack([seen, seen[::-1]])
            np.testing.assert_allclose(policy(both), reference(both)[1], 1e-9, 1e-9)
        assert not policy._ahead
        policy.memory, reference.memory = policy.memory[0], reference.memory[0]
    policy.memory, reference.memory = kept, wanted
    kept[:] = 0.0  # what was read and set is a copy
    agree(policy, reference, flight[60:80])
    policy.reset()
    assert policy.memory is None
    reference.memory = None
    agree(policy, reference, flight[80:])


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_a_copy_goes_on_by_itself(duplicate: Any) -> None:
    policy, reference = told("pair")
    agree(policy, reference, walk(20))
    other, own = duplicate(policy), copy.copy(reference)
    for seen, aside in zip(walk(20, 1), walk(20, 2), strict=True):
        agree(policy, reference, seen[None])
        agree(other, own, aside[None])


@pytest.mark.parametrize("value", [3e5, -9e5])
def test_of_what_is_huge(value: float) -> None:
    """Up to the largest that `checked_observation` takes."""
    for slot, first in itertools.product(range(18), (0, 3)):
        (policy, reference), flight = told("team4"), walk(6)
        flight[first, slot] = value
        agree(policy, reference, flight)


@pytest.mark.parametrize("heads", [(), (6,), (6, 5)])
@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"context": ["share"]},
        {"filters": [0.1]},
        {"action_mode": "direct"},
        {"leader_kp": [0.5, 0.7, 0.9], "leader_kd": [1, 1.2, 1.4]},
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_of_a_recurrent_network(
    heads: tuple[int, ...], fields: dict[str, Any], dtype: type, recurrent: Recurrent
) -> None:
    """Also told its team, with averages, without a law, other gains; one layer is left to the law of arrays."""
    random, card = np.random.default_rng(6), {**recurrent.contents.card, **fields, "command_limits": [0.3, 0.6]}
    card["team"] = {"drone": 1, "mount_angle": 0.0, "context": [2.0, 3.0, -4.0, 5.0]}
    law, draw = law_of(card), lambda *shape: (random.normal(size=shape) / np.sqrt(shape[0])).astype(np.float32)
    size = law.input_size
    widths = [size + law.units, *heads, 6]
    shapes = [[below, above] for below, above in itertools.pairwise(widths)]
    shapes[-1][0] += law.units
    contents = dataclasses.replace(
        recurrent.contents,
        weights=tuple(draw(*shape) for shape in shapes),
        biases=tuple(draw(width) for width in widths[1:]),
        observation_mean=draw(size),
        observation_scale=np.abs(draw(size)),
        gru=(draw(size, 3 * law.units), draw(law.units, 3 * law.units), draw(3 * law.units)),
        card=card,
    )
    policy = Policy(contents, "recurrent", dtype)
    reference, tolerance = Reference(policy), 1e-5 if dtype == np.float32 else 1e-12
    agree(policy, reference, walk(200), tolerance, tolerance)
    assert policy._ahead == bool(heads)
    policy.memory = reference.memory = np.stack([policy.memory] * 2).astype(dtype)
    np.testing.assert_allclose(
        policy(SEEN), reference(SEEN.astype(dtype))[1], tolerance, tolerance
    )  # several, by the law of arrays
    policy.memory, reference.memory = policy.memory[1], reference.memory[1]
    agree(policy, reference, walk(20, 1), tolerance, tolerance)
