"""The classical followers reproduce an independent simulation, and rest on gains that are right by themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mjxball.baselines import CONTROLLERS, linear, make_baseline, make_controller
from mjxball.baselines.assembly_model import assembly_model, ideal_model
from mjxball.config import preset, replace
from mjxball.control.followers import copy_gains
from mjxball.control.observation import ERROR_RATE, copy_command
from mjxball.errors import InputError
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.evaluate.scenarios import REFERENCE, cross
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import Scenario

SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)
CLIMB = ERROR_RATE.stop - 1  # of an observation, downwards
# From an independent float64 simulation, RK4 at 1 kHz, attitude loop at 500 Hz:
# settling [s], RMSE [m], x-peak [m] at SPEEDS, largest tilt [deg], paper return (first speed).
REFERENCE_NUMBERS = {
    "copy": (None, 0.520, (0.296, 0.258, 0.163, 0.050, 0.023), 3.7, 0),
    "adaptive": (8.2, 0.484, (0.002, 0.007, 0.011, 0.011, 0.010), 3.8, -211),
}


@pytest.fixture(scope="module")
def cells() -> dict[tuple[str, float], Result]:
    """Every baseline at every speed, closed-form physics."""
    config = preset("paper")
    followers = [make_baseline(name, config) for name in CONTROLLERS]
    flown = fly_scenarios(config, followers, cross(SPEEDS, [0.05], [0.2]), "newton-euler")
    return {(cell.follower, cell.scenario.omega): cell for cell in flown}


@pytest.mark.parametrize("name", REFERENCE_NUMBERS)
def test_reproduces_the_independent_simulation(cells, name: str) -> None:
    """Within 10 %, or 2 mm where values are that small."""
    settling, rmse, peaks, tilt, paper_return = REFERENCE_NUMBERS[name]
    metrics = cells[name, 0.31].metrics
    assert metrics.settling_time == (None if settling is None else pytest.approx(settling, rel=0.1))
    assert metrics.rmse == pytest.approx(rmse, rel=0.1)
    assert np.degrees(metrics.max_tilt) == pytest.approx(tilt, rel=0.1)
    assert metrics.paper_return == pytest.approx(paper_return, rel=0.1, abs=1e-6)
    for speed, peak in zip(SPEEDS, peaks, strict=True):
        assert cells[name, speed].metrics.x_peak == pytest.approx(peak, rel=0.1, abs=0.002), speed


def test_floors_are_worse_than_copying(cells) -> None:
    for name in ("stay", "random"):
        assert cells[name, 0.31].metrics.rmse > cells["copy", 0.31].metrics.rmse


def test_mass_adaptation_finds_an_unknown_mass() -> None:
    """Kept at 0.2 kg of belief the pair sags by dm g / (2 m kp); with adaptation the height comes back."""
    config = preset("paper")
    scenario = Scenario(mass=0.3, believed_mass=0.2, seconds=40.0)
    names = ("adaptive", "adaptive-mass")
    flown = simulate_batch(config, [(make_baseline(name, config), [scenario]) for name in names], "newton-euler")
    sags = dict(zip(names, flown.error[-1, :, 2], strict=True))
    expected = 0.1 * 9.81 / (2 * 1.1 * 0.5)
    assert sags["adaptive"] == pytest.approx(expected, rel=0.05)
    assert abs(sags["adaptive-mass"]) < 0.02


def test_sampled_model_is_the_integrated_one() -> None:
    """x' = A x + b u over 20 ms against 2000 steps of RK4."""
    random = np.random.default_rng(0)
    a, b, x = random.normal(size=(4, 4)), random.normal(size=(4, 2)), random.normal(size=4)
    u, step, end = np.array([0.3, -0.7]), 1e-5, x.copy()
    for _ in range(2000):
        k1 = a @ end + b @ u
        k2 = a @ (end + step / 2 * k1) + b @ u
        k3 = a @ (end + step / 2 * k2) + b @ u
        k4 = a @ (end + step * k3) + b @ u
        end = end + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    transition, drive = linear.discretise(a, b, 0.02)
    np.testing.assert_allclose(transition @ x + drive @ u, end, rtol=1e-11)


def test_adaptive_polynomial_is_stable_as_designed() -> None:
    """J p^3 + K p^2 + K w p + K w^2 r / 2 is Hurwitz iff 2 K > J w r."""
    from mjxball.baselines.adaptive import BANDWIDTH, RATIO

    plant = ideal_model(preset("paper"), "adaptive")
    k, inertia = 2 * plant.kd[1], plant.inertia[1]
    roots = np.roots([inertia, k, k * BANDWIDTH, k * BANDWIDTH**2 * RATIO / 2])
    assert roots.real.max() < -1
    assert 2 * k > inertia * BANDWIDTH * RATIO


