"""Random rigs: what is drawn is sound and padded, and the follower for any rig is told where drones are mounted."""

from __future__ import annotations

import dataclasses
import functools
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.bench.tracks import TRACKS, candidate
from mjxball.config import Config, preset, replace, validate, with_plant
from mjxball.control import rotations
from mjxball.control.observation import mount_frames
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.evaluate.metrics import measure
from mjxball.evaluate.policies import load_policy
from mjxball.physics.newton_euler import make_engine
from mjxball.physics.step import make_plant_step
from mjxball.plant import plant_parameters
from mjxball.plant.trim import largest_margin
from mjxball.policy.file import load_file, save_file, shipped_policy
from mjxball.policy.inference import geometry_of
from mjxball.sim.outside import outside
from mjxball.sim.rigs import (
    LEAST_DAMPING,
    TRAINING,
    RigTable,
    loop_damping,
    rig_config,
    sample_rigs,
    trimmed_reach,
    unpadded,
    whole,
)
from mjxball.sim.rollout import load_of, simulate, start_of
from mjxball.sim.scenario import Scenario

UNIVERSAL = preset("universal")
POLICY = shipped_policy("universal")
OTHERS = 2  # seed of rigs that no training samples


@functools.cache
def other_rigs(size: int, count: int) -> RigTable:
    """`count` rigs of `size` drones that no training samples, without padding."""
    return unpadded(sample_rigs(UNIVERSAL, size, count, OTHERS).rigs, size)


def test_a_row_is_the_plant_of_its_configuration() -> None:
    for size in (2, 4):
        rigs = other_rigs(size, 3)
        for row in range(3):
            config = rig_config(UNIVERSAL, rigs, row)
            found = plant_parameters(config.plant, config.attitude)
            drawn = whole(rigs.rows(row).parameters, config.plant.gravity)
            for name in set(found._fields) - {"gains", "ball_limit"}:
                np.testing.assert_allclose(
                    getattr(drawn, name), getattr(found, name), rtol=1e-9, atol=1e-15, err_msg=name
                )
            for mine, theirs in zip(drawn.gains, found.gains, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=1e-9)


def test_draws_are_seeded_within_their_ranges_and_never_those_of_training() -> None:
    drawn, again = sample_rigs(UNIVERSAL, 3, 40, TRAINING), sample_rigs(UNIVERSAL, 3, 40, TRAINING)
    assert drawn.candidates == again.candidates
    assert drawn.unstable > 0
    np.testing.assert_array_equal(drawn.rigs.reach, again.rigs.reach)
    assert not np.isin(other_rigs(3, 40).reach, drawn.rigs.reach).any()
    for row in range(40):
        assert not outside(rig_config(UNIVERSAL, drawn.rigs, row), UNIVERSAL)
    for axis in (0, 1):
        found = loop_damping(drawn.rigs.frequency[:, axis], drawn.rigs.damping, drawn.rigs.parameters.rotor_lag[:, 0])
        assert found.min() >= LEAST_DAMPING


def test_damping_is_that_of_the_roots() -> None:
    random = np.random.default_rng(0)
    frequency, damping, lag = random.uniform(4, 20, 50), random.uniform(0.5, 1.1, 50), random.uniform(0.015, 0.15, 50)
    for w, z, t, found in zip(frequency, damping, lag, loop_damping(frequency, damping, lag), strict=True):
        roots = np.roots([t, 1.0, 2 * z * w, w * w])
        least = (-roots.real / np.abs(roots)).min()
        assert min(found, 1.0) == pytest.approx(least, abs=1e-9)


def test_followers_can_hold_every_load_as_far_as_it_goes() -> None:
    margin = UNIVERSAL.scenario.trim_margin
    for size in (2, 3, 6):
        rigs = other_rigs(size, 8)
        for row in range(8):
            plant, thrust = rig_config(UNIVERSAL, rigs, row).plant, tuple(rigs.thrust[row])
            for angle in np.linspace(0, 2 * np.pi, 5):
                place = tuple(0.999 * rigs.reach[row] * np.array([np.cos(angle), np.sin(angle)]))
                mass, believed = float(rigs.object_mass[row]), float(rigs.believed_mass[row])
                assert largest_margin(plant, mass, place, believed, thrust=thrust).margin > margin - 1e-6


def test_a_wrong_belief_takes_from_what_tilt_commands_hold() -> None:
    rigs = other_rigs(3, 8)
    numbers, load, full = whole(rigs.parameters, 9.81), rigs.object_mass, np.ones_like(rigs.thrust)
    right, less, more = (trimmed_reach(numbers, load, k * load, full, 0.15, 0.01, 6.0) for k in (1.0, 0.9, 1.1))
    held = 0.85 * 0.01 * 2 * numbers.gains.kp[:, :2].min(axis=1)  # by two followers, of limits of 0.01 rad
    np.testing.assert_allclose(right, held / (9.81 * load), rtol=1e-12)
    assert (less < right).all()
    assert (more < right).all()


