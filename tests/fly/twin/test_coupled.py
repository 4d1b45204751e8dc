"""The physics behind the twin: against the closed form, on the ground, with the gains that were uploaded."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control import crazyflie, motors, rotations
from mjxball.control.crazyflie import PARAMETERS, STOCK, gains_of, pair_gains, with_gains
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import make_plant_step, start_state
from mjxball.plant import plant_parameters
from mjxfly.mount_modes import Mount
from mjxfly.twin.conditions import Conditions, DroneKind, Surroundings, drone_kind
from mjxfly.twin.coupled import CoupledPair
from mjxfly.twin.pair import PairState

PRESETS = ("flight", "stand")
PERIOD = 0.005  # the twin's


EXACT = Surroundings(exact=True)  # the simulation has no estimator
OLDER = drone_kind(curve="older")


def pair_of(
    config: Config, conditions: Conditions | None = None, kind: DroneKind = OLDER, around: Surroundings = EXACT
) -> CoupledPair:
    """A pair whose gains are those of the metadata."""
    pair = CoupledPair(config, conditions, kind, around)
    for drone, gains in enumerate(pair_gains(config.autopilot)):
        for name, value in gains.items():
            pair.set_parameter(drone, name, value)
    return pair


def run(pair: CoupledPair, setpoint: tuple[float, float, float, float], seconds: float) -> PairState:
    """State after `seconds` of both drones under one setpoint."""
    for _ in range(round(seconds / PERIOD)):
        state = pair.advance(np.array([setpoint] * 2), PERIOD)
    return state


def tilt_of(state: PairState) -> float:
    """Roll of the pair [rad]."""
    return float(rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion[0]))[0])


def start_of(config: Config, ball: float) -> PlantState:
    """Slightly tilted and moving, at hover thrust, half a metre up."""
    vectors = ([0.1, -0.2, 0.5], [0.05, -0.03, 0.1], [0.1, 0.05, -0.1])
    return start_state(config, *map(np.array, vectors), np.float64(config.plant.object_mass), np.float64(ball))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_second_in_the_air_is_that_of_the_closed_form(preset: str) -> None:
    # The older firmware, whose force does not hang on the battery's filtered voltage.
    config = motors.with_curve(configs.preset(preset), motors.OLDER)
    mass = config.plant.object_mass
    conditions = Conditions(mass, cg_amplitude=0.03, cg_speed=1.0, ball=0.02)
    pair, state = pair_of(config, conditions), start_of(config, 0.02)
    pair.place(state)
    values = map(np.float64, (mass, mass, 0.03, 1.0, 0.0))
    load = Load(*values, np.zeros(0), np.zeros(0))
    step = make_plant_step(config, newton_euler.make_engine(config.plant, config.attitude))
    constants = plant_parameters(config.plant, config.attitude)
    command = np.array([[0.06, -0.05, 0.3], [0.02, 0.03, -0.2]])
    carried = constants.drone_mass + constants.load_share * mass
    sent = crazyflie.setpoints(config.autopilot, command, carried, config.plant.gravity)
    for _ in range(100):
        state = step(state, command, load)
        flown = pair.advance(sent, config.timing.control_period)
    moved = np.abs(state.position - [0.1, -0.2, 0.5]).max()
    # MuJoCo's Euler step of 1 ms is of first order: 1 % of what was flown covers it and the closed form's own 2 ms.
    np.testing.assert_allclose(flown.position.mean(axis=0), state.position, atol=0.01 * max(moved, 0.1))
    np.testing.assert_allclose(flown.velocity.mean(axis=0), state.velocity, atol=0.01)
    np.testing.assert_allclose(flown.quaternion[0], state.quaternion, atol=2e-3)
    np.testing.assert_allclose(pair.rotor_force, state.rotor_force, atol=3e-3)
    share = config.plant.moving_fraction
    expected = share * state.ball_offset if preset == "stand" else 0.03 * np.sin(1.0)
    assert pair.cg_offset == pytest.approx(float(expected), abs=3e-4)


@pytest.mark.parametrize("preset", PRESETS)
def test_it_stands_takes_off_and_comes_to_rest_again(preset: str) -> None:
    pair = pair_of(configs.preset(preset))
    rest = run(pair, (0, 0, 0, 0), 1.0)
    assert np.abs(rest.position[:, 2]).max() < 2e-4  # contact gives way by a fifth of a millimetre at most
    np.testing.assert_allclose(rest.specific_force, [[0, 0, 9.81]] * 2, atol=1e-2)
    risen = run(pair, (0, 0, 0, 47000), 2.0)
    assert (risen.position[:, 2] > 0.2).all()
    run(pair, (0, 0, 0, 44000), 4.0)
    down = run(pair, (0, 0, 0, 0), 2.0)
    assert np.abs(down.position[:, 2]).max() < 2e-4
    assert abs(tilt_of(down)) < 1e-3
    assert np.abs(down.rates).max() < 1e-3
    assert np.abs(down.velocity).max() < 1e-2


def test_a_fall_does_not_go_through_the_floor() -> None:
    pair = pair_of(configs.preset("flight"))
    run(pair, (0, 0, 0, 55000), 1.0)
    lowest = min(float(run(pair, (0, 0, 0, 0), 0.02).position[:, 2].min()) for _ in range(100))
    assert lowest > -0.033  # the floor under the legs: at 6 m/s contact gives way by centimetres, centres stay above


@pytest.mark.parametrize("preset", PRESETS)
def test_the_stand_locks_what_it_locks(preset: str) -> None:
    pair = pair_of(configs.preset(preset))
    state = run(pair, (3.0, 1.0, 0.0, 48000), 2.0)
    assert (state.position[:, 0] == 0).all() == (preset == "stand")
    assert abs(tilt_of(state)) > 0.01


def overshoot(pair: CoupledPair, config: Config) -> float:
    """Largest roll after a step of 5 degrees, over the step."""
    pair.place(start_of(config, 0.0)._replace(quaternion=np.array([1.0, 0, 0, 0]), velocity=np.zeros(3)))
    rolls = [np.degrees(tilt_of(run(pair, (5.0, 0, 0, 46000), PERIOD))) for _ in range(300)]
    return max(rolls) / 5.0 - 1.0


def test_uploaded_gains_matter() -> None:
    """Stock gains on a stick that makes roll 50 times heavier swing; those of the metadata do not."""
    config = configs.preset("flight")
    still = Conditions(config.plant.object_mass)
    assert overshoot(CoupledPair(config, still, OLDER, EXACT), config) > 0.5
    assert overshoot(pair_of(config, still), config) < 0.25


def test_each_drone_has_gains_of_its_own() -> None:
    config = configs.preset("flight")
    alike = configs.replace(config, "autopilot.follower_ki_scale", 1.0)
    one, other = pair_of(alike), pair_of(alike)
    assert one.onboard._alike
    other.onboard._alike = False  # the way that is taken once gains differ
    np.testing.assert_allclose(run(one, (4, 2, 5, 47000), 0.5).position, run(other, (4, 2, 5, 47000), 0.5).position)
    shared = pair_of(config)
    assert shared.onboard._alike  # ki that differ by one factor are stepped at once too
    apart = pair_of(config)
    apart.onboard._alike = False
    np.testing.assert_allclose(run(shared, (4, 2, 5, 47000), 0.5).position, run(apart, (4, 2, 5, 47000), 0.5).position)
    one.set_parameter(0, "pid_rate.roll_kp", 100.0)
    assert not one.onboard._alike
    assert [controller.roll_rate[0] for controller in one.onboard._autopilots] == [100.0, config.autopilot.roll_rate[0]]


def test_gains_by_name() -> None:
    assert len(PARAMETERS) == 18
    assert gains_of(STOCK)["pid_rate.yaw_ki"] == 16.7
    config = configs.preset("flight").autopilot
    assert with_gains(STOCK, gains_of(config)) == dataclasses.replace(
        STOCK, **{field: getattr(config, field) for field, _ in PARAMETERS.values()}
    )


@pytest.mark.parametrize("preset", PRESETS)
def test_whatever_is_sent_the_state_stays_finite(preset: str) -> None:
    pair, random = CoupledPair(configs.preset(preset)), np.random.default_rng(5)
    for _ in range(60):
        row = random.uniform(-180, 180, (2, 3)), random.choice([0.0, 1000.0, 30000.0, 65535.0], (2, 1))
        for _ in range(20):
            state = pair.advance(np.hstack(row), PERIOD)
        assert all(np.isfinite(leaf).all() for leaf in (*state[:-1], *state.report))
        assert np.abs(state.position).max() < 100
    again = pair.start()
    assert np.abs(again.position[:, 2]).max() < 2e-4


@pytest.mark.parametrize("preset", PRESETS)
def test_elastic_mounts(preset: str) -> None:
    """Drones that swing against each other in a fall: at the mounts' frequency, seen by each one's own sensors."""
    frequency, config = 25.0, configs.preset(preset)
    conditions = Conditions(config.plant.object_mass)
    pair = pair_of(config, conditions, around=dataclasses.replace(EXACT, mount=Mount(frequency, 0.02)))
    state, swing = start_of(config, 0.0), np.array([[0.5, 0.0], [-0.5, 0.0]])
    still = state._replace(rotor_force=np.zeros((2, 4)), rates=np.zeros(3), mount_angle=0 * swing, mount_rate=swing)
    placed = pair.place(still)
    np.testing.assert_allclose(placed.rates, [[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]], atol=1e-9)
    angle = []
    for _ in range(200):
        flown = pair.advance(np.zeros((2, 4)), 0.001)
        both = rotations.euler_from_matrix(rotations.matrix_from_quaternion(flown.quaternion))
        angle.append(float(both[0, 0] - both[1, 0]) / 2)
        # The gyroscope's sample is a millisecond older: 0.16 rad of phase.
        np.testing.assert_allclose(flown.rates, flown.report.rates, atol=0.2 * 0.5)
    time = 0.001 * np.arange(1, 201)
    crossed = np.flatnonzero(np.diff(np.sign(angle)))
    when = [time[i] - 0.001 * angle[i] / (angle[i + 1] - angle[i]) for i in crossed]
    period = 2 * (when[-1] - when[0]) / (len(when) - 1)
    # Linear interpolation of a sine's crossing, and the damped frequency, 2e-4 lower.
    assert 1 / period == pytest.approx(frequency, rel=1e-3)
