"""What a linear law is made of: a sampled model, a steady-state Kalman filter, regulators of least quadratic cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, solve_continuous_are

from mjxball.arrays import Array, matmul


class Filter(NamedTuple):
    """Steady-state Kalman filter of x <- A x + B u, of which y is measured: x <- x + K (y - C x).

    What is remembered is the state x (..., n) expected at the next measurement.
    """

    transition: Array  # A (n, n)
    drive: Array  # B (n, m)
    gain: Array  # K (n, k)
    measured: Array  # C (k, n)

    def start(self, y: Array) -> Array:
        """State (..., n) at the first measurement `y` (..., k): 0 where nothing is measured."""
        return times(self.measured.T, y)

    def corrected(self, x: Array, y: Array) -> Array:
        """The expected state `x` (..., n) after the measurement `y` (..., k)."""
        return x + times(self.gain, y - times(self.measured, x))

    def moved(self, x: Array, u: Array) -> Array:
        """The state a period after `x` (..., n), in which `u` (..., m) acts."""
        return times(self.transition, x) + times(self.drive, u)


def times(matrix: Array, vector: Array) -> Array:
    """(..., k) of (..., k, n) and (..., n) in the type of `vector`, the same for one as for many."""
    matrix = vector.__array_namespace__().asarray(matrix, dtype=vector.dtype)
    return matmul(matrix, vector[..., None])[..., 0]


def discretise(a: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """(A (n, n), B (n, m)) of x_k+1 = A x_k + B u_k for x' = a x + b u with u held for a `period` [s]."""
    n, m = b.shape
    whole = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * period)
    return whole[:n, :n], whole[:n, n:]


def kalman(
    transition: np.ndarray, drive: np.ndarray, period: float, walks: Mapping[int, float], noise: Mapping[int, float]
) -> Filter:
    """The filter of x <- A x + B u every `period` [s], for `transition` A and `drive` B.

    `walks`: intensity of the white noise that drives a state, by its number. `noise`: deviation of the measurement of
    a state, by its number, in the order in which they are measured.
    """
    process_noise = np.zeros_like(transition)
    for state, intensity in walks.items():
        process_noise[state, state] = intensity * period
    measured, measurement_noise = np.eye(len(transition))[list(noise)], np.diag([v**2 for v in noise.values()])
    predicted = riccati(transition.T, measured.T, process_noise, measurement_noise)
    gain = predicted @ measured.T @ np.linalg.inv(measured @ predicted @ measured.T + measurement_noise)
    return Filter(transition, drive, gain, measured)


def regulator(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K (m, n) of u = -K x that minimises the sum of x'Qx + u'Ru, W (m, m)) for x <- A x + B u.

    A correction v of u costs v'Wv on top, whenever it is made.
    """
    value = riccati(a, b, q, r)
    cost = r + b.T @ value @ b
    return np.linalg.solve(cost, b.T @ value @ a), cost


def continuous_regulator(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """K (m, n) of u = -K x that minimises the integral of x'Qx + u'Ru for x' = A x + B u."""
    return np.linalg.solve(r, b.T @ solve_continuous_are(a, b, q, r))


def riccati(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """P (n, n) = A'PA - A'PB (R + B'PB)^-1 B'PA + Q, by structure-preserving doubling.

    Not `scipy.linalg.solve_discrete_are`: on the stand the leader's rate integral and the ball's torque conserve a sum
    that no command moves (an eigenvalue of 1), so there is no stabilising solution to a solver of eigenvalues. SciPy's
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