@pytest.mark.release
def test_a_padded_rig_flies_as_it_does_alone() -> None:
    rigs = sample_rigs(UNIVERSAL, 3, 2, 7).rigs
    alone = dataclasses.replace(
        rig_config(UNIVERSAL, rigs, 0), attitude=UNIVERSAL.attitude, rigs=dataclasses.replace(UNIVERSAL.rigs, number=1)
    )
    flown = []
    for config, table in ((UNIVERSAL, rigs), (alone, unpadded(rigs, 3))):
        still = dataclasses.replace(config.scenario, noise=(0.0, 0.0), delay=(0.0, 0.0), estimator_drift=(0.0, 0.0))
        simple = dataclasses.replace(config.follower, recurrent_units=0)
        env = TransportEnv(dataclasses.replace(config, scenario=still, follower=simple), "newton-euler")
        own = jax.tree.map(lambda part: jnp.asarray(part[1], jnp.float32), table)
        state, step = jax.jit(env.reset)(jax.random.key(3), None, own), jax.jit(env.step)
        for _ in range(25):
            state = step(state, jnp.zeros((len(env.config.plant.followers), 3)))
        flown.append(state)
    np.testing.assert_allclose(flown[0].obs[:2], flown[1].obs, atol=2e-4)
    assert float(jnp.abs(flown[1].obs[:, 6:9]).max()) > 0.05  # it moves


@pytest.mark.release
def test_training_differentiates_what_followers_remember() -> None:
    """The slope of what is commanded later in the first action, by a state that sums up rates: against a difference."""
    config = UNIVERSAL
    for setting, value in (("rigs.number", 2), ("scenario.team_sizes", (2,)), ("scenario.delay", (0.0, 0.0))):
        config = replace(config, setting, value)
    env = TransportEnv(config, "newton-euler")
    start, first = env.reset(jax.random.key(1)), jnp.zeros((20, 5, 3)).at[0].set(jnp.array([0.3, -0.5, 0.2]))

    def cost(push: Any) -> Any:
        def states(state: Any, action: Any) -> Any:
            hidden = state.obs[..., env.recurrent_slots]
            later = hidden.at[..., :3].set(0.9 * hidden[..., :3] + 0.2 * state.obs[..., 9:12])
            answer = jnp.concatenate([action + hidden[..., :3], later], axis=-1)
            return env.step(state, answer), state.pipeline_state.command

        _, commands = jax.lax.scan(states, start, push * first)
        return (commands[2:, 0] * jnp.array([1.0, 1.0, 0.1])).sum()

    slope, cost = jax.jit(jax.grad(cost)), jax.jit(cost)
    difference = (cost(0.02) - cost(-0.02)) / 0.04
    assert abs(difference) > 0.1
    np.testing.assert_allclose(slope(0.0), difference, rtol=2e-3)  # float32 and the curvature leave 2e-4


def test_thrust_falls_as_the_battery_empties() -> None:
    config = preset("paper")
    step = make_plant_step(config, make_engine(config.plant, config.attitude))
    scenario = [Scenario(seconds=1.0)]
    load, state = load_of(config, scenario), start_of(config, scenario)
    for fade in (0.0, 0.1):
        flown = state
        for _ in range(100):
            flown = step(flown, np.zeros((1, 2, 3)), load._replace(thrust_fade=np.full(1, fade)))
        # The lost force is a ramp, sampled at the beginning of each physics step, behind the rotors' lag.
        lag = config.plant.rotor_lag
        ramp = ((2.0 - config.physics_step / 2 - lag) ** 2 + lag**2) / 2
        expected = -config.plant.gravity * fade * ramp
        assert flown.velocity[0, 2] == pytest.approx(expected, rel=1e-4, abs=1e-4)


