"""Offset-free LQG of teams: what a follower knows of its team, its estimates, noise."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from tables import rows

from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.baselines.team_lqg import TeamOffsetFree, team_model, unit_model
from mjxball.config import Config, preset
from mjxball.control.observation import copy_command
from mjxball.errors import InputError
from mjxball.plant import plant_parameters
from mjxball.plant.teams import ring_config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

TEAM = preset("team")
ENGINE = "newton-euler"


def ring(count: int) -> Config:
    return ring_config(TEAM, count)


@rows("count", [2, 3, 6])
def test_what_a_follower_knows_of_a_ring(count: int) -> None:
    """Lifts of 1 m/s2 more by all followers turn the ring about the leader's mount, as a command of all N does."""
    config = ring(count)
    numbers, found = plant_parameters(config.plant, config.attitude), team_model(config)
    lever, rooms = np.atleast_2d(found.lever), np.atleast_2d(found.room)
    assert lever.shape == rooms.shape == (count - 1, 2)
    assert found.ratio == count / (count - 1)
    lifted = numbers.known_mass[0] + numbers.load_share[0] * config.plant.object_mass
    torque = lifted * np.hypot(*numbers.mounts[0, :2])
    np.testing.assert_allclose(np.hypot(*lever.T), torque / count / numbers.gains.kp[1], rtol=1e-9)
    if count % 2 == 0:  # the follower across from the leader has it straight ahead: a pure pitch, nose up to the leader
        np.testing.assert_allclose(lever[count // 2 - 1], [0.0, torque / count / numbers.gains.kp[1]], atol=1e-12)
    room = 2 * numbers.arm[0] * 9.81 * lifted / 4  # all hover below half of their range
    np.testing.assert_allclose(rooms, np.tile(room / numbers.gains.kp[:2], (count - 1, 1)), rtol=1e-9)


def test_turning_a_team_changes_nothing_that_its_followers_know() -> None:
    config, found = ring(4), []
    for angle in (0.0, 0.7):
        c, s = math.cos(angle), math.sin(angle)
        drones = tuple(
            dataclasses.replace(
                one, mount=(c * one.mount[0] - s * one.mount[1], s * one.mount[0] + c * one.mount[1], 0.0)
            )
            for one in config.plant.drones
        )
        found.append(team_model(dataclasses.replace(config, plant=dataclasses.replace(config.plant, drones=drones))))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)


def test_what_enters_the_filter_is_the_mean_of_all_commands() -> None:
    """It lifts as the height's feedback asks, and tilts against what lifting more than the leader turns."""
    controller = TeamOffsetFree(ring(4))
    observation = 0.05 * np.random.default_rng(0).standard_normal(18)
    led, tilts = copy_command(observation, *controller._leader), []
    for lever in (np.zeros(2), np.array([0.01, -0.02])):
        controller.team = controller.team._replace(lever=lever, room=np.array([9.0, 9.0]))
        state = controller.start(observation)
        after, own = controller.step(state, observation, None)
        mean, (x, _, lift) = (led + 3 * own) / 4, controller.estimate(state, observation)
        assert mean[2] == pytest.approx(controller.gains[0, 2] @ observation - lift, rel=1e-9)
        tilts.append(mean[:2] + lever * (own - led)[2])  # with what the lift turns
        np.testing.assert_allclose(
            after, controller.filter.moved(x, np.array([*controller.stiffness * tilts[-1], mean[2]])), rtol=1e-9
        )
    np.testing.assert_allclose(tilts[1], tilts[0], rtol=1e-9)


@rows("count", [3, 6])
def test_it_finds_the_loads_torque(count: int) -> None:
    """m g c over the inertia, in every mount frame, less the few percent that is forgotten."""
    config = ring(count)
    follower, mass, offset = make_baseline("lqg-offset-free", config), config.plant.object_mass, 0.04
    scenario = Scenario(omega=0.0, phase=math.pi / 2, amplitude=offset, mass=mass, seconds=12.0)
    flown = simulate(config, follower, scenario, ENGINE)
    assert np.abs(flown.error[-1]).max() < 5e-3
    _, load, _ = follower.controller.estimate(follower._state, flown.observation[-1])
    numbers = plant_parameters(config.plant, config.attitude)
    inertia = count * numbers.gains.kp[1] / 100
    found = np.linalg.norm(load[0], axis=-1)
    np.testing.assert_allclose(found, mass * 9.81 * offset / inertia, rtol=0.06)


def test_followers_that_measure_apart_do_not_drift_apart() -> None:
    """For 30 s under noise level 1 and 40 ms of delay: estimates that nothing forgets end up at the rotors' limits."""
    config = ring(6)
    scenario = Scenario(mass=0.6, seconds=30.0, disturbance=Disturbance(noise=1.0, delay=0.04))
    flown = simulate(config, make_baseline("lqg-offset-free", config), scenario, ENGINE)
    assert np.linalg.norm(flown.error[flown.time > 15], axis=-1).max() < 0.03


def test_loops_that_differ_are_refused() -> None:
    with pytest.raises(InputError, match="alike about roll and pitch"):
        unit_model(configs.replace(ring(4), "attitude.natural_frequency", (8.0, 10.0, 4.0)))
