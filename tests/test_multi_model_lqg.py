"""Offset-free LQG for loops of unknown speed: one model is the law of teams; several find the speed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from rig_laws import OLDEST, still, with_law

from mjxball.baselines.multi_model_lqg import MODELS, MultiModelOffsetFree, multi_model_lqg
from mjxball.baselines.team_lqg import TUNING, team_lqg
from mjxball.config import Config, preset
from mjxball.control import rotations
from mjxball.control.followers import Baseline, copy_gains
from mjxball.control.multi_model_lqg import (
    ANGLE_STATES,
    AXES,
    CONTEXT,
    HEIGHT_STATES,
    LEAST_ROOM,
    LEVER,
    MultiModelLqg,
    team_geometry,
)
from mjxball.control.observation import copy_command, mount_frames
from mjxball.plant.teams import ring_config
from mjxball.policy.container import PolicyFileError
from mjxball.policy.file import law_of, load_file, save_file, shipped_policy
from mjxball.policy.law_fields import LATER_SHAPES, SWING_SHAPES
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import CIRCLE, Scenario

UNIVERSAL, TEAM = preset("universal"), preset("team")


def team4(frequency: float) -> Config:
    """Four drones on a ring with attitude loops of a `frequency` [rad/s]."""
    ring = ring_config(TEAM, 4)
    attitude = dataclasses.replace(ring.attitude, natural_frequency=(frequency, frequency, 4.0), damping=0.8)
    return dataclasses.replace(ring, attitude=attitude)


def law_of_geometry(config: Config) -> MultiModelOffsetFree:
    """The law alone, told where the drones of `config` are mounted."""
    mounts = np.array([drone.mount for drone in config.plant.drones])
    return MultiModelOffsetFree(UNIVERSAL, np.asarray(team_geometry(config.plant, mounts, np.float64(4))))


def test_one_model_is_the_law_of_teams() -> None:
    """The same loops, the same rotors, the same levers: the same commands and estimates, also of what is commanded."""
    frequency, lag, random = 7.0, 0.05, default_rng(0)
    config = dataclasses.replace(team4(frequency), plant=dataclasses.replace(ring_config(TEAM, 4).plant, rotor_lag=lag))
    attitude = dataclasses.replace(UNIVERSAL.attitude, natural_frequency=(7.0, 7.0, 4.0), damping=0.8)
    own = dataclasses.replace(UNIVERSAL, attitude=attitude, plant=dataclasses.replace(UNIVERSAL.plant, rotor_lag=lag))
    unknown = still(multi_model_lqg(own, ((frequency, lag),), TUNING))._replace(rig_axes=0.0)
    known, leader = team_lqg(config), copy_gains(config)
    lever, room = np.array([0.02, -0.05]), 0.3
    one = known.start(np.zeros((3, 18)), np.array([4 / 3, *lever, room, room]))
    other = unknown.start(np.zeros((3, 18)), np.array([4 / 3, *(lever * frequency**2), room * frequency**2]))
    for _ in range(20):
        observation = 0.1 * random.standard_normal((3, 18))
        nothing = np.zeros((3, 3))
        command = known.command(nothing, one, observation, leader)
        np.testing.assert_allclose(unknown.command(nothing, other, observation, leader), command, rtol=1e-9, atol=1e-12)
        one, other = known.next(one, observation, command, leader), unknown.next(other, observation, command, leader)
        states = np.concatenate([other[:, :10], other[:, 15:18]], axis=1)
        np.testing.assert_allclose(states, one[:, :13], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("frequency", [5.0, 10.0, 16.0])
def test_it_finds_how_fast_the_loops_are(frequency: float) -> None:
    config = team4(frequency)
    law = law_of_geometry(config)
    scenario = Scenario(omega=1.0, amplitude=0.03, path=CIRCLE, seconds=4.0)
    flown = simulate(config, Baseline(law, config), scenario, "newton-euler")
    memory = law.start(flown.observation[0])
    for seen in flown.observation[:-1]:
        memory, _ = law.step(memory, seen, None)
    found = np.exp(law._law.features(memory, flown.observation[-1])[:, 13:15])
    assert np.abs(np.log(found / frequency)).max() < np.log(1.45)  # models are up to a factor of 1.45 apart
    assert np.linalg.norm(flown.error[-1]) < 0.25 * np.linalg.norm(flown.error[0])


@pytest.mark.parametrize("share", [1.5, 2.0])
def test_numpy_and_jax_agree_and_models_share_one_weight(share: float) -> None:
    law, random = multi_model_lqg(UNIVERSAL), default_rng(1)
    leader = copy_gains(UNIVERSAL)
    memory = law.start(np.zeros((2, 18)), np.array([share, 3.0, -1.0, 30.0]))
    assert memory.shape == (2, law.size)
    for _ in range(10):
        observation = 0.1 * random.standard_normal((2, 18))
        command = law.command(np.full((2, 3), 0.01), memory, observation, leader)
        ours = law.next(memory, observation, command, leader), law.features(memory, observation)
        single = [jnp.asarray(part, jnp.float32) for part in (memory, observation, command)]
        theirs = law.next(*single, leader), law.features(*single[:2])
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(other, mine, rtol=2e-4, atol=2e-4)
        memory = ours[0]
    weights = law.known(memory, observation, None).seen.weights
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0)
    assert law.models == len(MODELS)


def test_models_that_do_not_fit_are_refused(tmp_path: object) -> None:
    contents = load_file(shipped_policy("universal"))
    for field, numbers in {
        "stiffness": [20.0, 50.0],
        "damping": [0.1],
        "keep": [float("nan"), 0.9],
        "axis": "none",
    }.items():
        card = json.loads(json.dumps(contents.card))
        card["lqg"][field] = numbers
        with pytest.raises(PolicyFileError, match=r"card field lqg\."):
            save_file(f"{tmp_path}/odd.npz", dataclasses.replace(contents, card=card))


def test_what_the_network_adds_enters_but_not_what_it_adds_all_the_time() -> None:
    law, leader = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL)
    context, level, added = np.array([4 / 3, 0.0, 0.0, 40.0]), np.zeros(18), np.array([0.1, -0.05, 0.0])
    start, count = law.start(level, context), law.models
    plain, moved = (law.next(start, level, command, leader) for command in (np.zeros(3), added))
    fast = added[:2] * law.keep[1] / context[0]  # the mean of all drones' commands, less the slow part of one step
    for axis in (0, 1):
        found = (moved - plain)[5 * count * axis : 5 * count * (axis + 1)].reshape(count, 5)
        np.testing.assert_allclose(found, law.axis[:, :, 5] * fast[axis], atol=1e-12)
    memory = start
    for _ in range(500):
        memory = law.next(np.concatenate([start[:-6], memory[-6:]]), level, added, leader)
    np.testing.assert_allclose(memory[-6:-4], added[:2], rtol=1e-3)  # all of it is taken for slow
    np.testing.assert_allclose(memory[: 15 * count], plain[: 15 * count], atol=1e-3)


def test_scores_know_that_what_the_network_lifts_turns_a_pair_about_pitch() -> None:
    law, leader = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL)
    level, lift = np.zeros(18), np.array([0.0, 0.0, 2.0])
    for config in (dataclasses.replace(UNIVERSAL, plant=preset("transport").plant), ring_config(TEAM, 4)):
        mounts = np.array([drone.mount for drone in config.plant.drones])
        context = np.atleast_2d(team_geometry(config.plant, mounts, np.float64(len(mounts))))[0]
        radius = np.linalg.norm(mounts[1])
        plain, lifted = (law.next(law.start(level, context), level, command, leader) for command in (0 * lift, lift))
        found = (lifted - plain)[: 15 * law.models].reshape(3, law.models, 5)
        np.testing.assert_allclose(found[:2], 0.0, atol=1e-12)  # the estimates take it for a load
        torque = LEVER * lift[2] / (2 * radius) if len(mounts) == 2 else 0.0  # over the inertia, of a middling rig
        np.testing.assert_allclose(found[2], law.axis[..., 5] * torque / law.stiffness[:, None], rtol=1e-6)


def test_scores_are_those_of_filters_that_are_told_what_the_network_lifts() -> None:
    law, leader, random = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL), default_rng(3)
    memory, pitch, turned = (
        law.start(np.zeros(18), np.array([2.0, 0.0, 6.0, 40.0])),
        *np.split(np.arange(15 * law.models), 3)[1:],
    )
    for _ in range(20):
        observation = 0.05 * random.standard_normal(18)
        told = memory.copy()
        told[pitch], told[turned] = memory[pitch] + memory[turned], 0.0
        seen, known = (law.known(one, observation, None).seen for one in (memory, told))
        np.testing.assert_allclose(seen.scores, known.scores, atol=1e-9)
        np.testing.assert_allclose(seen.turning[1] + seen.turning[2], known.turning[1], atol=1e-9)
        own = law.command(np.zeros(3), memory, observation, leader)
        memory = law.next(memory, observation, own + np.array([0.0, 0.0, random.standard_normal()]), leader)
    assert np.abs(memory[turned]).max() > 0.1


def test_a_file_without_the_lift_share_flies_as_before(tmp_path: Path) -> None:
    contents = load_file(shipped_policy("universal"))
    card = json.loads(json.dumps(contents.card))
    card["lqg"].pop("added_lift", None)
    save_file(tmp_path / "first.npz", dataclasses.replace(contents, card=card))
    assert law_of(load_file(tmp_path / "first.npz").card).lqg.added_lift == 0
    card["lqg"]["added_lift"] = 1.5
    with pytest.raises(PolicyFileError, match="added_lift must be a share from 0 to 1"):
        save_file(tmp_path / "odd.npz", dataclasses.replace(contents, card=card))


def without_own_roll(law: MultiModelLqg) -> MultiModelLqg:
    """`law` as files have it that know nothing of a pair's roll."""
    return law._replace(**{name: MultiModelLqg._field_defaults[name] for name in LATER_SHAPES if name != "rig_axes"})


