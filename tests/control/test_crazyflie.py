"""The Crazyflie's own control against its facts: docs/hardware.md has the sources."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjxball.cli import apply_plant
from mjxball.config import PLANTS, Autopilot, preset, replace, validate, with_plant
from mjxball.control import crazyflie, mixer
from mjxball.errors import InputError
from mjxfly import packets
from mjxfly.setpoints import CommandMap, ForceCurve, to_setpoint

STOCK = Autopilot(kind="crazyflie")
LEVEL, STILL = np.zeros(3), np.zeros(3)
HOVER = np.array([0.0, 0.0, 0.0, 46000.0])
OLDER, LINEAR = (0.0915, 0.0677), (0.0, 0.12)
VARIANTS = [name for name in PLANTS if name.startswith("crazyflie")]


def alone(**gains: tuple[float, float, float]) -> Autopilot:
    """A cascade with these gains and no others."""
    none = dict.fromkeys(("roll", "pitch", "yaw", "roll_rate", "pitch_rate", "yaw_rate"), (0.0, 0.0, 0.0))
    return dataclasses.replace(STOCK, **none | gains)


def tick(controller: Autopilot, setpoint=HOVER, euler=LEVEL, rates=STILL, loops=None):
    started = crazyflie.start_loops(LEVEL, STILL) if loops is None else loops
    return crazyflie.cascade(controller, started, np.asarray(setpoint, float), np.asarray(euler), np.asarray(rates))


def after(controller: Autopilot, ticks: int, **held):
    loops = crazyflie.start_loops(LEVEL, STILL)
    for _ in range(ticks):
        loops, motors = tick(controller, loops=loops, **held)
    return crazyflie.unpack(loops), motors


def outputs(motors: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw parts of unsaturated motor commands, as the mixer adds them."""
    m1, m2, m3, m4 = motors
    return np.array([m3 + m4 - m1 - m2, m1 + m4 - m2 - m3, m1 + m3 - m2 - m4]) / 4


class TestDelivered:
    def test_gains(self) -> None:
        assert (STOCK.roll, STOCK.pitch, STOCK.yaw) == ((6, 3, 0), (6, 3, 0), (6, 1, 0.35))
        assert (STOCK.roll_rate, STOCK.pitch_rate, STOCK.yaw_rate) == ((250, 500, 2.5), (250, 500, 2.5), (120, 16.7, 0))
        assert crazyflie.ATTITUDE_LIMITS[:2] == (20, 20)
        assert crazyflie.RATE_LIMITS[:2] == (33.3, 33.3)
        assert crazyflie.PERIOD == 1 / 500

    def test_first_tick_of_a_roll_command(self) -> None:
        """6 x 2 deg and 3 x 2 deg x 2 ms -> a rate; 250 and 500 x 2 ms of it -> 3015 units and the integral's 12."""
        _, motors = tick(STOCK, (2.0, 0.0, 0.0, 40000.0))
        rate = 6 * 2 + 3 * 2 * 0.002
        half = math.trunc(math.trunc(250 * rate + 500 * rate * 0.002) / 2)
        np.testing.assert_array_equal(motors, 40000 + half * np.array([-1, -1, 1, 1]))


