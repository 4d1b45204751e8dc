"""Helpers for arrays of any library that follows the Python array API standard: NumPy, JAX, traced arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from mjxball.errors import FOREIGN, InputError, said

# Type checkers have no common type for them. Shapes are given in annotations, `Float[Array, "... 3"]`, or docstrings.
Array: TypeAlias = Any


def real_numbers(given: Any, what: str) -> np.ndarray:
    """`given`, a caller's argument, as an array of real numbers. Raises InputError, which begins with `what`.

    Stricter than NumPy, which ignores masks, drops imaginary parts, and converts strings, booleans and objects.
    """
    if _has_mask(given):
        raise InputError(f"{what} must be real numbers, and some are masked: fill them in, or leave it out")
    try:
        array = np.asarray(given)
    except FOREIGN as error:  # ragged lists, and any error of the caller's array type
        raise InputError(f"{what} must be real numbers, and is no array of them: {said(error)}") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{what} must be real numbers, not {array.dtype}")
    return array


def _has_mask(given: Any) -> bool:
    if isinstance(given, (list, tuple)):
        return any(map(_has_mask, given))
    return isinstance(given, np.ma.MaskedArray)


def components(vector: Array) -> Sequence[Array]:
    """The n parts (...) of `vector` (..., n). One vector of NumPy's, (n,), as floats: ten times as quick."""
    if isinstance(vector, np.ndarray) and vector.ndim == 1 and vector.dtype == float:
        return vector.tolist()
    return [vector[..., i] for i in range(vector.shape[-1])]


def joined(components: Sequence[Array], axis: int = -1) -> Array:
    """`stack` of arrays of one shape along a new last `axis` (-1) or last but one (-2).

    NumPy's `stack` takes twice as long on small arrays. Floats become one vector.
    """
    first = components[0]
    if isinstance(first, float):
        return np.array(components)
    if isinstance(first, np.ndarray | np.generic):
        index = (..., None) if axis == -1 else (..., None, slice(None))
        return np.concatenate([component[index] for component in components], axis=axis)
    return first.__array_namespace__().stack(components, axis=axis)


def clipped(value: Array, low: Any, high: Any) -> Array:
    """`clip` of `value` (...) to `low` and `high`. NumPy's takes twice as long on small arrays."""
    if isinstance(value, np.ndarray | np.generic):
        return np.minimum(np.maximum(value, low), high)
    return value.__array_namespace__().clip(value, low, high)


def matmul(a: Array, b: Array) -> Array:
    """`a @ b` in the precision of its arrays. On GPUs JAX's `@` rounds float32 to TF32 (10 bits)."""
    other = b if isinstance(a, np.ndarray) else a
    xp = other.__array_namespace__() if hasattr(other, "__array_namespace__") else np
    return xp.matmul(a, b, precision="highest") if xp.__name__ == "jax.numpy" else a @ b
