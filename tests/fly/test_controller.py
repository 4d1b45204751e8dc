"""The controllers in flight are the controllers in simulation: same numbers for the same state."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
from command_line import TRANSPORT
from euler_angles import matrix_from_euler
from hypothesis import given
from hypothesis import strategies as st
from wire import pack_state

from mjxball.control import observation, rotations
from mjxball.physics.engine import PlantState
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.sim.controllers import Controllers
from mjxfly import process
from mjxfly.controller import FlightController
from mjxfly.packets import DroneState, unpack_state
from mjxfly.policy_setup import config_of
from mjxfly.process import Metronome
from mjxfly.telemetry import Rig, object_state

small = st.floats(-0.5, 0.5)
triples = st.tuples(small, small, small)


def drones(
    rig: Rig, position: np.ndarray, euler: np.ndarray, velocity: np.ndarray, rates: np.ndarray
) -> list[DroneState]:
    """What two perfect estimators on a rigid stick report."""
    quaternion = rotations.quaternion_from_euler(euler)
    matrix = rotations.matrix_from_quaternion(quaternion)
    states = []
    for mount in (np.array(rig.leader_mount), np.array(rig.follower_mount)):
        swing = rotations.rotate(matrix, rotations.cross(rates, mount))
        states.append(DroneState(position + matrix @ mount, velocity + swing, quaternion, rates, 0, 4.0))
    return states


@given(triples, triples, triples, triples, st.floats(0.1, 0.9))
def test_the_objects_state_is_found_from_both_drones(
    position: tuple, euler: tuple, velocity: tuple, rates: tuple, share: float
) -> None:
    rig = Rig((0.4 * share, 0.0, 0.0), (-0.4 * (1 - share), 0.0, 0.0))
    truth = [np.array(part) for part in (position, euler, velocity, rates)]
    found = object_state(drones(rig, *truth), rig)
    np.testing.assert_allclose(found.position, position, atol=1e-12)
    np.testing.assert_allclose(found.velocity, velocity, atol=1e-12)
    np.testing.assert_allclose(rotations.euler_from_matrix(found.matrix), euler, atol=1e-12)
    assert sum(rig.weights) == pytest.approx(1.0)


def with_integral(contents: PolicyFile) -> PolicyFile:
    """The same policy under a leader with an integral gain, as on the paper's stand."""
    config = {**contents.metadata["config"], "leader": {**contents.metadata["config"]["leader"], "ki": [0.2, 0.1, 0.1]}}
    return dataclasses.replace(contents, metadata={**contents.metadata, "config": config})


def test_a_flight_of_the_pilot_is_a_flight_of_the_simulation() -> None:
    contents = with_integral(load_file(TRANSPORT))
    config = config_of(contents.metadata)
    assert config.leader.ki == (0.2, 0.1, 0.1)
    controller, follower = FlightController(Policy(contents, "a")), Policy(contents, "b")
    random, goal, integral = np.random.default_rng(2), np.array([0.3, -0.2, 0.5]), np.zeros(3)
    mount = np.array(config.plant.pair[1].mount)
    follower.reset()
    for _ in range(20):
        position, euler, velocity, rates = (0.3 * random.normal(size=3) for _ in range(4))
        state = object_state(drones(pilot_rig(contents), position, euler, velocity, rates), pilot_rig(contents))
        flown = controller.step(state, goal)
        matrix = matrix_from_euler(euler)
        seen = observation.observe(position, matrix, velocity, rates, goal, mount)
        np.testing.assert_allclose(flown.observation, seen, atol=1e-12)
        zero = np.zeros(())
        simulated = PlantState(*(zero for _ in PlantState._fields))._replace(position=position, velocity=velocity)
        np.testing.assert_allclose(
            flown.leader, Controllers(config).leader_command(simulated, goal, integral), atol=1e-10
        )
        np.testing.assert_allclose(flown.follower, follower(seen), atol=1e-5)  # float32 inference
        integral = integral + config.timing.control_period * (goal - position)


def pilot_rig(contents: PolicyFile) -> Rig:
    return Rig.from_metadata(contents.metadata)


def test_the_wire_costs_little_of_the_observation() -> None:
    """What millimetres and milliradians do to the 18 numbers: far below the noise that policies are trained with."""
    contents = load_file(TRANSPORT)
    rig, random = pilot_rig(contents), np.random.default_rng(3)
    mount = np.array(rig.follower_mount)
    for _ in range(50):
        truth = [0.3 * random.normal(size=3) for _ in range(4)]
        exact = drones(rig, *truth)
        wired = [unpack_state(pack_state(state)) for state in exact]
        seen = []
        for states in (exact, wired):
            now = object_state(states, rig)
            seen.append(observation.observe(now.position, now.matrix, now.velocity, now.rates, np.ones(3), mount))
        # 3 mrad of attitude resolution, times the 0.17 m mount and the body rates, is the largest of all.
        assert np.abs(seen[1] - seen[0]).max() < 6e-3


def test_forgetting_starts_anew() -> None:
    contents = load_file(TRANSPORT)
    controller, rig = FlightController(Policy(contents, "a")), pilot_rig(contents)
    state = object_state(drones(rig, *np.full((4, 3), 0.1)), rig)
    first = controller.step(state, np.ones(3))
    controller.step(state, np.zeros(3))
    controller.reset()
    again = controller.step(state, np.ones(3))
    np.testing.assert_array_equal(first.follower, again.follower)


@pytest.mark.parametrize(("moving", "rest"), [(0.0, 0.0), (0.25, 0.3)])
def test_only_who_was_trained_with_goals_that_move_knows_their_rate(moving: float, rest: float) -> None:
    contents = load_file(TRANSPORT)
    metadata = copy.deepcopy(contents.metadata)
    metadata["config"]["scenario"]["goal_motion_probability"] = moving
    policy = Policy(dataclasses.replace(contents, metadata=metadata), "a")
    state = object_state(drones(pilot_rig(contents), *np.zeros((4, 3))), pilot_rig(contents))
    controller, rate = FlightController(policy), np.array([0.0, 0.0, -0.3])
    alone, moved = controller.step(state, np.zeros(3)), controller.step(state, np.zeros(3), rate)
    assert alone.observation[17] - moved.observation[17] == pytest.approx(rest)
    assert (alone.leader[2] - moved.leader[2] > 0.1) == (rest > 0)


def test_late_ticks_do_not_shift_the_later_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(process.clock, "now", lambda: now[0])
    monkeypatch.setattr(process.clock, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    metronome = Metronome(0.01)
    metronome.start()
    times = []
    for busy in (0.0, 0.004, 0.025, 0.0, 0.0):
        times.append(metronome.wait())
        now[0] += busy
    np.testing.assert_allclose(times, [100.01, 100.02, 100.03, 100.055, 100.06], atol=1e-9)
    assert metronome.missed == 1  # that of 100.05; the tick of 100.04 was late, at 100.055
    assert metronome.missed_lately(now[0]) == 1
    assert metronome.missed_lately(now[0] + 2) == 0
    assert metronome.timing().largest == pytest.approx(0.015)