def steps_to_find(law: MultiModelLqg, share: float, axis: int) -> int:
    """After how many steps the estimate stays within a fifth of a load torque that sets in about an `axis`."""
    memory, leader, late = law.start(np.zeros(18), np.array([share, 0.0, 0.0, 40.0])), copy_gains(UNIVERSAL), 0
    state, (onward, drive) = np.array([0.0, 0.0, 20.0, 0.0, 0.0]), np.split(law.axis[0], [5], axis=1)
    for step in range(100):
        seen = np.zeros(18)
        seen[[3 + axis, 9 + axis]] = state[:2]
        found = law.features(memory, seen)[5 + 3 * axis] * law.stiffness[0]
        late = step + 1 if abs(found - state[2]) > 0.2 * 20.0 else late
        command = law.command(np.zeros(3), memory, seen, leader)
        memory, state = law.next(memory, seen, command, leader), onward @ state + drive[:, 0] * command[axis] / share
    return late


def test_a_load_about_a_pairs_roll_is_found_sooner() -> None:
    law = multi_model_lqg(UNIVERSAL, ((9.0, 0.08),))
    before = steps_to_find(without_own_roll(law), 2.0, 0)
    # A load that walks 42 times as far in the square is found 42^(1/6) = 1.9 times as soon, less what whole steps take.
    assert 1.6 * steps_to_find(law, 2.0, 0) <= before < 20
    assert steps_to_find(law, 2.0, 1) == steps_to_find(law, 1.5, 0) == before