class TestLoops:
    def test_attitude_integral_stops_at_its_limit(self) -> None:
        loops, _ = after(alone(roll=(0, 1, 0)), 1200, setpoint=(10.0, 0, 0, 4e4))
        assert loops.attitude_integral[0] == 20.0  # 10 deg for 2 s; 1200 ticks are 2.4 s

    def test_rate_integral_stops_at_its_limit(self) -> None:
        loops, motors = after(alone(roll_rate=(0, 100, 0)), 400, rates=np.radians([-50.0, 0, 0]))
        assert loops.rate_integral[0] == 33.3  # 50 deg/s for 0.67 s; 400 ticks are 0.8 s
        assert outputs(motors)[0] == pytest.approx(3330 / 2, abs=1)  # truncated twice

    def test_derivative_is_of_the_measurement(self) -> None:
        """A step of the command does not kick; a step of the angle does, against it."""
        controller = alone(roll=(0, 0, 1), roll_rate=(100, 0, 0))
        _, motors = tick(controller, (10.0, 0.0, 0.0, 4e4))
        np.testing.assert_array_equal(motors, 4e4)
        _, motors = tick(controller, euler=np.radians([0.1, 0, 0]))
        assert outputs(motors)[0] == math.trunc(-100 * 0.1 / 0.002 / 2)

    def test_yaw_rate_turns_the_yaw_to_hold_the_other_way(self) -> None:
        """+40 deg/s on the wire turns gyro.z to about -40."""
        loops, motors = after(alone(yaw=(1, 0, 0), yaw_rate=(100, 0, 0)), 500, setpoint=(0, 0, 40.0, 4e4))
        assert loops.yaw[0] == pytest.approx(-40.0)
        moment = mixer.wrench_from_rotors(motors, 0.046, 0.006, "x")[3]
        assert moment < 0  # clockwise from above

    def test_yaw_is_held_across_180_degrees(self) -> None:
        """Held at 179, found at -179: two degrees off, not 358."""
        loops = crazyflie.start_loops(np.radians([0, 0, 179.0]), STILL)
        _, motors = tick(alone(yaw=(1, 0, 0), yaw_rate=(100, 0, 0)), euler=np.radians([0, 0, -179.0]), loops=loops)
        assert outputs(motors)[2] == pytest.approx(200, abs=1)  # clockwise again, truncated

    @pytest.mark.parametrize("axis", range(3), ids=["roll", "pitch", "yaw"])
    def test_every_axis_is_turned_back(self, axis: int) -> None:
        """In our axes: the moment opposes angle and rate."""
        for what in ("euler", "rates"):
            _, motors = tick(STOCK, **{what: 0.05 * np.eye(3)[axis]})
            moment = mixer.wrench_from_rotors(crazyflie.motor_force(OLDER, motors), 0.046, 0.006, "x")[1:]
            assert moment[axis] < 0
            np.testing.assert_allclose(np.delete(moment, axis), 0, atol=1e-12)

    @pytest.mark.parametrize("thrust", [0.0, 999.0])
    def test_without_thrust_motors_stop_and_loops_are_reset(self, thrust: float) -> None:
        wound = np.full(13, 5.0)
        loops, motors = tick(STOCK, (5.0, 5.0, 0.0, thrust), euler=np.radians([1.0, 2.0, 3.0]), loops=wound)
        assert not motors.any()
        parts = crazyflie.unpack(loops)
        assert not parts.attitude_integral.any()
        assert not parts.rate_integral.any()
        np.testing.assert_allclose(parts.attitude, [1, -2, 3])
        np.testing.assert_allclose(parts.yaw, 3)

    def test_thrust_of_1000_turns_and_60000_is_the_most(self) -> None:
        np.testing.assert_array_equal(tick(STOCK, (0, 0, 0, 1000.0))[1], 1000)
        np.testing.assert_array_equal(tick(STOCK, (0, 0, 0, 65535.0))[1], 60000)


class TestMix:
    @given(*[st.integers(-8000, 8000)] * 3)
    def test_table(self, roll: int, pitch: int, yaw: int) -> None:
        """The firmware's table with its own yaw, which is minus ours."""
        motors = crazyflie.mix(np.array(40000.0), np.array([roll, pitch, -yaw], float))
        r, p = math.trunc(roll / 2), math.trunc(pitch / 2)
        expected = [40000 - r + p + yaw, 40000 - r - p - yaw, 40000 + r - p + yaw, 40000 + r + p - yaw]
        np.testing.assert_array_equal(motors, expected)

    def test_excess_is_taken_off_all_four(self) -> None:
        motors = crazyflie.mix(np.array(60000.0), np.array([20000.0, 0.0, 0.0]))
        np.testing.assert_array_equal(motors, [45535, 45535, 65535, 65535])  # 4465 off: the moment stays

    def test_a_motor_never_runs_backward(self) -> None:
        motors = crazyflie.mix(np.array(2000.0), np.array([32767.0, 0.0, 0.0]))
        assert motors.min() == 0

    def test_output_is_whole_and_limited(self) -> None:
        _, motors = tick(alone(roll_rate=(1e5, 0, 0)), rates=np.radians([-30.0, 0, 0]))
        assert motors[2] - motors[0] == 2 * math.trunc(32767 / 2)


