"""Building blocks of linear controllers: sampled models, LQR gains, Riccati equations."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from mjxball.arrays import Array, matmul
from mjxball.control.observation import OWN_STATE, repeats

VELOCITIES, AT_REST = slice(6, OWN_STATE), 1e-6  # of an own state [m/s], [rad/s]; largest of a follower at rest


def times(matrix: Array, vector: Array) -> Array:
    """Product (..., k) of `matrix` (..., k, n) and `vector` (..., n), in the dtype of `vector`; equal for any batch."""
    matrix = vector.__array_namespace__().asarray(matrix, dtype=vector.dtype)
    return matmul(matrix, vector[..., None])[..., 0]


def missed(observation: Array, last: Array) -> Array:
    """(..., 1) whether a moving follower's own state in `observation` (..., 18) repeats the `last` (..., 12).

    At rest the state is the same with a new measurement.
    """
    xp = observation.__array_namespace__()
    return repeats(observation, last) & xp.any(xp.abs(observation[..., VELOCITIES]) > AT_REST, axis=-1, keepdims=True)


def discretise(a: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """(A (n, n), B (n, m)) of x_k+1 = A x_k + B u_k for x' = a x + b u with u held for a `period` [s]."""
    n, m = b.shape
    whole = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * period)
    return whole[:n, :n], whole[:n, n:]


def regulator(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K (m, n) of the u = -K x that minimises the sum of x'Qx + u'Ru, W (m, m)) for x <- A x + B u.

    A deviation v from that u adds v'Wv to the cost, at whatever time it is made.
    """
    value = riccati(a, b, q, r)
    cost = r + b.T @ value @ b
    return np.linalg.solve(cost, b.T @ value @ a), cost


def riccati(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """P (n, n) = A'PA - A'PB (R + B'PB)^-1 B'PA + Q, by structure-preserving doubling.

    Not `scipy.linalg.solve_discrete_are`: on the stand the leader's rate integral and the ball's torque conserve a sum
    that no command changes (an eigenvalue of 1), so that eigenvalue solvers find no stabilising solution. SciPy's
    feedback is then off by 9e-4, and with a decay of 1e-5 1/s it fails; doubling converges to the least cost. Elsewhere
    both agree to 1e-12.
    """
    eye, a, g, h = np.eye(len(a)), a.copy(), b @ np.linalg.solve(r, b.T), q.copy()
    for _ in range(60):
        w = np.linalg.inv(eye + g @ h)
        step = a.T @ h @ w @ a
        a, g, h = a @ w @ a, g + a @ w @ g @ a.T, h + step
        if np.abs(step).max() <= 1e-12 * np.abs(h).max():
            break
    return 0.5 * (h + h.T)
