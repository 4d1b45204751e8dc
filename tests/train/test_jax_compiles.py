"""The installed jax computes what it is asked to: jax 0.10.2 did not (jax issue 39103), so pyproject excludes it."""

import jax
import jax.numpy as jnp
import numpy as np


def test_reduced_matrix_vector_products_of_many_rows_are_right():
    """36 000 rows: jax 0.10.2 on a CPU returned 3232 wrong sums. Squares of float32 integers are right to rounding."""
    rows = np.zeros((36_000, 3), np.float32)
    rows[:, 0] = np.arange(36_000)
    found = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(rows)
    np.testing.assert_allclose(found, rows[:, 0].astype(np.float64) ** 2, rtol=1e-6)
