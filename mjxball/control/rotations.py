"""Rotations: Z-X-Y Euler angles, MuJoCo quaternions (w, x, y, z), rotation matrices body -> world."""

from __future__ import annotations

from mjxball.arrays import Array, clipped, components, joined


def rotate(matrix: Array, vector: Array) -> Array:
    """R v for `matrix` (..., 3, 3) and `vector` (..., 3) -> (..., 3).

    Written as a sum of products: XLA makes each small matrix product a separate call, in TF32 on a GPU.
    """
    return (matrix * vector[..., None, :]).sum(axis=-1)


def rotate_back(matrix: Array, vector: Array) -> Array:
    """R^T v for `matrix` (..., 3, 3) and `vector` (..., 3) -> (..., 3)."""
    return (matrix * vector[..., :, None]).sum(axis=-2)


def turned_about_z(vectors: Array, angle: Array) -> Array:
    """`vectors` (..., 3 k), k vectors side by side, each turned by `angle` (...) about z [rad]."""
    xp = vectors.__array_namespace__()
    angle = xp.asarray(angle, dtype=vectors.dtype)[..., None]
    c, s = xp.cos(angle), xp.sin(angle)
    each = xp.reshape(vectors, (*vectors.shape[:-1], -1, 3))
    x, y, z = (each[..., i] for i in range(3))
    return xp.reshape(joined([c * x - s * y, s * x + c * y, z]), vectors.shape)


def dot(a: Array, b: Array) -> Array:
    """a . b for (..., 3) each, broadcast -> (...)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: Array, b: Array) -> Array:
    """a x b for (..., 3) each, broadcast -> (..., 3)."""
    (ax, ay, az), (bx, by, bz) = components(a), components(b)
    return joined([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def euler_from_matrix(matrix: Array) -> Array:
    """(phi, theta, psi) [rad] of `matrix` (..., 3, 3) -> (..., 3); |phi| <= pi/2, singular at its ends."""
    xp = matrix.__array_namespace__()
    roll = xp.asin(clipped(matrix[..., 2, 1], -1.0, 1.0))
    pitch = xp.atan2(-matrix[..., 2, 0], matrix[..., 2, 2])
    yaw = xp.atan2(-matrix[..., 0, 1], matrix[..., 1, 1])
    return joined([roll, pitch, yaw])


def matrix_from_quaternion(quaternion: Array) -> Array:
    """R of a unit `quaternion` (w, x, y, z) (..., 4) -> (..., 3, 3)."""
    w, x, y, z = components(quaternion)
    return joined(
        [
            joined([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            joined([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            joined([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ],
        axis=-2,
    )


def multiply_quaternions(a: Array, b: Array) -> Array:
    """Hamilton product a b of `a`, `b` (w, x, y, z) (..., 4) -> (..., 4)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = components(a), components(b)
    return joined(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def conjugate(quaternion: Array) -> Array:
    """(..., 4) that turns back what the unit `quaternion` (w, x, y, z) (..., 4) turns."""
    w, x, y, z = components(quaternion)
    return joined([w, -x, -y, -z])


def quaternion_from_euler(euler: Array) -> Array:
    """Unit quaternion of Rz(psi) Rx(phi) Ry(theta), `euler` = (phi, theta, psi) (..., 3) -> (..., 4)."""
    xp = euler.__array_namespace__()
    half = euler / 2
    (cx, cy, cz), (sx, sy, sz) = components(xp.cos(half)), components(xp.sin(half))
    w, x, y, z = cz * cx, cz * sx, sz * sx, sz * cx  # of Rz Rx
    return joined([w * cy - y * sy, x * cy - z * sy, w * sy + y * cy, x * sy + z * cy])


def roll_of_quaternion(quaternion: Array) -> Array:
    """Angle (...) [rad] of a `quaternion` (..., 4) that turns about x alone."""
    xp = quaternion.__array_namespace__()
    return 2 * xp.atan2(quaternion[..., 1], quaternion[..., 0])


def tilt_of_quaternion(quaternion: Array) -> Array:
    """Angle (...) [rad] between body z and up of a unit `quaternion` (..., 4)."""
    xp = quaternion.__array_namespace__()
    return xp.acos(clipped(1.0 - 2.0 * (quaternion[..., 1] ** 2 + quaternion[..., 2] ** 2), -1.0, 1.0))


def integrate_quaternion(quaternion: Array, rotation: Array) -> Array:
    """q exp(rotation / 2), normalised: turn `quaternion` (..., 4) by the body-axes vector `rotation` (..., 3) [rad].

    The exponential's sine and cosine are Taylor sums in |rotation|^2, smooth at zero and exact to 1e-16 for |rotation|
    <= 0.5 rad, far more than the rotation in one physics step.
    """
    xp = quaternion.__array_namespace__()
    h2 = dot(rotation, rotation)[..., None] / 4
    sine = 0.5 * (1 - h2 / 6 * (1 - h2 / 20 * (1 - h2 / 42 * (1 - h2 / 72))))
    cosine = 1 - h2 / 2 * (1 - h2 / 12 * (1 - h2 / 30 * (1 - h2 / 56 * (1 - h2 / 90))))
    turned = multiply_quaternions(quaternion, xp.concat([cosine, sine * rotation], axis=-1))
    w, x, y, z = (turned[..., i : i + 1] for i in range(4))
    return turned / xp.sqrt(w * w + x * x + y * y + z * z)


def solve_symmetric(matrix: Array, vector: Array) -> Array:
    """Solve symmetric 3 x 3 systems `matrix` (..., 3, 3) by their adjugates; `vector` (..., 3) -> (..., 3).

    Number by number: of cross products of the rows, XLA's step of a batch of MJX worlds takes a CPU an eighth longer.
    """
    (a, b, c), (d, e), f = (matrix[..., 0, i] for i in range(3)), (matrix[..., 1, i] for i in (1, 2)), matrix[..., 2, 2]
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    x, y, z = (vector[..., i] for i in range(3))
    found = joined([aa * x + ab * y + ac * z, ab * x + bb * y + bc * z, ac * x + bc * y + cc * z])
    return found / (a * aa + b * ab + c * ac)[..., None]
