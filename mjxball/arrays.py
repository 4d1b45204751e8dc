"""Arrays of any library that follows the Python array API standard: NumPy's, JAX's, traced ones."""

from __future__ import annotations

from typing import Any, TypeAlias

# No type checker has a name for what they share. Shapes stand in annotations, `Float[Array, "... 3"]`, or docstrings.
Array: TypeAlias = Any
