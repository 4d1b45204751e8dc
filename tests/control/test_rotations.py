"""Rotations against SciPy, an independent implementation, in float64."""

import numpy as np
import pytest
from euler_angles import matrix_from_euler
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from mjxball.control import rotations
from mjxball.plant.parameters import point_inertia

# A product of a few sines and cosines is exact to some ulp (2.2e-16).
ROUNDING = 1e-14
# Away from the singularity at |roll| = pi/2, where the angles lose digits as 1 / cos(roll): 1/cos(1.5) = 14.
SAFE_ROLL = 1.5
angle = st.floats(-np.pi, np.pi)
euler_angles = st.tuples(st.floats(-SAFE_ROLL, SAFE_ROLL), angle, angle).map(np.array)
vectors = arrays(np.float64, 3, elements=st.floats(-10, 10))


def scipy_rotation(euler: np.ndarray) -> Rotation:
    """R = Rz(psi) Rx(phi) Ry(theta): intrinsic Z-X-Y of `euler` = (phi, theta, psi) (..., 3)."""
    return Rotation.from_euler("ZXY", euler[..., [2, 0, 1]])


def scipy_quaternion(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)  # SciPy keeps w last, MuJoCo first


def assert_same_turn(first: np.ndarray, second: np.ndarray, tolerance: float) -> None:
    """Quaternions q and -q are the same rotation."""
    np.testing.assert_allclose(np.sign((first * second).sum(-1, keepdims=True)) * first, second, atol=tolerance)


@given(euler_angles)
def test_matrix_from_euler_is_intrinsic_zxy(euler):
    np.testing.assert_allclose(matrix_from_euler(euler), scipy_rotation(euler).as_matrix(), rtol=0, atol=ROUNDING)


@given(euler_angles)
def test_quaternion_from_euler_is_intrinsic_zxy(euler):
    assert_same_turn(rotations.quaternion_from_euler(euler), scipy_quaternion(scipy_rotation(euler)), ROUNDING)


@given(euler_angles)
def test_euler_angles_survive_the_matrix(euler):
    back = rotations.euler_from_matrix(matrix_from_euler(euler))
    turns = (back - euler) / (2 * np.pi)  # -pi and pi are the same angle
    # asin loses 1/cos(1.5) = 14 ulp of its argument.
    np.testing.assert_allclose(turns, np.round(turns), atol=100 * ROUNDING)


@given(euler_angles)
def test_quaternion_and_euler_give_the_same_matrix(euler):
    np.testing.assert_allclose(
        rotations.matrix_from_quaternion(rotations.quaternion_from_euler(euler)),
        matrix_from_euler(euler),
        rtol=0,
        atol=ROUNDING,
    )


@given(euler_angles, euler_angles)
def test_quaternion_product_is_the_matrix_product(first, second):
    product = rotations.multiply_quaternions(*map(rotations.quaternion_from_euler, (first, second)))
    np.testing.assert_allclose(
        rotations.matrix_from_quaternion(product),
        matrix_from_euler(first) @ matrix_from_euler(second),
        rtol=0,
        atol=ROUNDING,
    )


@given(euler_angles)
def test_conjugate_turns_back_and_tilt_is_the_angle_of_body_z(euler):
    quaternion, matrix = rotations.quaternion_from_euler(euler), matrix_from_euler(euler)
    back = rotations.matrix_from_quaternion(rotations.conjugate(quaternion))
    np.testing.assert_allclose(back, matrix.T, rtol=0, atol=ROUNDING)
    assert np.cos(rotations.tilt_of_quaternion(quaternion)) == pytest.approx(matrix[2, 2], abs=ROUNDING)


@given(euler_angles, vectors)
def test_rotate_is_the_matrix_product_and_rotate_back_undoes_it(euler, vector):
    matrix = matrix_from_euler(euler)
    turned = rotations.rotate(matrix, vector)
    np.testing.assert_allclose(turned, matrix @ vector, rtol=0, atol=20 * ROUNDING)  # vectors up to 17 long
    np.testing.assert_allclose(rotations.rotate_back(matrix, turned), vector, rtol=0, atol=20 * ROUNDING)