@pytest.mark.parametrize("share", [1.5, 4 / 3, 1.2])
def test_teams_of_three_and_more_know_nothing_of_a_pairs_roll(share: float) -> None:
    own, leader, random = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL), default_rng(4)
    plain, context = without_own_roll(own), np.array([share, 3.0, -1.0, 20.0])
    memory = own.start(np.zeros((2, 18)), context)
    for _ in range(20):
        observation = 0.1 * random.standard_normal((2, 18))
        command, other = (law.command(np.zeros((2, 3)), memory, observation, leader) for law in (own, plain))
        np.testing.assert_array_equal(command, other)
        memory, other = (law.next(memory, observation, command, leader) for law in (own, plain))
        np.testing.assert_array_equal(memory, other)


def test_about_pitch_a_pair_has_the_filters_of_every_team() -> None:
    own, leader, random = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL), default_rng(5)
    memory = own.start(np.zeros(18), np.array([2.0, 0.0, 6.0, 40.0]))
    for _ in range(10):
        observation = 0.1 * random.standard_normal(18)
        mine, other = (law.known(memory, observation, None).seen for law in (own, without_own_roll(own)))
        for part, same in ((mine.turning, other.turning), (mine.scores, other.scores)):
            np.testing.assert_array_equal(part[1:], same[1:])
            assert np.abs(part[0] - same[0]).max() > 1e-3
        command = own.command(np.zeros(3), memory, observation, leader)
        memory = own.next(memory, observation, command, leader)


