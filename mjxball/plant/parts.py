"""Arithmetic on vectors and matrices by their components, which leaves out constants that are 0.

A component is an array (...) or a Python float, a number that is known before anything is computed. XLA does not remove
a float's product with 0, so structural zeros of a plant (a mount on an axis, principal inertia) are left out here, in
Python. Works on NumPy and JAX arrays alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Part = Any  # an array (...), or a float
Parts = tuple[Part, Part, Part]
Rows = tuple[Parts, Parts, Parts]
ZERO: Parts = (0.0, 0.0, 0.0)


def entry(array: Any, *index: int) -> Part:
    """`array[..., *index]`: a float if `array` is a constant, NumPy's and without batch axes."""
    if isinstance(array, (np.ndarray, np.generic, float, int)) and np.ndim(array) == len(index):
        return float(np.asarray(array)[index])
    return array[(..., *index)]


def is_constant(part: Part) -> bool:
    """Whether `part` is a number known beforehand."""
    return type(part) is float


def is_zero(part: Part) -> bool:
    """Whether `part` is known to be 0."""
    return is_constant(part) and part == 0.0


def times(a: Part, b: Part) -> Part:
    """a b."""
    if is_zero(a) or is_zero(b):
        return 0.0
    if is_constant(a) and a == 1.0:
        return b
    return a if is_constant(b) and b == 1.0 else a * b


def plus(a: Part, b: Part) -> Part:
    """a + b."""
    return b if is_zero(a) else a if is_zero(b) else a + b


def minus(a: Part, b: Part) -> Part:
    """a - b."""
    return a if is_zero(b) else -b if is_zero(a) else a - b


def over(a: Part, b: Part) -> Part:
    """a / b."""
    return 0.0 if is_zero(a) else a if is_constant(b) and b == 1.0 else a / b


def total(values: Any) -> Part:
    """Sum from the first on."""
    found: Part = 0.0
    for value in values:
        found = plus(found, value)
    return found


def add(a: Parts, b: Parts) -> Parts:
    """a + b by component."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


def subtract(a: Parts, b: Parts) -> Parts:
    """a - b by component."""
    return minus(a[0], b[0]), minus(a[1], b[1]), minus(a[2], b[2])


def scale(k: Part, v: Parts) -> Parts:
    """k v."""
    return times(k, v[0]), times(k, v[1]), times(k, v[2])


def dot(a: Parts, b: Parts) -> Part:
    """a . b."""
    return plus(plus(times(a[0], b[0]), times(a[1], b[1])), times(a[2], b[2]))


def cross(a: Parts, b: Parts) -> Parts:
    """a x b."""
    return (
        minus(times(a[1], b[2]), times(a[2], b[1])),
        minus(times(a[2], b[0]), times(a[0], b[2])),
        minus(times(a[0], b[1]), times(a[1], b[0])),
    )


def rotate(matrix: Rows, v: Parts) -> Parts:
    """Matrix times vector."""
    return dot(matrix[0], v), dot(matrix[1], v), dot(matrix[2], v)


def point_inertia(r: Parts) -> Rows:
    """|r|^2 I - r r^T of a unit point mass at `r`."""
    x, y, z = r
    xx, yy, zz = times(x, x), times(y, y), times(z, z)
    xy, xz, yz = (minus(0.0, times(*pair)) for pair in ((x, y), (x, z), (y, z)))
    return (plus(yy, zz), xy, xz), (xy, plus(xx, zz), yz), (xz, yz, plus(xx, yy))


def diagonal(v: Parts) -> Rows:
    """The matrix with `v` on its diagonal."""
    return (v[0], 0.0, 0.0), (0.0, v[1], 0.0), (0.0, 0.0, v[2])


def add_rows(a: Rows, b: Rows) -> Rows:
    """a + b of matrices."""
    return add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])


def scale_rows(k: Part, a: Rows) -> Rows:
    """k a of a matrix."""
    return scale(k, a[0]), scale(k, a[1]), scale(k, a[2])


def diagonal_turned_about_z(yaw: Part, v: Parts) -> Rows:
    """Rz diag(v) Rz^T: principal inertia of a body that is turned by `yaw` about z."""
    cosine, sine = cosine_and_sine(yaw)
    x, y, z = v
    cc, ss, cs = times(cosine, cosine), times(sine, sine), times(cosine, sine)
    across = times(cs, minus(x, y)) if not is_zero(cs) else 0.0
    along = plus(times(cc, x), times(ss, y)), plus(times(ss, x), times(cc, y))
    return (along[0], across, 0.0), (across, along[1], 0.0), (0.0, 0.0, z)


def cosine_and_sine(angle: Part) -> tuple[Part, Part]:
    """Of `angle` [rad]."""
    if is_constant(angle):
        return float(np.cos(angle)), float(np.sin(angle))
    xp = angle.__array_namespace__()
    return xp.cos(angle), xp.sin(angle)


def solve_symmetric(matrix: Rows, vector: Parts) -> Parts:
    """Solve a symmetric 3 x 3 system by its adjugate."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    aa, ab, ac = (
        minus(times(d, f), times(e, e)),
        minus(times(c, e), times(b, f)),
        minus(times(b, e), times(c, d)),
    )
    bb, bc, cc = (
        minus(times(a, f), times(c, c)),
        minus(times(b, c), times(a, e)),
        minus(times(a, d), times(b, b)),
    )
    determinant = plus(plus(times(a, aa), times(b, ab)), times(c, ac))
    found = rotate(((aa, ab, ac), (ab, bb, bc), (ac, bc, cc)), vector)
    return over(found[0], determinant), over(found[1], determinant), over(found[2], determinant)


def solve_small(matrix: Any, vector: Any) -> list[Part]:
    """Solve a system of one or two equations, given as sequences of sequences."""
    if len(vector) == 1:
        return [vector[0] / matrix[0][0]]
    (a, b), (c, d) = matrix
    determinant = a * d - b * c
    return [(d * vector[0] - b * vector[1]) / determinant, (a * vector[1] - c * vector[0]) / determinant]


def split(vector: Any) -> Parts:
    """Components of an array (..., 3)."""
    return vector[..., 0], vector[..., 1], vector[..., 2]


def stacked(parts: Parts, like: Any) -> Any:
    """Array (..., 3) of `parts`, with the shape (...) and type of `like` where they are numbers."""
    xp = like.__array_namespace__()
    return joined([xp.full_like(like, part) if is_constant(part) else part for part in parts])


def joined(components: Sequence[Any], axis: int = -1) -> Any:
    """Arrays of one shape as one, along a new last `axis` (-1) or last but one (-2).

    What `stack` does, of which NumPy's takes twice as long on small arrays.
    """
    first = components[0]
    if isinstance(first, np.ndarray | np.generic):
        index = (..., None) if axis == -1 else (..., None, slice(None))
        return np.concatenate([component[index] for component in components], axis=axis)
    return first.__array_namespace__().stack(components, axis=axis)


def clipped(value: Any, low: Any, high: Any) -> Any:
    """`value` (...) within `low` and `high`: `clip`, of which NumPy's takes twice as long on small arrays."""
    if isinstance(value, np.ndarray | np.generic):
        return np.minimum(np.maximum(value, low), high)
    return value.__array_namespace__().clip(value, low, high)
