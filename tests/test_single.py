"""One observation at a time, a policy answers and remembers what the law of arrays does."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import pickle
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Recurrent
from rig_laws import OLDEST, with_law

from mjxball.cli import plant_setup
from mjxball.config import preset
from mjxball.control.multi_model_lqg import CONTEXT, team_geometry
from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.plant.teams import ring_config
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import law_of, shipped_policy
from mjxball.policy.law_fields import LATER_SHAPES, SWING_SHAPES
from mjxball.policy.policy import NetworkLaw
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
@pytest.mark.parametrize(("size", "tolerance"), [(1e-3, 1e-9), (0.03, 1e-9), (3.0, 1e-5)])
def test_it_is_the_law_of_arrays(plant: str, size: float, tolerance: float) -> None:
    """Scores are differences of squared distances, which large steps make so large that doubles round them to 1e-6."""
    policy, reference = told(plant)
    agree(policy, reference, walk(300, size=size), tolerance, 10 * tolerance)
    assert policy._ahead  # none of these were answered by the law of arrays


@pytest.mark.parametrize("plant", ["pair", "team4"])
def test_of_a_flight_it_is_the_law_of_arrays_as_rounded(plant: str) -> None:
    """In float32 the law of arrays rounds what this does not.

    Scores of thousands to 1e-4 and so the weights, commands of up to 8 m/s2 to 6e-5 of that; how fast a load changes
    [rad/s3] is the sum of innovations times gains of up to 470.
    """
    config, pilot = plant_setup(Path(plant)), Policy(UNIVERSAL, "universal")
    pilot.join(config.plant, config.attitude)
    flown = simulate(config, pilot, Scenario(omega=1.0, amplitude=0.03, seconds=8.0), "newton-euler")
    flight = flown.observation.reshape(len(flown.observation), -1, 18)[:, -1]
    agree(*told(plant, np.float32), flight, 5e-4, 1e-2)
    agree(*told(plant), flight)


def test_it_does_not_round_between_observation_and_command() -> None:
    policy, (_, reference) = told("team3", np.float32)[0], told("team3")
    for seen in walk(500).astype(np.float32):
        np.testing.assert_allclose(policy(seen), reference(seen.astype(np.float64))[1], 1e-6, 1e-6)


def test_a_pair_that_has_joined_and_what_is_scaled() -> None:
    config, policy = plant_setup(Path("pair")), Policy(UNIVERSAL, "universal", np.float64)
    with pytest.raises(InputError, match="told its team"):
        policy(np.zeros(18))
    policy.join(config.plant, config.attitude)
    reference = Reference(policy)
    for seen in walk(50):
        np.testing.assert_allclose(policy.scaled(seen), reference(seen)[0], 1e-9, 1e-9)


@pytest.mark.parametrize(
    "fields",
    [
        {"history": 3, "previous_action": True},
        {"history": 2, "filters": []},
        {"history": 1, "previous_action": False, "filters": [0.1]},
    ],
)
def test_any_history_and_any_gains(fields: dict[str, Any]) -> None:
    """Also of one hidden layer, gains that differ on every axis, and limits that are met."""
    random, gains = np.random.default_rng(5), {"leader_kp": [0.5, 0.7, 0.9], "leader_kd": [1, 1.2, 1.4]}
    card = {**UNIVERSAL.card, **gains, **fields, "command_limits": [0.1, 0.6]}
    size = 18 + law_of(card).shown
    normal = lambda *shape: (random.standard_normal(shape) / np.sqrt(shape[0])).astype(np.float32)  # noqa: E731
    contents = dataclasses.replace(
        UNIVERSAL,
        weights=(normal(size, 12), normal(12, 6)),
        biases=(normal(12), normal(6)),
        observation_mean=normal(size),
        observation_scale=np.abs(normal(size)),
        card=card,
    )
    agree(*told("team4", contents=contents), walk(200))


@pytest.mark.parametrize("plant", ["pair", "team3"])
def test_one_model_is_enough(plant: str) -> None:
    agree(*told(plant, contents=with_law(models=((7.0, 0.05),))), walk(200))


@pytest.mark.parametrize("without", [(), SWING_SHAPES, LATER_SHAPES, OLDEST])
@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("size", [0.03, 0.3])
def test_of_newer_and_of_older_files(count: int, without: Collection[str], size: float) -> None:
    """With and without swings, filters of a pair's own about roll and all about the rig's axes; limits are met, too.

    Of swings the eighth power of energies is taken, of which large steps make sums that round differently.
    """
    plant, made = ring_config(preset("team"), count).plant, with_law(without)
    mounts = np.array([drone.mount for drone in plant.drones])
    context = np.atleast_2d(team_geometry(plant, mounts, np.float64(count)))[-1].tolist()
    card = {**made.card, "team": {"drone": count - 1, "mount_angle": 0.0, "context": context}}
    policy = Policy(dataclasses.replace(made, card=card), "ring", np.float64)
    agree(policy, Reference(policy), walk(200, size=size), 1e-9 if size < 0.1 else 1e-7, 1e-7)
    assert policy._ahead
    newer = "rig_axes" not in without
    assert (policy._single._filters._roll_matrix is not None) == (newer and count == 2)
    assert (abs(policy._single._frame[1]) > 0.1) == (newer and count != 2)
    assert (policy._single._swings is None) == ("swing" in without)


@pytest.mark.parametrize("without", [(), LATER_SHAPES])
def test_a_memory_of_another_team_changes_the_filters(without: Collection[str]) -> None:
    """Also one of a share between those of a pair and of three, and one without a lever."""
    policy, reference = told("pair", contents=with_law(without))
    agree(policy, reference, walk(20))
    for number, told_now in enumerate(((1.75, 3.0, 4.0), (1.5, -2.0, 1.0), (2.0, 0.0, 5.0), (4 / 3, 0.0, 0.0))):
        memory = policy.memory
        memory[-CONTEXT:-1] = told_now
        policy.memory, reference.memory = memory, memory
        agree(policy, reference, walk(20, number))
        assert policy._ahead


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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [3e5, -9e5])
def test_what_is_huge_is_left_to_the_law_of_arrays(value: float, dtype: type) -> None:
    """Up to the largest that `checked_observation` takes; afterwards both round what is left of it.

    In float32 that is a hundredth of a command.
    """
    left = 0
    for slot, first in itertools.product(range(18), (0, 3)):
        (policy, reference), flight = told("team4", dtype), walk(6).astype(dtype)
        flight[first, slot] = value
        for seen in flight:
            wanted, found = reference(seen)[1], policy(seen)
            np.testing.assert_allclose(found, wanted, *[1e-2 if dtype == np.float32 else 1e-9] * 2)
            assert (np.abs(found) <= [0.6 + 1e-6, 0.6 + 1e-6, 8.0]).all()
            left += not policy._ahead
    assert left  # some of these were answered by the law of arrays


@pytest.mark.parametrize(
    ("value", "places"), [(1e200, slice(50, 200, 40)), (0.0, slice(-CONTEXT, 1 - CONTEXT))], ids=["huge", "no share"]
)
def test_a_memory_that_is_not_sound_is_left_to_the_law_of_arrays(value: float, places: slice) -> None:
    """States of filters whose squares overflow, and a share of the command of 0, by which a follower divides."""
    policy, reference = told("pair")
    agree(policy, reference, walk(5))
    sound = policy.memory
    for place in range(sound.size)[places]:
        spoilt = sound.copy()
        spoilt[place] = value
        policy.memory, reference.memory = spoilt, spoilt
        with np.errstate(all="ignore"):
            for seen in walk(3, 1):
                wanted, kept = reference(seen)[1], policy.memory
                if np.isfinite(wanted).all() and np.isfinite(reference.memory).all():
                    # Of what the lift has turned only the scores are made: they stay finite, and rounded another way.
                    np.testing.assert_allclose(policy(seen), wanted, 1e-9, 1e-12)
                    np.testing.assert_allclose(policy.memory, reference.memory, 1e-9, 1e-9)
                    continue
                with pytest.raises(InputError, match="not finite"):
                    policy(seen)
                np.testing.assert_array_equal(policy.memory, kept)
                break


@pytest.mark.parametrize("heads", [(), (6,), (6, 5)])
@pytest.mark.parametrize(
    "fields", [{}, {"context": ["share"]}, {"history": 2, "filters": [0.1]}, {"action_mode": "direct"}]
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_of_a_recurrent_network(
    heads: tuple[int, ...], fields: dict[str, Any], dtype: type, recurrent: Recurrent
) -> None:
    """Also told its team, with another history, without a law; one layer is left to the law of arrays."""
    random, card = np.random.default_rng(6), {**recurrent.contents.card, **fields, "command_limits": [0.3, 0.6]}
    card["team"] = {"drone": 1, "mount_angle": 0.0, "context": [2.0, 3.0, -4.0, 5.0]}
    law, draw = law_of(card), lambda *shape: (random.normal(size=shape) / np.sqrt(shape[0])).astype(np.float32)
    size = 18 + law.shown - law.units
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