@pytest.mark.parametrize(("axis", "share", "factor"), [(0, 2.0, 2.0), (0, 1.75, 1.5), (0, 1.5, 1.0), (1, 2.0, 1.0)])
def test_a_pair_has_more_room_about_roll(axis: int, share: float, factor: float) -> None:
    """A level team far from its goal, whose rotors hold hardly a tilt."""
    law, leader, far = multi_model_lqg(UNIVERSAL)._replace(pair_roll_room=2.0), copy_gains(UNIVERSAL), np.zeros(18)
    far[13 - axis] = 5.0
    memory = law.start(far, np.array([share, 0.0, 0.0, 1e-3]))
    command = law.command(np.zeros(3), memory, far, leader)
    np.testing.assert_allclose(np.abs(command[:2]), factor * LEAST_ROOM * (np.arange(2) == axis), atol=1e-9)


@pytest.mark.parametrize(("share", "reached"), [(1.5, 1.0), (1.2, 1.0), (2.0, 0.15 / 0.6), (1.75, 0.5)])
def test_more_than_two_drones_have_room_for_what_they_hold(share: float, reached: float) -> None:
    """A load of 0.3 rad about pitch, with no room else; a pair has `LEAST_ROOM`."""
    law, leader, level = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL), np.zeros(18)
    law = still(law)._replace(held_room=law.held_room)
    memory = law.start(level, np.array([share, 0.0, 0.0, 1e-3]))
    begin, states = ANGLE_STATES * law.models, memory.copy()
    for model, stiffness in enumerate(law.stiffness):
        states[begin + ANGLE_STATES * model + 2] = 0.3 * stiffness
    command = law.command(np.zeros(3), states, level, leader)
    np.testing.assert_allclose(command[:2], [0.0, -0.3 * share * reached], atol=1e-6)
    less = law._replace(held_room=0.0).command(np.zeros(3), states, level, leader)
    np.testing.assert_allclose(less[:2], [0.0, -LEAST_ROOM], atol=1e-6)


@pytest.mark.parametrize(
    ("drones", "factors"),
    [(2, [2.0, 3.0, 0.5, 0.25]), (3, [1.5, 2.0, 0.75, 0.5]), (4, [1.0, 1.0, 1.0, 0.75]), (9, [1.0, 1.0, 1.0, 0.75])],
)
def test_factors_are_those_of_the_size(drones: int, factors: list[float]) -> None:
    """On the feedback of error and velocity, near the goal and level, and on what is added."""
    table = np.array([[2.0, 3.0, 0.5, 0.25], [1.5, 2.0, 0.75, 0.5], [1.0, 1.0, 1.0, 0.75]])
    law, leader = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL)
    own = law._replace(by_size=table)
    context = np.array([drones / (drones - 1), 0.0, 0.0, 40.0])
    np.testing.assert_allclose(own.of_size(context[0]), factors, rtol=1e-12)

    def pushed(law: MultiModelLqg, slot: int) -> np.ndarray:
        """What being off by 1 mm or 1 mm/s changes in the wanted command, apart from making up for the leader."""
        level, off = np.zeros(18), 1e-3 * np.eye(18)[slot]
        memory = law.start(level, context)
        off_goal, at_goal = (law.command(np.zeros(3), memory, seen, leader) for seen in (off, level))
        led = copy_command(off, *leader)
        return off_goal - at_goal + led / (drones - 1)

    for slot, factor in ((12, factors[0]), (15, factors[1])):
        plain, found = (pushed(one, slot)[1] for one in (law, own))
        assert plain > 1e-4
        np.testing.assert_allclose(found, factor * plain, rtol=1e-9)
    scaled = np.array([-1.0, 0.5, 0.2])
    share = np.array([factors[2], factors[2], factors[3]])
    counted = own.counted(scaled, own.start(np.zeros(18), context))
    np.testing.assert_allclose(counted, scaled * (share + (1.0 - share) * np.abs(scaled)), rtol=1e-12)
    assert counted[0] == -1.0  # in full


