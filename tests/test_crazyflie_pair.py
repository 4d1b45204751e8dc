"""One Crazyflie against published responses, and two on a stick in the full physics."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import pytest
from attitude_trials import Body, Trial
from attitude_trials import simulate as simulate_attitude

from mjxball.config import Autopilot, Config, preset
from mjxball.control import crazyflie, rotations
from mjxball.errors import InputError
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import hover_rotor_force, make_numpy_plant_step, make_plant_step, start_state
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

OLDER = (0.0915, 0.0677)  # force of a motor without battery compensation [N]
PAIR = preset("flight")
# Published inertias run from 0.94e-5 to 1.68e-5 kg m2; ours is near the upper end.
INERTIA, MASS = (1.66e-5, 1.66e-5, 2.93e-5), 0.027
DELIVERED = Autopilot(kind="crazyflie", motor_curve=(0.0, 0.12))


class TestSingleDrone:
    """A roll step of 10 degrees at 50 ms motor lag: the firmware itself takes 0.144 s to 63 % and overshoots by 6 %."""

    @pytest.fixture(scope="class")
    def steps(self) -> dict[int, tuple[float, float]]:
        scales = (1, 15, 30, 45, 60)
        hover = float(crazyflie.motor_command(DELIVERED.motor_curve, np.array(MASS * 9.81 / 4)))
        drone = Body(np.array(INERTIA), hover, arm=0.046, yaw_per_thrust=0.006, drones=1)
        angle = simulate_attitude(drone, DELIVERED, [Trial((10, 0, 0), inertia=scale) for scale in scales], 6.0)
        share = angle[..., 0] / 10
        rise = np.argmax(share >= 0.632, axis=0) * crazyflie.PERIOD
        overshoot = 100 * (share.max(axis=0) - 1)
        peaks = {scale: (float(rise[n]), float(overshoot[n])) for n, scale in enumerate(scales)}
        self.__class__.angle = angle
        return peaks

    def test_response(self, steps) -> None:
        rise, overshoot = steps[1]
        assert rise == pytest.approx(0.144, rel=0.1)
        assert overshoot == pytest.approx(6, abs=3)

    @pytest.mark.parametrize(("scale", "overshoot"), [(15, 51), (30, 82)])
    def test_overshoot_at_a_multiple_of_the_inertia(self, steps, scale: int, overshoot: float) -> None:
        assert steps[scale][1] == pytest.approx(overshoot, abs=3)

    def test_it_diverges_from_45_times_on(self, steps) -> None:
        """The swing about the command grows from 45 times on and shrinks at 30."""
        swing = np.abs(self.angle[..., 0] - 10)
        early, late = swing[:1500].max(axis=0), swing[1500:].max(axis=0)
        assert (late[3:] > early[3:]).all()
        assert (late[:3] < early[:3]).all()


def still_load(worlds: int = 1) -> Load:
    zero, mass = np.zeros(worlds), np.full(worlds, PAIR.plant.object_mass)
    return Load(mass, mass, zero, zero, zero, np.zeros((worlds, 0)), np.zeros((worlds, 0)))


def flown(config: Config, command: Sequence[Any], seconds: float) -> PlantState:
    """The state after both drones were sent `command` from a hover at rest."""
    step, load = make_numpy_plant_step(config, "newton-euler"), still_load()
    zero = np.zeros((1, 3))
    state = start_state(config, zero, zero, zero, load.believed_mass, np.zeros(1))
    for _ in range(round(seconds / config.timing.control_period)):
        state = step(state, np.broadcast_to(np.array(command), (1, 2, 3)), load)
    return state


def euler_of(state: PlantState) -> np.ndarray:
    return np.degrees(rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion)))[0]


class TestPair:
    def test_roll_command_raises_roll_and_moves_toward_minus_y(self) -> None:
        state = flown(PAIR, (np.radians(8), 0.0, 0.0), 1.5)
        assert euler_of(state)[0] == pytest.approx(8, abs=1)
        assert state.position[0, 1] < -0.3
        assert abs(state.position[0, 0]) < 1e-6

    def test_pitch_command_moves_toward_plus_x(self) -> None:
        state = flown(PAIR, (0.0, np.radians(8), 0.0), 1.5)
        assert euler_of(state)[1] == pytest.approx(8, abs=1)
        assert state.position[0, 0] > 0.3
        assert abs(state.position[0, 1]) < 1e-3  # the two drones' outputs differ and are truncated to whole units

    def test_integrals_of_two_drones_fight(self) -> None:
        """Told pitches 3 degrees apart, two that integrate turn their motors ever further apart; one alone does not."""
        apart = [[0.0, np.radians(1.5), 0.0], [0.0, np.radians(-1.5), 0.0]]

        def spread(share: float, seconds: float) -> float:
            autopilot = dataclasses.replace(PAIR.autopilot, follower_ki_scale=share)
            return float(np.ptp(flown(dataclasses.replace(PAIR, autopilot=autopilot), apart, seconds).rotor_force))

        assert spread(1.0, 10.0) > 1.2 * spread(1.0, 3.0) > 0.04  # of 0.09 N in hover
        assert spread(0.0, 10.0) == pytest.approx(spread(0.0, 3.0), rel=0.1)
        assert spread(0.0, 10.0) < 0.02

    def test_calibrated_thrust_climbs_as_asked(self) -> None:
        state = flown(PAIR, (0.0, 0.0, 1.0), 1.0)
        # The motors' lag of 50 ms costs that much of the time.
        assert state.velocity[0, 2] == pytest.approx(0.95, abs=0.01)

    def test_papers_thrust_climbs_a_quarter_of_it(self) -> None:
        """1000 units on the older curve, 1634 on the newer one, are 24 mN on eight motors: 0.32 m/s2 of 75.5 g."""
        paper = dataclasses.replace(PAIR, autopilot=preset("stand").autopilot)
        state = flown(paper, (0.0, 0.0, 1.0), 1.0)
        assert 0.2 < state.velocity[0, 2] / 0.95 < 0.35

    def test_hover_is_the_same_in_both_units(self) -> None:
        """The force at which the rotors start is what the first setpoint asks for."""
        state = flown(PAIR, (0.0, 0.0, 0.0), 1.0)
        expected = hover_rotor_force(PAIR, still_load().believed_mass)
        np.testing.assert_allclose(state.rotor_force, expected, atol=2e-6)  # half a unit is 1.5e-6 N

    def test_numpy_and_jax_step_the_same(self) -> None:
        """Two control steps of 64 disturbed pairs, cascade, motors, lag and body."""
        random, worlds = np.random.default_rng(3), 64
        load, zero = still_load(worlds), np.zeros((worlds, 3))
        tilt = random.uniform(-0.1, 0.1, (worlds, 3))
        state = start_state(PAIR, zero, tilt, random.normal(size=(worlds, 3)), load.believed_mass, np.zeros(worlds))
        state = state._replace(rates=random.normal(size=(worlds, 3)))
        commands = random.uniform(-1, 1, (worlds, 2, 3)) * np.array([0.2, 0.2, 3.0])
        with jax.enable_x64(True):
            reached = []
            for move in (lambda value: value, lambda value: jax.tree.map(jax.numpy.asarray, value)):
                step = make_plant_step(PAIR, newton_euler.make_engine(PAIR.plant, PAIR.attitude))
                now, acting, sent = move(state), move(load), move(commands)
                for _ in range(2):
                    now = step(now, sent, acting)
                reached.append(now)
        for name, ours, theirs in zip(PlantState._fields, *reached, strict=True):
            if name.startswith("mount_"):  # rigid mounts
                assert ours is theirs is None
                continue
            # An ulp before a truncation moves a motor by a unit: 3e-6 N, 1e-5 of hover; through the body less.
            scale = np.abs(ours).max() or 1.0
            assert np.abs(np.asarray(theirs) - ours).max() < 2e-5 * scale, name


@pytest.mark.slow
def test_the_flight_policy_goes_where_waypoints_lead() -> None:
    corners = ((0.4, 0.0, 0.4), (0.4, 0.4, 0.4))
    path = ((12.0, corners[1]), (24.0, (0.0, 0.0, 0.0)))
    scenario = Scenario(omega=0.7, amplitude=0.013, mass=0.0175, goal=corners[0], waypoints=path, seconds=36.0)
    flown = simulate(PAIR, Policy.load(shipped_policy("flight")), scenario, "newton-euler")
    for number, place in enumerate((*corners, (0.0, 0.0, 0.0))):
        end = flown.position[round(12 * (number + 1) / PAIR.timing.control_period) - 1]
        assert np.linalg.norm(end - place) < 0.03


def test_a_policy_of_another_rate_is_refused() -> None:
    with pytest.raises(InputError, match="made for a control period"):
        simulate(preset("paper"), Policy.load(shipped_policy("flight")))
