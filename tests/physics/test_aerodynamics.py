"""Air, attitude loops and attitude errors against published values and closed forms, and alike on all engines."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants import copying

from mjxball.config import Config, preset, replace, with_plant
from mjxball.control import rotations
from mjxball.physics.aerodynamics import ground_effect
from mjxball.physics.step import make_numpy_plant_step
from mjxball.plant.rotors import blocked_shares
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.goals import GoalMotion
from mjxball.sim.rollout import load_of, simulate, simulate_batch, start_of
from mjxball.sim.scenario import CgPath, Scenario

PAPER = preset("paper")
STILL = Scenario(amplitude=0.0, goal=(0.0, 0.0, 0.0), seconds=60.0)
EVERYTHING = Scenario(
    seconds=6.0,
    omega=2.0,
    disturbance=Disturbance(
        noise=1.0,
        delay=0.04,
        gust=0.1,
        estimator_drift=1.0,
        offset=1.0,
        pose_lag=0.02,
        gap_rate=0.5,
        jitter=0.01,
        seed=3,
    ),
    loop_scale=1.4,
    rotor_drag=0.3,
    wind=(1.5, -1.0, 0.0),
    floor=-0.1,
    download=0.1,
    thrust_fade=0.001,
    goal_motion=GoalMotion(velocity=(0.1, 0.0, 0.05), until=3.0, radius=0.4, speed=0.5, phase=1.0),
)


def rested(scenario: Scenario, config: Config = PAPER) -> np.ndarray:
    """Error of O at the end of a flight of the PD leader and its copy [m]."""
    return simulate(config, copying(config), scenario, "newton-euler").error[-1]


def test_ground_effect_has_the_published_values() -> None:
    # A Crazyflie's, rotors of 23.1 mm on arms of 46 mm, as the formula of Sanchez-Cuevas et al. gives them.
    np.testing.assert_allclose(ground_effect(np.array([0.02, 0.05]), 0.0231, 0.046), [1.18, 1.08], atol=5e-3)
    # Far apart each rotor is alone: Cheeseman and Bennett's 1 / (1 - (R / 4 z)^2).
    height = np.array([0.05, 0.1, 0.3])
    np.testing.assert_allclose(ground_effect(height, 0.05, 100.0), 1 / (1 - (0.05 / 4 / height) ** 2), rtol=1e-6)
    assert ground_effect(np.array(0.0), 0.05, 0.1) == ground_effect(np.array(0.025), 0.05, 0.1)


def test_the_ground_lifts_as_statics_says() -> None:
    """Near the ground thrust is f times what is asked: f (g + kp e) = g, so that e = -g (1 - 1 / f) / kp."""
    for clearance in (0.1, 0.2):
        # The pair hovers at the height where the error that it leaves is that of its height above the ground.
        error = rested(dataclasses.replace(STILL, floor=-clearance))
        factor = ground_effect(clearance - error[2], 0.06, 0.12)
        assert error[2] == pytest.approx(-9.81 * (1 - 1 / factor) / 0.5, rel=1e-4)


def test_steady_wind_shifts_the_pair_as_statics_says() -> None:
    """At rest in wind w the drones feel F = k (m1 + m2) w, and PD controllers of kp leave e = -F / (M kp).

    The pair leans by F / (M g) against it; in the plane of its rotors the drag then lifts by F times that angle.
    """
    error = rested(dataclasses.replace(STILL, rotor_drag=0.3, wind=(0.0, 0.4, 0.0)))
    a = 0.3 * 2.0 * 0.4 / 2.2
    np.testing.assert_allclose(error, [0.0, -a / 0.5, -a * a / 9.81 / 0.5], atol=2e-5)  # third order of the angle


def test_drag_slows_a_pair_that_only_holds_its_attitude() -> None:
    """Without control of position v' = -k m v / M, m of the drones and M of all, with v from before each step."""
    step, load = (
        make_numpy_plant_step(PAPER, "newton-euler"),
        load_of(PAPER, [dataclasses.replace(STILL, rotor_drag=0.5)]),
    )
    state = start_of(PAPER, [dataclasses.replace(STILL, start_velocity=(0.0, 1.0, 0.0))])
    for _ in range(100):
        state = step(state, np.zeros((1, 2, 3)), load)
    # Drag acts at the height of O, without a torque.
    assert state.velocity[0, 1] == pytest.approx((1 - 0.5 * 2.0 / 2.2 * 0.005) ** 400, rel=1e-9)


def test_download_sags_the_pair_by_what_its_inner_rotors_lose() -> None:
    """One rotor of four, wholly above the object, loses a share d: (1 - d / 4) (g + kp e) = g."""
    np.testing.assert_array_equal(blocked_shares(PAPER.plant), [[0, 0, 1, 0], [1, 0, 0, 0]])
    error = rested(dataclasses.replace(STILL, download=0.2))
    np.testing.assert_allclose(error, [0.0, 0.0, 9.81 * (1 / 0.95 - 1) / 0.5], atol=1e-6)
    plate = blocked_shares(with_plant(PAPER, "plate4").plant)
    # Drones at the corners of a square plate: both inner rotors of each stand on an edge, half of their wake over it.
    np.testing.assert_allclose(np.sort(plate, axis=1), [[0, 0, 0.5, 0.5]] * 4, atol=1e-12)


