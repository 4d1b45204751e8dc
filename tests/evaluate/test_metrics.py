"""Every metric on flights made by hand."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.config import preset
from mjxball.evaluate.metrics import Metrics, measure, measure_batch, results, rotor_limits
from mjxball.evaluate.running_metrics import begin, update
from mjxball.sim.scenario import Scenario
from mjxball.sim.trajectory import Trajectory

TIME = np.arange(1501) * 0.02  # 30 s
GOAL = np.array([1.0, -2.0, 0.0])


def flight(position: np.ndarray, **parts: Any) -> Trajectory:
    """A level flight at rest attitude whose commands are zero, unless `parts` say otherwise."""
    n = len(position)
    zero = {3: np.zeros((n, 3)), 0: np.zeros(n)}
    common = {
        "time": TIME[:n],
        "position": position,
        "velocity": zero[3],
        "euler": zero[3],
        "rates": zero[3],
        "quaternion": np.tile([1.0, 0, 0, 0], (n, 1)),
        "rotor_force": np.full((n, 2, 4), 2.0),
        "leader_command": zero[3],
        "follower_command": zero[3],
        "observation": np.zeros((n, 18)),
        "cg_offset": zero[0],
        "object_mass": zero[0],
        "contact_force": np.zeros((n, 2, 3)),
        "contact_torque": np.zeros((n, 2, 3)),
        "target": np.tile(GOAL, (n, 1)),
        "diverged": np.zeros(n, bool),
    }
    return Trajectory(**{**common, **parts})


def approach(rate: float = 1.0) -> np.ndarray:
    """|e_o| falls as exp(-rate t) on a straight line."""
    return GOAL * (1 - np.exp(-rate * TIME))[:, None]


def of(trajectory: Trajectory) -> Metrics:
    return measure(trajectory, termination_distance=2.5)


def test_means_of_ten_minutes_of_equal_steps_in_float32() -> None:
    """Rounding always the same way adds up: the mean power was 0.04 % off, that of a day 2.4 %."""
    steps, still = round(600 / 0.02), {"target": np.zeros((1, 3)), "follower_command": np.full((1, 3), 0.0123)}
    one = flight(np.zeros((1, 3)), rotor_force=np.full((1, 2, 4), 0.6419), **still)
    row = jax.tree.map(jnp.asarray, one.batched().row(0))  # in float32
    running = begin(row.position, row.target, jnp.full((1, 2, 4), 0.63))
    later = jax.jit(lambda given: jax.lax.fori_loop(0, steps, lambda _, one: update(one, row, 2.5, 5.5), given))
    found = results(later(running))[0]
    # 1e-6: eight roundings of 6e-8 each in one step.
    assert found.rotor_power == pytest.approx((0.6419 / 0.63) ** 1.5, rel=1e-6)
    assert found.action_error == pytest.approx(0.0123, rel=1e-6)
    assert found.effort == pytest.approx(0.0119, rel=1e-5)  # a difference of larger numbers


def test_exponential_approach() -> None:
    found = of(flight(approach()))
    distance = np.linalg.norm(GOAL)
    # Samples of exp(-2 t): their mean over 20 s is 1 / 40 up to the sampling's end effects.
    assert found.rmse == pytest.approx(distance * np.sqrt(np.mean(np.exp(-2 * TIME[:1001]))))
    assert found.settling_time == pytest.approx(np.floor(np.log(50) / 0.02) * 0.02)
    assert found.overshoot == pytest.approx(-np.exp(-30.0), abs=1e-9)
    assert (found.x_peak, found.y_peak) == pytest.approx((np.exp(-20.0), 2 * np.exp(-20.0)))
    assert (found.z_peak, found.max_tilt, found.action_error, found.paper_return) == (0, 0, 0, 0)
    assert (found.effort, found.smoothness, found.saturation, found.failed) == (0, 0, 0, False)


def test_never_settled_short_and_overshooting_flights() -> None:
    assert of(flight(approach(0.1))).settling_time is None
    short = of(flight(approach()[:1001]))  # ends at 20 s
    assert (short.x_peak, short.settling_time) == (None, pytest.approx(3.9, abs=0.02))
    beyond = approach()
    beyond[700] = [1.3, -2.0, 0.0]
    assert of(flight(beyond)).overshoot == pytest.approx(0.3)


def test_overshoot_counts_towards_the_goal_on_either_side() -> None:
    beyond = approach()
    beyond[700] = [1.0, -2.2, 0.0]
    assert of(flight(beyond)).overshoot == pytest.approx(0.1)


def test_commands_and_rotors() -> None:
    command = np.zeros((1501, 3))
    command[1::2, 1] = 0.1  # pitch jumps up and down at every step
    rotors = np.full((1501, 2, 4), 2.0)
    rotors[750:, 1, 0] = 5.5
    found = of(flight(approach(), follower_command=command, rotor_force=rotors))
    assert found.smoothness == pytest.approx(0.1 / np.sqrt(2))
    assert found.action_error == pytest.approx(np.sqrt(0.01 * 750 / 1501 / 3))
    assert found.paper_return == pytest.approx(-10 * 0.1 * 500)
    assert found.saturation == pytest.approx(751 / 1501 / 4)
    assert found.effort == pytest.approx(np.sqrt(3.5**2 * 751 / 1501 / 4))


def test_time_with_a_rotor_at_its_limit() -> None:
    """A tenth of the time the leader's rotor stands nearly still, another tenth a follower's is near its own most."""
    rotors = np.full((1500, 3, 4), 2.0)
    rotors[:150, 0, 2] = 0.05
    rotors[150:300, 2, 1:3] = 2.98
    team = {"rotor_force": rotors, "follower_command": np.zeros((1500, 2, 3))}
    made = flight(approach()[:1500], **team)
    for most, share in ((5.5, 0.1), ((5.5, 5.5, 3.0), 0.2), ((np.nan, 5.5, 3.0), 0.1)):
        assert measure(made, 2.5, most).rotors_at_limit == pytest.approx(share)
    unknown = flight(approach()[:1500], **{**team, "rotor_force": rotors * np.nan})
    found = measure(unknown, 2.5)
    assert (found.rotors_at_limit, found.saturation, found.rotor_power) == (None, None, None)


def test_limits_are_those_of_the_drones_that_give_less_and_a_lost_one_has_none() -> None:
    plant = preset("team").plant
    weak, lost = Scenario(thrust=(1.0, 1.0, 0.8, 1.0, 1.0, 1.0)), Scenario(lost=((3, 10.0),))
    found = rotor_limits(plant, [Scenario(), weak, lost])
    assert found[0] == pytest.approx(np.full(6, plant.rotor_force_max))
    assert found[1] == pytest.approx(found[0] * [1, 1, 0.8, 1, 1, 1])
    assert np.flatnonzero(np.isnan(found[2])).tolist() == [3]


def test_power_of_the_rotors_over_that_of_hover() -> None:
    """Half the time two of eight rotors give four times what hovers: 8 times the power each."""
    rotors = np.full((1500, 2, 4), 1.0)
    rotors[750:, 0, :2] = 4.0
    assert of(flight(approach()[:1500], rotor_force=rotors)).rotor_power == pytest.approx((1 + (6 + 16) / 8) / 2)


def test_spread_of_the_followers_commands() -> None:
    """Two followers that pull against each other, 0.1 rad of pitch each; alike they have no spread."""
    apart = np.zeros((1501, 2, 3))
    apart[..., 1] = (0.1, -0.1)
    common = {"rotor_force": np.full((1501, 3, 4), 2.0)}
    found = of(flight(approach(), follower_command=apart, **common))
    assert found.command_spread == pytest.approx(np.sqrt(0.01 / 2))
    assert of(flight(approach(), follower_command=np.abs(apart), **common)).command_spread == pytest.approx(0)
    assert of(flight(approach())).command_spread is None


def test_the_first_command_is_no_change() -> None:
    command = np.tile([0.1, -0.2, 0.0], (20, 1))
    assert of(flight(approach()[:20], follower_command=command)).smoothness == 0


def test_tilt_is_the_hypotenuse() -> None:
    euler = np.zeros((1501, 3))
    euler[10] = (0.3, -0.4, 2.0)
    assert of(flight(approach(), euler=euler)).max_tilt == pytest.approx(0.5)


def test_failures() -> None:
    far = approach()
    far[100, 2] = 2.6
    assert of(flight(far)).failed
    assert of(flight(approach(), diverged=TIME > 29.0)).failed
    lost = approach()
    lost[50:] = np.nan
    found = of(flight(lost))
    assert (found.failed, found.settling_time, found.rmse) == (True, None, None)


def test_waypoints_start_settling_and_peaks_anew() -> None:
    target = np.tile(GOAL, (1501, 1))
    target[500:] = (0.0, 0.0, 0.0)  # at 10 s
    position = approach(5.0)
    position[500:] = GOAL * np.exp(-(TIME[500:] - TIME[500]))[:, None]
    found = of(flight(position, target=target))
    assert found.settling_time == pytest.approx(np.floor(np.log(50) / 0.02) * 0.02)
    assert found.x_peak == pytest.approx(np.exp(-10.0))  # from 20 s, 10 s after the waypoint
    assert found.overshoot is None


def test_a_batch_is_measured_as_its_flights() -> None:
    flights = [flight(approach(rate)) for rate in (0.1, 1.0, 3.0)]
    batch = Trajectory(TIME, *(np.stack(part, axis=1) for part in zip(*(one[1:] for one in flights), strict=True)))
    assert measure_batch(batch, 2.5) == [of(one) for one in flights]


def test_arrival_is_the_last_time_beyond_a_radius_of_each_flight() -> None:
    """An error that decays as exp(-t) from 1 m along x; a bump at 12 s, between two radii, brings it out again."""
    time = np.arange(1501) * 0.02
    error = np.exp(-time) + np.where(np.abs(time - 12.0) < 0.1, 0.03, 0.0)
    made = flight(np.stack([1.0 - error, 0 * time, 0 * time], axis=1), target=np.tile([1.0, 0.0, 0.0], (1501, 1)))
    wide, narrow, none = (measure(made, 2.5, radius=radius, deadline=10.0) for radius in (0.05, 0.02, np.nan))
    assert wide.arrival == pytest.approx(-np.log(0.05), abs=0.02)
    assert wide.reached == pytest.approx(wide.arrival, abs=0.021)
    assert narrow.reached == pytest.approx(-np.log(0.02), abs=0.02)
    assert narrow.arrival == pytest.approx(12.08, abs=0.021)
    assert wide.late_error == pytest.approx(0.03, abs=1e-4)
    assert (none.reached, none.arrival) == (None, None)
    never, before = measure(made, 2.5, radius=1e-15), measure(made, 2.5, radius=2.0)
    assert (never.reached, never.arrival, never.late_error) == (None, None, None)
    assert (before.reached, before.arrival) == (0.0, 0.0)


def test_share_at_a_limit_of_the_one_rotor_that_is_there_longest() -> None:
    """Three rotors in turn, each for a fifth of the time: some rotor is at a limit three fifths of it."""
    rotors = np.full((1500, 2, 4), 2.0)
    for number in range(3):
        rotors[300 * number : 300 * (number + 1), number % 2, number] = 5.49
    found = measure(flight(approach()[:1500], rotor_force=rotors), 2.5)
    assert found.rotor_limit_share == pytest.approx(0.2)
    assert found.rotors_at_limit == pytest.approx(0.6)
