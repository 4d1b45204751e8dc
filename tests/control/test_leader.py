"""The leader's PD controller (paper eq. 5) and the attitude gains, by hand."""

import numpy as np
import pytest

from mjxball.config import Attitude, Plant
from mjxball.control import leader
from mjxball.control.attitude import rotor_commands
from mjxball.plant import AttitudeGains, design_gains, plant_parameters

G = 9.81
TILT, VERTICAL = 0.6, 6.0
# Hand-computed values: a few products in float64.
ROUNDING = 1e-15


def command(acceleration, yaw=0.0):
    return leader.command(np.array(acceleration, float), yaw, G, TILT, VERTICAL)


def test_acceleration_is_pid():
    gains = np.array([0.5, 1.0, 2.0]), np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.0, 0.5])
    error, rate, integral = np.array([1.0, -2.0, 3.0]), np.array([0.5, 0.25, -1.0]), np.array([10.0, 7.0, 2.0])
    wanted = command([0.5 + 0.5 + 1.0, -2.0 + 0.5, 6.0 - 3.0 + 1.0])
    np.testing.assert_allclose(
        leader.pid_command(error, rate, integral, gains, G, TILT, VERTICAL), wanted, rtol=ROUNDING
    )


def test_forward_is_pitch_and_left_is_negative_roll():
    np.testing.assert_allclose(command([0.981, 0, 0]), [0, 0.1, 0], atol=ROUNDING)
    np.testing.assert_allclose(command([0, 0.981, 0]), [-0.1, 0, 0], atol=ROUNDING)
    np.testing.assert_allclose(command([0, 0, 1.5]), [0, 0, 1.5], atol=ROUNDING)


def test_yaw_turns_the_horizontal_command():
    np.testing.assert_allclose(command([0.981, 0, 0], yaw=np.pi / 2), [0.1, 0, 0], atol=ROUNDING)
    np.testing.assert_allclose(command([0, 0.981, 0], yaw=np.pi / 2), [0, 0.1, 0], atol=ROUNDING)
    diagonal = 0.1 * np.sqrt(0.5)
    np.testing.assert_allclose(command([0.981, 0, 0], yaw=np.pi / 4), [diagonal, diagonal, 0], atol=ROUNDING)


def test_small_command_accelerates_as_asked_at_any_yaw():
    """Thrust g along Rz(psi) Rx(phi) Ry(theta) e3 gives the wanted horizontal acceleration to first order."""
    for yaw in (-2.0, 0.3, 3.0):
        roll, pitch, _ = command([0.03, -0.02, 0], yaw)
        c, s = np.cos(yaw), np.sin(yaw)
        pull = G * np.array([[c, -s], [s, c]]) @ [np.sin(pitch), -np.sin(roll) * np.cos(pitch)]
        np.testing.assert_allclose(pull, [0.03, -0.02], atol=1e-6)  # third order: (0.003 rad)^3 g


def test_command_is_clipped_to_its_limits_with_its_sign():
    np.testing.assert_array_equal(command([100, 100, 100]), [-TILT, TILT, VERTICAL])
    np.testing.assert_array_equal(command([-100, -100, -100]), [TILT, -TILT, -VERTICAL])
    inside = np.array([0.59, -0.59, 5.9])
    np.testing.assert_array_equal(leader.clip_command(inside, TILT, VERTICAL), inside)


def test_attitude_gains_are_those_of_the_design():
    gains = plant_parameters(Plant(), Attitude()).gains
    inertia = 2 * np.array(gains.kp) / np.array([10.0, 10.0, 4.0]) ** 2  # Kp = J_O wn^2 / 2
    # The published gains print three digits: equal to half a unit of the last one.
    for value, printed in (
        (inertia, ("0.00481", "0.0644", "0.0679")),
        (gains.kp, ("0.240", "3.22", "0.543")),
        (gains.kd, ("0.0433", "0.579", "0.244")),
    ):
        digits = [len(text.split(".")[1]) for text in printed]
        assert tuple(f"{v:.{d}f}" for v, d in zip(value, digits, strict=True)) == printed


def test_both_drones_together_place_the_poles():
    """J p^2 + 2 Kd p + 2 Kp = J (p^2 + 2 zeta wn p + wn^2)."""
    inertia, frequency, damping = (0.01, 0.06, 0.07), (10.0, 8.0, 4.0), 0.7
    gains = design_gains(inertia, frequency, damping)
    for j, w, kp, kd in zip(inertia, frequency, *gains, strict=True):
        assert 2 * kp == pytest.approx(j * w * w, rel=ROUNDING)
        assert 2 * kd == pytest.approx(2 * damping * w * j, rel=ROUNDING)


def test_gains_do_not_depend_on_the_object_that_flies():
    light, heavy = (plant_parameters(Plant(object_mass=mass), Attitude()).gains for mass in (0.1, 0.4))
    np.testing.assert_array_equal(light, heavy)


def test_rotors_carry_the_weight_at_a_tilt_and_turn_against_the_error():
    gains = AttitudeGains((0.24, 3.22, 0.543), (0.0433, 0.579, 0.244))
    roll, pitch, az = 0.1, -0.2, 0.5
    euler, rates = np.array([0.12, -0.15, 0.02]), np.array([0.01, 0.02, -0.03])
    mass, arm, yaw_per_thrust = 1.1, 0.12, 0.02
    rotors = rotor_commands(np.array([roll, pitch, az]), euler, rates, mass, gains, G, arm, yaw_per_thrust, 50.0)
    f1, f2, f3, f4 = rotors
    assert f1 + f2 + f3 + f4 == pytest.approx(mass * (G + az) / (np.cos(0.12) * np.cos(0.15)), rel=1e-14)
    assert arm * (f2 - f4) == pytest.approx(0.24 * (roll - 0.12) - 0.0433 * 0.01, rel=1e-12)
    assert arm * (f3 - f1) == pytest.approx(3.22 * (pitch + 0.15) - 0.579 * 0.02, rel=1e-12)
    assert yaw_per_thrust * (f1 - f2 + f3 - f4) == pytest.approx(-0.543 * 0.02 + 0.244 * 0.03, rel=1e-12)


def test_rotors_saturate_between_zero_and_their_maximum():
    gains = AttitudeGains((0.24, 3.22, 0.543), (0.0433, 0.579, 0.244))
    rotors = rotor_commands(np.array([0, 3.0, 0]), np.zeros(3), np.zeros(3), 1.1, gains, G, 0.12, 0.02, 5.5)
    assert rotors[0] == 0.0
    assert rotors[2] == 5.5