def test_a_factor_on_the_attitude_loops_is_another_natural_frequency() -> None:
    faster = replace(PAPER, "attitude.natural_frequency", (20.0, 20.0, 8.0))
    scenario = Scenario(seconds=3.0, omega=2.0)
    scaled = simulate(PAPER, copying(PAPER), dataclasses.replace(scenario, loop_scale=2.0), "newton-euler")
    np.testing.assert_allclose(
        scaled.position, simulate(faster, copying(faster), scenario, "newton-euler").position, atol=1e-12
    )


def test_an_attitude_error_of_one_drone_turns_the_pair_by_half_of_it() -> None:
    """Two equal loops rest where Kp (0 - angle - error) + Kp (0 - angle) = 0, about roll, pitch and yaw."""
    step, load = make_numpy_plant_step(PAPER, "newton-euler"), load_of(PAPER, [STILL])
    error = np.array([[[0.0, 0.0, 0.0], [0.01, -0.02, 0.03]]])
    state = start_of(PAPER, [STILL])
    for _ in range(300):
        state = step(state, np.zeros((1, 2, 3)), load._replace(attitude_error=error))
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
    np.testing.assert_allclose(euler, -error[:, 1] / 2, atol=1e-4)  # products of angles


def test_late_commands_leave_the_last_ones_in_force() -> None:
    step, load, state = make_numpy_plant_step(PAPER, "newton-euler"), load_of(PAPER, [STILL]), start_of(PAPER, [STILL])
    new, old = np.array([[[0.1, 0.0, 1.0], [0.0, 0.1, 0.0]]]), np.array([[[-0.1, 0.2, 0.0], [0.0, 0.0, 1.0]]])
    late = [step(state, new, load._replace(late=np.array([float(k)]), last_commands=old)).rates for k in range(5)]
    np.testing.assert_array_equal(late[0], step(state, new, load).rates)
    np.testing.assert_array_equal(late[4], step(state, old, load).rates)
    assert (np.abs(np.diff(late, axis=0)).max(axis=(1, 2)) > 1e-3).all()


@pytest.mark.parametrize("plant", ["pair", "team4"])
def test_engines_agree_with_every_effect_at_once(plant: str) -> None:
    config = PAPER if plant == "pair" else with_plant(PAPER, plant)
    path = {} if plant == "pair" else {"path": CgPath(width=0.5, lead=1.0), "amplitude": 0.03}
    flown = dataclasses.replace(EVERYTHING, **path)
    flights = [simulate(config, copying(config), flown, engine) for engine in ("newton-euler", "mjx", "mujoco")]
    assert np.abs(flights[0].euler).max() > 0.05  # it is no hover
    for flight in flights[1:]:
        np.testing.assert_allclose(flight.position, flights[0].position, atol=1e-10)
        np.testing.assert_allclose(flight.contact_force, flights[0].contact_force, atol=1e-8)


def test_every_effect_changes_the_flight_and_none_harms_a_neighbour() -> None:
    plain, still = Scenario(seconds=6.0, omega=2.0), Scenario()
    names = ("loop_scale", "rotor_drag", "floor", "download", "thrust_fade", "goal_motion", "disturbance")
    alone = [plain, *(dataclasses.replace(plain, **{name: getattr(EVERYTHING, name)}) for name in names)]
    together = simulate_batch(PAPER, [(copying(PAPER), alone)], "newton-euler")
    for number, scenario in enumerate(alone):
        single = simulate(PAPER, copying(PAPER), scenario, "newton-euler")
        np.testing.assert_allclose(together.world(number).position, single.position, atol=1e-9)
        if number:
            assert np.abs(single.error - together.world(0).error).max() > 1e-4, names[number - 1]
    assert all(getattr(EVERYTHING, name) != getattr(still, name) for name in names)


def test_the_contact_wrenches_carry_the_objects_motion_through_the_air() -> None:
    """Forces on the object add up to its mass times its acceleration, minus gravity: sum F_i = m (a + g)."""
    config = PAPER
    flight = simulate(
        config, copying(config), dataclasses.replace(EVERYTHING, disturbance=Disturbance(), amplitude=0.0)
    )
    matrix = rotations.matrix_from_quaternion(flight.quaternion)
    world = np.einsum("tij,tnj->ti", matrix, flight.contact_force)
    # Central differences of the recorded velocity, 20 ms apart, of a smooth flight.
    acceleration = np.gradient(flight.velocity, flight.time, axis=0)
    expected = 0.2 * (acceleration + np.array([0.0, 0.0, 9.81]))
    np.testing.assert_allclose(world[50:-1], expected[50:-1], atol=2e-3)