def test_gains_follow_the_plant() -> None:
    """Section 3: per-drone Kp 3.22, Kd 0.579 in pitch; they move with the attitude loop's frequency."""
    config = preset("paper")
    plant = ideal_model(config, "lqg")
    assert (plant.kp[1], plant.kd[1], plant.inertia[1]) == pytest.approx((3.22, 0.579, 0.0644), rel=2e-3)
    slower = ideal_model(replace(config, "attitude.natural_frequency", (10.0, 5.0, 4.0)), "lqg")
    assert slower.kp[1] == pytest.approx(plant.kp[1] / 4)


def test_stands_are_refused_in_one_sentence() -> None:
    with pytest.raises(InputError, match="that fly freely"):
        make_controller("lqg", replace(preset("paper"), "plant.stand", "heave"))


def test_every_baseline_commands_within_its_limits(cells) -> None:
    for (name, _), cell in cells.items():
        largest = np.abs(cell.flight.follower_command).max(axis=0)
        assert (largest <= np.array([0.6, 0.6, 6.0]) + 1e-12).all(), name


def test_reference_scenario_is_the_first_cell(cells) -> None:
    assert cells["copy", 0.31].scenario == REFERENCE


def test_observer_integrals_and_mpc_take_off_a_torque_and_a_mass_that_nobody_told() -> None:
    """A load at rest at 3 cm, 0.3 kg believed 0.2 kg: the PD controller alone stays away."""
    config, offset_free = preset("paper"), ("observer", "pid", "mpc")
    scenario = Scenario(omega=0.0, phase=math.pi / 2, amplitude=0.03, mass=0.3, believed_mass=0.2, seconds=45.0)
    names = ("copy", *offset_free)
    flown = simulate_batch(config, [(make_baseline(name, config), [scenario]) for name in names], "newton-euler")
    left = dict(zip(names, np.abs(flown.error[-1]).max(axis=-1), strict=True))
    assert left["copy"] > 0.1
    assert max(left["observer"], left["pid"]) < 2e-4, left
    assert left["mpc"] < 3e-3, left  # it forgets what it estimates, with time constants from 20 s on


def test_the_observer_sees_a_step_of_torque_and_of_lift_by_its_time_constants() -> None:
    """1 - (1 - w T)^k of it after k periods T, whatever the controller itself commands."""
    config = preset("paper")
    controller, pair, observation = make_controller("observer", config), assembly_model(config, "test"), np.zeros(18)
    bandwidth = np.array([controller.gains.torque_bandwidth, controller.gains.lift_bandwidth])
    step, state, seen = np.array([0.05 / pair.inertia[1], 0.4]), controller.start(observation), []  # [rad/s2, m/s2]
    for _ in range(100):
        seen.append(bandwidth * (observation[10] - state.rate, -observation[CLIMB] - state.climb))
        state, command = controller.step(state, observation, None)
        both = copy_command(observation, *copy_gains(config)) + command
        turn = pair.kp[1] * (both[1] - 2 * observation[4]) - 2 * pair.kd[1] * observation[10]
        observation[4] += pair.period * observation[10]
        observation[10] += pair.period * (turn / pair.inertia[1] + step[0])
        observation[CLIMB] -= pair.period * (0.5 * both[2] + step[1])
    expected = step * (1 - (1 - bandwidth * pair.period) ** np.arange(100)[:, None])
    np.testing.assert_allclose(seen, expected, rtol=1e-9, atol=1e-12)


def test_the_pids_integrals_stand_still_where_they_would_wind_up() -> None:
    """Far away the command is at its limits; of a small error it integrates `gain` times the error."""
    config, privileged = preset("paper"), None
    controller = make_controller("pid", config)
    gains, period = controller.gains, config.timing.control_period
    resting = np.zeros(18)
    resting[4] = -1e-3  # pitch below the reference, which starts there
    state = controller.start(np.zeros(18))
    moved, _ = controller.step(state, resting, privileged)
    assert moved.pitch == pytest.approx(period * gains.pitch_integral * 1e-3, rel=1e-9)
    diving = np.zeros(18)
    diving[4] = 0.9  # the command is at -0.6 rad, and the error asks for less
    moved, command = controller.step(state, diving, privileged)
    assert command[1] == -config.command.tilt_limit
    assert moved.pitch == 0.0
    nudged = state._replace(pitch=np.asarray(3.0))  # at the limit on the other side: the error brings it back
    diving[4] = 0.2
    moved, command = controller.step(nudged, diving, privileged)
    assert command[1] == config.command.tilt_limit
    assert moved.pitch == pytest.approx(3.0 - period * gains.pitch_integral * gains.pitch_band)


def test_observer_and_pid_are_of_the_pair() -> None:
    for name in ("observer", "pid"):
        with pytest.raises(InputError, match="free pair along x"):
            make_controller(name, preset("team"))