def true_geometry(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Of the followers of a rig, each in its mount frame: lever (F, 2) and room (F,).

    Lever: angular acceleration about roll and pitch per 1 m/s2 that the follower lifts more than the leader [1/m].
    Room: that about pitch at which its rotors saturate, with all other drones turning alike [1/s2].
    """
    plant, found = config.plant, plant_parameters(config.plant, config.attitude)
    lifted = found.known_mass + found.load_share * plant.object_mass
    inertia = plant.count * found.gains.kp[:2] / np.square(config.attitude.natural_frequency[:2])
    x, y = found.mounts[plant.leader, :2]
    angles, hover = np.atleast_1d(mount_frames(plant)), plant.gravity * lifted / 4
    lever = np.append(np.array([-y, x]) * lifted[plant.leader] / inertia, 0.0)
    most = (2 * found.arm * np.minimum(hover, found.rotor_force_max - hover))[list(plant.followers)]  # [N m]
    along, across = np.cos(angles) ** 2, np.sin(angles) ** 2
    room = plant.count * most / (along * inertia[1] + across * inertia[0])
    return rotations.turned_about_z(np.broadcast_to(lever, (len(angles), 3)), -angles)[:, :2], room


class TestUniversal:
    def test_what_it_makes_of_mounts_is_that_of_a_middling_rig(self) -> None:
        """Against what followers that know the whole rig know: medians of the rigs, their spread and direction."""
        for size in (2, 3, 4, 6):
            levers, rooms, turned = [], [], []
            rigs = other_rigs(size, 40)
            for row in range(40):
                config = rig_config(UNIVERSAL, rigs, row)
                lever, room = true_geometry(config)
                guessed = np.atleast_2d(geometry_of(config.plant))
                np.testing.assert_allclose(guessed[:, 0], size / (size - 1))
                levers.append(np.hypot(*lever.T) / np.hypot(*guessed[:, 1:3].T))
                rooms.append(room / guessed[:, 3])
                turned.append(np.arctan2(*lever.T) - np.arctan2(guessed[:, 1], guessed[:, 2]))
            assert np.median(levers) == pytest.approx(1.0, abs=0.15)
            assert np.median(rooms) == pytest.approx(1.0, abs=0.25)
            assert np.quantile(np.abs(np.log(levers)), 0.9) < 0.5
            # The loops of roll are up to a quarter faster or slower than those of pitch.
            assert np.abs((np.array(turned) + np.pi) % (2 * np.pi) - np.pi).max() < 0.3

    @pytest.mark.slow
    @pytest.mark.parametrize("size", [2, pytest.param(5, marks=pytest.mark.release)])
    def test_it_fails_on_no_rig_that_it_has_never_seen(self, size: int) -> None:
        rigs = [one for one in TRACKS["rigs"].flights(OTHERS) if one.config.plant.count == size][:4]
        found = []
        for plant, rig in enumerate(rigs):
            scenario = candidate("rigs", OTHERS, plant, "calm", 0, rig.sample)
            assert scenario is not None
            flight = simulate(rig.config, load_policy(POLICY, rig.config), scenario, "newton-euler")
            found.append(measure(flight, rig.config.scenario.termination_distance))
        assert not any(one.failed for one in found)
        assert np.median([one.peak for one in found]) < 0.1

    @pytest.mark.slow
    def test_a_rig_outside_is_flown_with_a_warning(self, capsys: pytest.CaptureFixture[str]) -> None:
        load_policy(POLICY, with_plant(preset("transport"), "team4"))
        assert (
            "trained from" not in capsys.readouterr().err
        )  # more drones than its metadata is good for, but of its ranges
        paper = preset("paper")
        load_policy(POLICY, paper)
        assert capsys.readouterr().err == ""
        heavy = dataclasses.replace(paper, plant=dataclasses.replace(paper.plant, object_mass=2.0, rotor_force_max=9.0))
        load_policy(POLICY, heavy)
        assert "object's mass over that of all drones 1, trained from 0.05 to 0.6" in capsys.readouterr().err
        # 2 arms of 0.12 m times 9.81 * 6.9 / 24 N, over 0.369 kg m2 * (10 rad/s)^2 / 6
        load_policy(POLICY, with_plant(preset("transport"), "team6"))
        assert "rotors saturate from a tilt step of 0.11 rad on, trained from 0.15 rad" in capsys.readouterr().err

    def test_it_flies_no_stand(self) -> None:
        with pytest.raises(InputError, match="made for free flight, not for a stand"):
            load_policy(POLICY, replace(preset("paper"), "plant.stand", "pivot"))

    def test_a_pair_along_y_is_one_in_the_plane(self) -> None:
        drones = tuple(dataclasses.replace(d, mount=(0.0, d.mount[0], 0.0)) for d in preset("paper").plant.drones)
        plant = dataclasses.replace(preset("paper").plant, drones=drones, cg_axis="y")
        with pytest.raises(InputError, match=r"plant\.cg_axis xy"):
            load_policy(POLICY, dataclasses.replace(preset("paper"), plant=plant))
        flown = []
        for turned in (preset("paper").plant, dataclasses.replace(plant, cg_axis="xy")):
            config = dataclasses.replace(preset("paper"), plant=dataclasses.replace(turned, object_size=(0.34,) * 3))
            flight = simulate(config, load_policy(POLICY, config), Scenario(amplitude=0.0, seconds=6.0), "newton-euler")
            first, last = np.linalg.norm(flight.error[[0, -1]], axis=-1)
            flown.append(last / first)
        assert max(flown) < 0.02  # settled

    def test_another_context_is_refused(self, tmp_path: object) -> None:
        contents = load_file(POLICY)
        metadata = json.loads(json.dumps(contents.metadata)) | {"context": ["mass"]}
        with pytest.raises(InputError, match="needs another context"):
            save_file(f"{tmp_path}/odd.npz", dataclasses.replace(contents, metadata=metadata))


def test_rigs_need_numbers_of_drones() -> None:
    with pytest.raises(InputError, match=r"rigs\.number needs scenario\.team_sizes"):
        validate(replace(UNIVERSAL, "scenario.team_sizes", ()))
