"""Arrays of any library that follows the Python array API standard: NumPy's, JAX's, traced ones."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

# No type checker has a name for what they share. Shapes stand in annotations, `Float[Array, "... 3"]`, or docstrings.
Array: TypeAlias = Any


def matmul(a: Array, b: Array) -> Array:
    """`a @ b` in the precision of its arrays. JAX's own `@` rounds float32 on GPUs, to 10 bits (TF32) since Ampere."""
    other = b if isinstance(a, np.ndarray) else a
    xp = other.__array_namespace__() if hasattr(other, "__array_namespace__") else np
    return xp.matmul(a, b, precision="highest") if xp.__name__ == "jax.numpy" else a @ b