class TestMotors:
    def test_older_firmware_at_full_power(self) -> None:
        assert crazyflie.motor_force(OLDER, np.array(65535.0)) == pytest.approx(0.159, abs=5e-4)

    def test_rig_hovers_at_the_papers_thrust(self) -> None:
        """75.5 g on eight motors at thr_hov = 46000."""
        plant = preset("flight").plant
        assert sum(drone.mass for drone in plant.drones) + plant.object_mass == pytest.approx(0.0755)
        assert crazyflie.motor_command(OLDER, np.array(0.0755 * 9.81 / 8)) == pytest.approx(46000, abs=50)

    @pytest.mark.parametrize("curve", [OLDER, LINEAR], ids=["older", "2026.04"])
    def test_1000_units_are_2_to_3_millinewtons(self, curve: tuple[float, float]) -> None:
        command = np.linspace(10001, 60000, 50)
        gained = crazyflie.motor_force(curve, command + 500) - crazyflie.motor_force(curve, command - 500)
        # 1.3 mN at the old curve's low end, far below any hover; 3.6 at its upper.
        hovering = (command > 30000) & (command < 50000)
        assert ((gained[hovering] > 1.8e-3) & (gained[hovering] < 3.2e-3)).all()

    @given(st.floats(0, 0.159), st.sampled_from(VARIANTS))
    def test_inverse(self, force: float, drone: str) -> None:
        curve = with_plant(preset("flight"), drone).autopilot.motor_curve
        command = crazyflie.motor_command(curve, np.array(force))
        assert crazyflie.motor_force(curve, command) == pytest.approx(force, abs=1e-12)

    def test_no_force_takes_no_command(self) -> None:
        assert crazyflie.motor_command(OLDER, np.array(-0.1)) == 0


class TestSent:
    @pytest.mark.parametrize("thrust_law", ["calibrated", "paper"])
    @pytest.mark.parametrize("curve", [OLDER, LINEAR], ids=["older", "2026.04"])
    @given(
        st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-8, 8)),
        st.floats(0.03, 0.045),
    )
    def test_simulation_and_flight_send_the_same_numbers(self, thrust_law: str, curve, command, mass: float) -> None:
        config = dataclasses.replace(STOCK, thrust_law=thrust_law, motor_curve=curve)
        simulated = crazyflie.setpoints(config, np.array(command), np.array(mass), 9.81)
        free = CommandMap(thrust_law, carried_mass=mass, curve=ForceCurve(*curve))
        flown = to_setpoint(np.array(command), free).setpoint
        # float32 on the wire: 1e-7 of 15 degrees. A thrust half way between two units may round either way.
        np.testing.assert_allclose(simulated[:3], packets.unpack_setpoint(packets.pack_setpoint(flown))[:3], atol=2e-6)
        assert abs(simulated[3] - flown.thrust) <= (
            0 if thrust_law == "paper" and command[2] == round(command[2]) else 1
        )
        assert simulated[3] == round(simulated[3])
        assert packets.THRUST_FLOOR <= simulated[3] <= packets.THRUST_CEILING

    def test_signs_and_limits(self) -> None:
        sent = crazyflie.setpoints(STOCK, np.array([0.1, 0.5, 0.0]), np.array(0.03775), 9.81)
        np.testing.assert_allclose(sent[:3], [math.degrees(0.1), -15.0, 0.0])

    def test_both_know_the_same_bounds(self) -> None:
        assert (crazyflie.THRUST_FLOOR, crazyflie.THRUST_CEILING) == (packets.THRUST_FLOOR, packets.THRUST_CEILING)
        assert math.radians(crazyflie.TILT_LIMIT) == pytest.approx(CommandMap().tilt_limit)


