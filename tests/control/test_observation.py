"""What the follower sees: order, values, memory, mask; and how its action becomes a command."""

import numpy as np
from euler_angles import matrix_from_euler

from mjxball.control import observation as layout
from mjxball.control import rotations
from mjxball.control.network_interface import NetworkInterface

MOUNT = np.array([-0.17, 0.0, 0.0])


def test_slots_are_the_eighteen_of_the_design_in_order():
    names = [name for name, _ in layout.OBSERVATION]
    assert names == [
        *("follower_x", "follower_y", "follower_z"),
        *("roll", "pitch", "yaw"),
        *("follower_vx", "follower_vy", "follower_vz"),
        *("rate_x", "rate_y", "rate_z"),
        *("object_error_x", "object_error_y", "object_error_z"),
        *("object_error_rate_x", "object_error_rate_y", "object_error_rate_z"),
    ]
    assert names[layout.ERROR] == names[12:15]
    assert names[layout.ERROR_RATE] == names[15:18]
    units = {unit for _, unit in layout.OBSERVATION}
    assert units == {"m", "rad", "m/s", "rad/s"}
    assert [name for name, _ in layout.ACTION] == ["roll", "pitch", "vertical_acceleration"]


def test_slots_by_hand_at_a_quarter_turn_of_yaw():
    """Nose to the left (+y): the follower, behind the nose, sits at -y and moves with the rotation."""
    euler = np.array([0.0, 0.0, np.pi / 2])
    seen = layout.observe(
        position=np.array([1.0, 2.0, 3.0]),
        matrix=matrix_from_euler(euler),
        velocity=np.array([0.1, 0.2, 0.3]),
        rates=np.array([0.0, 0.0, 2.0]),
        goal=np.array([1.5, 1.0, 3.25]),
        mount=MOUNT,
    )
    expected = [
        *(1.0, 2.0 - 0.17, 3.0),
        *euler,
        *(0.1 + 2.0 * 0.17, 0.2, 0.3),  # w x r = (0, 0, 2) x (0, -0.17, 0) = (0.34, 0, 0)
        *(0.0, 0.0, 2.0),
        *(0.5, -1.0, 0.25),
        *(-0.1, -0.2, -0.3),
    ]
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-15)  # cos(pi/2) is 6e-17


def test_velocity_is_the_derivative_of_the_position():
    """Central difference along a turning, moving assembly; independent of the product rule in `observe`."""
    euler, rates, velocity = np.array([0.2, -0.3, 0.5]), np.array([1.0, -2.0, 0.7]), np.array([0.4, 0.1, -0.2])
    goal, position, quaternion = np.ones(3), np.array([0.3, 0.2, 0.1]), rotations.quaternion_from_euler(euler)

    def at(t: float) -> np.ndarray:
        turned = rotations.integrate_quaternion(quaternion, rates * t)
        matrix = rotations.matrix_from_quaternion(turned)
        return layout.observe(position + velocity * t, matrix, velocity, rates, goal, MOUNT)

    h = 1e-5
    slope = (at(h) - at(-h)) / (2 * h)
    seen = at(0.0)
    # h^2 |w|^3 |r| / 6 = 4e-11 of truncation and 1e-16 / h = 1e-11 of rounding.
    np.testing.assert_allclose(slope[0:3], seen[6:9], rtol=0, atol=1e-9)
    np.testing.assert_allclose(slope[layout.ERROR], seen[layout.ERROR_RATE], rtol=0, atol=1e-9)


def seen_with(error, rate):
    seen = np.zeros(18)
    seen[layout.ERROR], seen[layout.ERROR_RATE] = error, rate
    return seen


HISTORY = layout.ObservationHistory()
CONTROLLER = {"kp": (0.5, 0.5, 0.5), "kd": (1.0, 1.0, 1.0), "gravity": 10.0, "limits": (0.6, 6.0)}


def test_copy_is_the_pd_law_on_the_observed_error():
    seen = seen_with([1.0, 2.0, 3.0], [0.5, 0.0, -1.0])
    command = layout.copy_command(seen, CONTROLLER["kp"], CONTROLLER["kd"], 10.0, 0.6, 6.0)
    np.testing.assert_allclose(command, [-0.1, 0.1, 0.5], rtol=1e-15)


def test_residual_adds_to_the_pd_law_and_direct_does_not():
    seen, scaled = seen_with([1.0, 0, 0], [0, 0, 0]), np.array([0.5, -1.0, 0.25])
    reach = (0.2, 2.0)
    direct, residual = (
        NetworkInterface(HISTORY, reach, residual=adds, **CONTROLLER).command(scaled, seen) for adds in (False, True)
    )
    np.testing.assert_allclose(direct, [0.1, -0.2, 0.5], rtol=1e-15)
    np.testing.assert_allclose(residual, [0.1, -0.2 + 0.05, 0.5], rtol=1e-14)


def test_command_never_leaves_the_shared_limits():
    seen = seen_with([100.0, -100.0, 100.0], [0, 0, 0])
    for scaled in (np.ones(3), -np.ones(3)):
        command = NetworkInterface(HISTORY, (0.2, 2.0), **CONTROLLER).command(scaled, seen)
        assert (np.abs(command) <= [0.6, 0.6, 6.0]).all()
    wide = NetworkInterface(HISTORY, (1.0, 20.0), residual=False, **CONTROLLER).command(np.ones(3), seen)
    np.testing.assert_array_equal(wide, [0.6, 0.6, 6.0])


def test_a_follower_of_the_load_axis_alone_commands_the_angle_that_the_load_turns():
    """A load along x pitches the pair, one along y rolls it."""
    assert layout.action_mask(False, "x") == (1.0, 1.0, 1.0)
    assert layout.action_mask(True, "x") == (0.0, 1.0, 1.0)
    assert layout.action_mask(True, "y") == (1.0, 0.0, 1.0)