@given(vectors, vectors)
def test_cross_product(first, second):
    # Products up to 100.
    np.testing.assert_allclose(rotations.cross(first, second), np.cross(first, second), rtol=0, atol=200 * ROUNDING)


@given(euler_angles, arrays(np.float64, 3, elements=st.floats(-0.28, 0.28)))
def test_integrate_quaternion_is_the_exponential(euler, rotation):
    # 0.28 sqrt(3) < 0.5 rad: the range in which the Taylor sums promise to be exact.
    integrated = rotations.integrate_quaternion(rotations.quaternion_from_euler(euler), rotation)
    assert_same_turn(integrated, scipy_quaternion(scipy_rotation(euler) * Rotation.from_rotvec(rotation)), 2 * ROUNDING)


def test_integrate_quaternion_by_nothing_changes_nothing():
    quaternion = rotations.quaternion_from_euler(np.array([0.3, -0.2, 1.0]))
    turned = rotations.integrate_quaternion(quaternion, np.zeros(3))
    np.testing.assert_allclose(turned, quaternion, rtol=0, atol=3e-16)  # one ulp, from the normalisation


def test_integrate_quaternion_renormalises():
    drifted = 1.01 * rotations.quaternion_from_euler(np.array([0.3, -0.2, 1.0]))
    turned = rotations.integrate_quaternion(drifted, np.array([0.01, 0.02, 0.03]))
    assert np.linalg.norm(turned) == pytest.approx(1.0, abs=ROUNDING)


def test_many_small_turns_make_a_large_one():
    rate, steps = np.array([0.9, -1.4, 0.4]), 500
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(steps):
        quaternion = rotations.integrate_quaternion(quaternion, rate / steps)
    # 500 roundings of 1e-16 each, all in one direction at worst.
    assert_same_turn(quaternion, scipy_quaternion(Rotation.from_rotvec(rate)), 500 * 2e-16)


@given(arrays(np.float64, (3, 3), elements=st.floats(-1, 1)), vectors)
def test_solve_solves(half, vector):
    matrix = half @ half.T + np.eye(3)  # symmetric, condition number at most 1 + 9
    expected = np.linalg.solve(matrix, vector)
    # The adjugate loses about the square of the condition number: 100 ulp of a solution up to 17.
    np.testing.assert_allclose(rotations.solve_symmetric(matrix, vector), expected, rtol=0, atol=4e-13)


@given(st.floats(-3, 3))
def test_roll_of_a_quaternion_about_x(roll):
    quaternion = scipy_quaternion(Rotation.from_rotvec([roll, 0, 0]))
    assert rotations.roll_of_quaternion(quaternion) == pytest.approx(roll, abs=ROUNDING)


@given(vectors, vectors)
def test_point_inertia_is_the_moment_of_momentum(place, rates):
    """r x (w x r) = J w for a unit point mass."""
    momentum = point_inertia(place) @ rates
    # Products of three numbers up to 17: an ulp of 5000.
    np.testing.assert_allclose(momentum, np.cross(place, np.cross(rates, place)), rtol=0, atol=1e-11)
    assert rotations.dot(rates, momentum) == pytest.approx((np.cross(rates, place) ** 2).sum(), abs=1e-10)


def test_every_rotation_takes_batches():
    random = np.random.default_rng(0)
    euler = random.uniform(-1, 1, (4, 5, 3))
    matrices = matrix_from_euler(euler)
    assert matrices.shape == (4, 5, 3, 3)
    np.testing.assert_array_equal(matrices[2, 3], matrix_from_euler(euler[2, 3]))
    np.testing.assert_array_equal(
        rotations.solve_symmetric(matrices + np.swapaxes(matrices, -1, -2), euler)[2, 3],
        rotations.solve_symmetric(matrices[2, 3] + matrices[2, 3].T, euler[2, 3]),
    )