class TestLayout:
    """M1 front right, M2 back right, M3 back left, M4 front left; M1 and M3 turn so that they push the body -z."""

    PLACES = 0.046 / math.sqrt(2) * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])

    @pytest.mark.parametrize("motor", range(4))
    def test_a_motor_pulls_at_its_place(self, motor: int) -> None:
        wrench = mixer.wrench_from_rotors(np.eye(4)[motor], 0.046, 0.006, "x")
        moment = np.cross(self.PLACES[motor], [0, 0, 1.0])
        np.testing.assert_allclose(wrench[1:], [*moment[:2], 0.006 * (-1, 1, -1, 1)[motor]], atol=1e-16)
        assert wrench[0] == 1

    @given(st.lists(st.floats(0, 0.159), min_size=4, max_size=4))
    def test_inverse(self, force: list[float]) -> None:
        back = mixer.rotors_from_wrench(mixer.wrench_from_rotors(np.array(force), 0.046, 0.006, "x"), 0.046, 0.006, "x")
        # Half a newton's ulp, times 1 / (4 0.006) = 42 through the yaw moment.
        np.testing.assert_allclose(back, force, atol=1e-14)


class TestRefused:
    """A rig that hovers on more than 70 % of its thrust is refused in one sentence."""

    @pytest.mark.parametrize("drone", VARIANTS)
    def test_variants_hover(self, drone: str) -> None:
        config = apply_plant(preset("flight"), Path(drone))
        assert config.plant.rotor_force_max == pytest.approx(sum(config.autopilot.motor_curve))
        assert config.autopilot.follower_ki_scale == 0.0  # only the leader's firmware integrates in any preset

    @pytest.mark.parametrize(
        ("drone", "mass", "force"), [("thrust-upgrade", 0.0345, 0.18), ("brushless", 0.0393, 0.20)]
    )
    def test_stronger_drones_bear_the_ball_at_its_stop(self, drone: str, mass: float, force: float) -> None:
        config = apply_plant(preset("flight"), Path(f"crazyflie-{drone}"))
        assert [one.mass for one in config.plant.drones] == [mass, mass]
        assert (config.plant.rotor_force_max, config.autopilot.motor_curve) == (force, (0.0, force))
        assert (config.scenario.cg_amplitude, config.scenario.uncompensated_probability) == ((0.0, 0.034), 0.0)

    def test_the_plain_drone_with_a_heavier_object_does_not(self) -> None:
        with pytest.raises(InputError, match="leaves 18%, where 20% are needed"):
            validate(replace(preset("flight"), "scenario.object_mass", (0.015, 0.022)))

    def test_too_heavy_a_load(self) -> None:
        with pytest.raises(InputError, match="thrust"):
            validate(replace(preset("flight"), "scenario.object_mass", (0.02, 0.06)))

    def test_loops_at_another_rate(self) -> None:
        with pytest.raises(InputError, match="500 Hz"):
            validate(replace(preset("flight"), "timing.physics_steps", 4))


def test_rounding_passes_a_gradient_and_rounds_all_the_same() -> None:
    jax = pytest.importorskip("jax")
    jnp, controller = jax.numpy, crazyflie.STOCK
    draw = np.random.default_rng(0).normal(size=(400, 3)) * [0.1, 0.1, 2.0]

    @jax.jit
    def sent(command: Any) -> Any:
        mass = jnp.full(command.shape[:-1], 0.0377, jnp.float32)
        return crazyflie.setpoints(controller, jnp.asarray(command, jnp.float32), mass, 9.81)

    thrust = np.asarray(sent(draw))[:, 3]
    assert (thrust == np.round(thrust)).all()
    slope = jax.jit(jax.grad(lambda az: sent(jnp.stack([0.0, 0.0, az]))[3]))(0.3)
    # The calibrated law's own slope: a step of 0.1 m/s2 moves the rounded thrust by as much, to a unit.
    step = float(sent(jnp.array([0.0, 0.0, 0.35]))[3] - sent(jnp.array([0.0, 0.0, 0.25]))[3])
    assert slope == pytest.approx(step / 0.1, abs=10.0)
    output = draw * 5000
    # In the same numbers JAX and NumPy mix the same, bit by bit.
    with jax.enable_x64(True):
        same = crazyflie.mix(jnp.full(400, 40000.0), jnp.asarray(output))
    np.testing.assert_array_equal(np.asarray(same), crazyflie.mix(np.full(400, 40000.0), output))