def test_between_two_sizes_factors_are_a_mean() -> None:
    law = multi_model_lqg(UNIVERSAL)._replace(by_size=np.array([[2.0, 3.0, 0.5, 1.0], [1.0, 2.0, 1.0, 2.0]]))
    share = 2.25 / 1.25
    np.testing.assert_allclose(law.of_size(np.array([share, 2.0])), [[1.75, 2.75, 0.625, 1.25], [2.0, 3.0, 0.5, 1.0]])


@pytest.mark.parametrize("wrong", [[], [[1.0, 1.0, 1.0]], [[1.0, 1.0, 1.0, 0.0]], [[1.0] * 4] * 17, None, 1.0])
def test_factors_of_sizes_that_do_not_fit_are_refused(wrong: object, tmp_path: Path) -> None:
    contents = with_law()
    sound = {**contents.card["lqg"], "by_size": [[1.2, 1.1, 0.7, 0.7]]}
    save_file(tmp_path / "sound.npz", dataclasses.replace(contents, card={**contents.card, "lqg": sound}))
    card = {**contents.card, "lqg": {**sound, "by_size": wrong}}
    with pytest.raises(PolicyFileError, match=r"card field lqg\.by_size must be [^\n]*\Z"):
        save_file(tmp_path / "odd.npz", dataclasses.replace(contents, card=card))


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("pair_roll_gain", np.zeros((len(MODELS), 5)).tolist()),
        ("pair_roll_certainty", [[1.0, 0.0, 1.0]]),
        ("pair_roll_prior", [0.0] * (len(MODELS) - 1)),
        ("pair_roll_prior", None),
        ("pair_roll_room", [13.0]),
        ("pair_roll_room", True),
        ("pair_roll_room", 0.0),
        ("pair_roll_room", -1.0),
        ("rig_axes", 0.5),
        ("rig_axes", 2),
        ("rig_axes", True),
        ("rig_axes", [1.0]),
        ("swing", [[1.0, 0.0, 0.1, 0.1]] * 8),
        ("swing", "none"),
        ("swing_ahead", np.zeros((len(MODELS), 7, 2)).tolist()),
        ("swing_ahead", None),
        ("swing_keep", 1.0),
        ("swing_keep", -0.1),
        ("swing_keep", [0.9]),
        ("held_room", -1.0),
        ("held_room", True),
    ],
)
def test_later_numbers_that_do_not_fit_are_refused(field: str, wrong: object, tmp_path: Path) -> None:
    contents = with_law()
    sound = contents.card
    save_file(tmp_path / "sound.npz", contents)
    card = {**sound, "lqg": {**sound["lqg"], field: wrong}}
    with pytest.raises(PolicyFileError, match=rf"card field lqg\.{field} must be [^\n]*\Z"):
        save_file(tmp_path / "odd.npz", dataclasses.replace(contents, card=card))
    del card["lqg"][field]
    with pytest.raises(PolicyFileError, match=rf"needs card field lqg: .*{field}"):
        save_file(tmp_path / "odd.npz", dataclasses.replace(contents, card=card))


def test_a_file_without_swings_is_refused_with_none(tmp_path: Path) -> None:
    contents = with_law()
    lqg = {**contents.card["lqg"], "swing": [], "swing_ahead": [[]] * len(MODELS)}
    with pytest.raises(PolicyFileError, match=r"card field lqg\.swing"):
        save_file(tmp_path / "odd.npz", dataclasses.replace(contents, card={**contents.card, "lqg": lqg}))


@pytest.mark.parametrize("without", [(), SWING_SHAPES, OLDEST])
def test_a_file_without_later_numbers_flies_as_before(without: Collection[str], tmp_path: Path) -> None:
    law, default = multi_model_lqg(UNIVERSAL), MultiModelLqg._field_defaults
    save_file(tmp_path / "one.npz", with_law(without))
    for name, value in law_of(load_file(tmp_path / "one.npz").card).lqg._asdict().items():
        np.testing.assert_array_equal(value, default[name] if name in without else getattr(law, name))


class Ring:
    """Followers of a ring of three, of which the leader stands at +x."""

    def __init__(self) -> None:
        plant = ring_config(TEAM, 3).plant
        mounts = np.array([drone.mount for drone in plant.drones])
        self.context = np.asarray(team_geometry(plant, mounts, np.float64(3)))
        self._angles = np.asarray(mount_frames(plant, mounts))

    def seen(self, vectors: np.ndarray, follower: int) -> np.ndarray:
        """Every three numbers of `vectors` (..., 3 k) in body axes as a vector in the mount frame of a follower."""
        return self._turned(vectors, -self._angles[follower])

    def commanded(self, command: np.ndarray, follower: int) -> np.ndarray:
        """A follower's `command` in body axes."""
        return self._turned(command, self._angles[follower])

    @staticmethod
    def _turned(vectors: np.ndarray, angle: float) -> np.ndarray:
        parts = np.split(vectors, vectors.shape[-1] // 3, axis=-1)
        return np.concatenate([rotations.turned_about_z(part, np.float64(angle)) for part in parts], axis=-1)


@pytest.mark.parametrize("axes", [1.0, 0.0])
def test_followers_that_see_the_same_rig_have_the_same_filters(axes: float) -> None:
    """About the rig's axes; these are body axes here, in which both know and command the same."""
    law, leader, random = multi_model_lqg(UNIVERSAL)._replace(rig_axes=axes), copy_gains(UNIVERSAL), default_rng(6)
    ring, memories = Ring(), []
    seen = 0.1 * random.standard_normal((40, 18)) * np.resize([1.0, 0.3, 0.5], 18)
    added = 0.02 * random.standard_normal((40, 3))
    for follower in (0, 1):
        memory = law.start(ring.seen(seen[0], follower), ring.context[follower])
        for observation, more in zip(ring.seen(seen, follower), ring.seen(added, follower), strict=True):
            command = law.command(more, memory, observation, leader)
            memory = law.next(memory, observation, command, leader)
        memories.append(memory[:-CONTEXT])
        command = ring.commanded(command, follower)
    if axes:
        np.testing.assert_allclose(memories[0], memories[1], rtol=1e-9, atol=1e-9)
        level = multi_model_lqg(UNIVERSAL)._replace(rig_axes=0.0)  # of one whose mount frame is that of the rig
        context = np.array([1.5, 0.0, np.linalg.norm(ring.context[0, 1:3]), ring.context[0, 3]])
        memory = level.start(seen[0], context)
        for observation, more in zip(seen, added, strict=True):
            wanted = level.command(more, memory, observation, leader)
            memory = level.next(memory, observation, wanted, leader)
        np.testing.assert_allclose(memories[0], memory[:-CONTEXT], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(command, wanted, rtol=1e-9, atol=1e-9)
    else:
        begin = law.models * AXES * ANGLE_STATES + HEIGHT_STATES
        scores = slice(begin, begin + 2 * law.models)
        assert np.abs(memories[0][scores] - memories[1][scores]).max() > 1.0


def test_of_one_model_commands_and_features_do_not_depend_on_the_axes_of_its_filters() -> None:
    """As long as the leader's law, of which each axis has a limit, meets none; swings are found about each axis."""
    turned, leader, random = still(multi_model_lqg(UNIVERSAL, ((7.0, 0.05),))), copy_gains(UNIVERSAL), default_rng(7)
    plain, context = turned._replace(rig_axes=0.0), Ring().context[0]
    one, other = turned.start(np.zeros(18), context), plain.start(np.zeros(18), context)
    for _ in range(40):
        observation = 0.1 * random.standard_normal(18)
        shown, wanted = turned.features(one, observation), plain.features(other, observation)
        np.testing.assert_allclose(shown, wanted, rtol=1e-9, atol=1e-9)
        added = 0.02 * random.standard_normal(3)
        command = turned.command(added, one, observation, leader)
        np.testing.assert_allclose(command, plain.command(added, other, observation, leader), rtol=1e-9, atol=1e-9)
        one, other = turned.next(one, observation, command, leader), plain.next(other, observation, command, leader)
    assert np.abs(one - other).max() > 0.1


def test_a_pairs_axes_are_those_of_its_mount_frame() -> None:
    turned, leader, random = multi_model_lqg(UNIVERSAL), copy_gains(UNIVERSAL), default_rng(8)
    plain = turned._replace(rig_axes=0.0)
    memory = turned.start(np.zeros(18), np.array([2.0, 0.0, 6.0, 40.0]))
    for _ in range(10):
        observation, added = 0.1 * random.standard_normal(18), 0.02 * random.standard_normal(3)
        command, wanted = (law.command(added, memory, observation, leader) for law in (turned, plain))
        np.testing.assert_array_equal(command, wanted)
        shown, wanted = (law.features(memory, observation) for law in (turned, plain))
        np.testing.assert_array_equal(shown, wanted)
        memory, wanted = (law.next(memory, observation, command, leader) for law in (turned, plain))
        np.testing.assert_array_equal(memory, wanted)


def test_the_networks_view_of_unlike_loops_is_of_its_mount_frame() -> None:
    """Of a follower whose roll is the rig's pitch: what both axes show changes places."""
    law, level, leader = multi_model_lqg(UNIVERSAL), np.zeros(18), copy_gains(UNIVERSAL)
    across = law.start(level, np.array([1.5, 6.0, 0.0, 30.0]))  # the leader at -y
    along = law.start(level, np.array([1.5, 0.0, 6.0, 30.0]))
    random = default_rng(9)
    for _ in range(20):
        seen = 0.1 * random.standard_normal(18) * np.resize([1.0, 0.3, 0.5], 18)
        command = law.command(np.zeros(3), along, seen, leader)
        along = law.next(along, seen, command, leader)
        turned = Ring._turned(seen, -np.pi / 2)  # the same rig seen from a frame whose -y is the other's x
        across = law.next(across, turned, Ring._turned(command, -np.pi / 2), leader)
    one, other = law.features(along, seen), law.features(across, turned)
    vectors, sizes = [(0, 1), (2, 3), (5, 8), (6, 9), (7, 10), (15, 16), (20, 21)], [(13, 14), (17, 18)]
    for roll, pitch in vectors:
        np.testing.assert_allclose([other[roll], other[pitch]], [one[pitch], -one[roll]], rtol=1e-9, atol=1e-9)
    for roll, pitch in sizes:
        np.testing.assert_allclose([other[roll], other[pitch]], [one[pitch], one[roll]], rtol=1e-9)
        assert abs(one[roll] - one[pitch]) > 1e-3


@pytest.mark.parametrize("follower", [0, 1])
@pytest.mark.parametrize("axes", [1.0, 0.0])
def test_unlike_loops_are_found_about_the_rigs_axes(axes: float, follower: int) -> None:
    """A loop about roll that is 1.25 times as fast as that about pitch, seen from 60 degrees to each of them."""
    law, leader, random = multi_model_lqg(UNIVERSAL, ((8.0, 0.06), (10.0, 0.06))), copy_gains(UNIVERSAL), default_rng(0)
    law, ring, loops, states = law._replace(rig_axes=axes), Ring(), law.axis[::-1], np.zeros((2, 5))
    share = ring.context[follower][0]
    memory = law.start(np.zeros(18), ring.context[follower])
    for _ in range(150):
        body = np.zeros(18)
        body[[3, 4]], body[[9, 10]] = states[:, 0], states[:, 1]
        seen = ring.seen(body, follower)
        command = law.command(0.05 * random.standard_normal(3) * [1, 1, 0], memory, seen, leader)
        weights = law.known(memory, seen, None).seen.weights
        memory = law.next(memory, seen, command, leader)
        mean = ring.commanded(command, follower)[:2, None] / share
        states = (loops @ np.concatenate([states, mean], axis=1)[..., None])[..., 0]
    assert (weights[[0, 1], [1, 0]].min() > 0.99) == bool(axes)
