"""Design of the LQGs: feedback by LQR, steady-state Kalman filters, discretisation (SciPy)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

from mjxball.arrays import Array, matmul
from mjxball.baselines.assembly_model import AssemblyModel

TILT, VERTICAL = 0.15, 1.0  # [rad], [m/s2] that cost 1
THETA_NOISE, RATE_NOISE, CLIMB_NOISE = 2e-3, 2e-2, 2e-2  # deviations of a measurement [rad], [rad/s], [m/s]


class Tuning(NamedTuple):
    """What is chosen of `lqg`."""

    position: float = 0.25  # that costs 1 [m]
    velocity: float = 1.0  # that costs 1 [m/s]
    torque_walk: float = 9.0  # intensity of the white noise that drives d' [(N m/s)2 s]
    tilt_limit: float = 0.25  # of the position and velocity part [rad]


# The default reproduces an independent simulation; with delayed commands it limit-cycles. SLOW settles earliest under
# noise and 40 ms of delay among the sets that settle in every case (docs/archive/training.md).
SLOW = Tuning(0.15, 0.6, 0.003, 0.3)


class Gains(NamedTuple):
    """Feedback of one axis on (position, velocity, angle, rate), or on (position, velocity) of the height."""

    roll: tuple[float, ...]
    pitch: tuple[float, ...]
    height: tuple[float, ...]


class Filter(NamedTuple):
    """Steady-state Kalman filter: x <- A x + B u, then x <- x + L (y - C x), on (angle, rate, d, d', rotor torque)."""

    transition: np.ndarray  # (5, 5), of A axes (A, 5, 5)
    drive: np.ndarray  # (5,)
    gain: np.ndarray  # (5, 2)


def filtered(kalman: Filter, estimate: Array, drive: Array, measured: Array, started: Array) -> Array:
    """Estimate (..., A, 5) after `drive` (..., A) has acted for a step and `measured` (..., A, 2) is seen.

    `started` (..., 1, 1): 0 at the first step, where `estimate` is as of now.
    """
    xp = measured.__array_namespace__()
    transition, enters, gain = (xp.asarray(part, dtype=measured.dtype) for part in kalman)
    predicted = matmul(transition, estimate[..., None])[..., 0] + drive[..., None] * enters
    predicted = xp.where(started > 0, predicted, estimate)
    return predicted + matmul(gain, (measured - predicted[..., :2])[..., None])[..., 0]


def feedback(model: AssemblyModel, tuning: Tuning) -> Gains:
    """LQR of both tilt axes, each with its closed attitude loop, and of the height."""
    costs = tuning.position**-2, tuning.velocity**-2

    def tilt(frequency: float, sign: float) -> tuple[float, ...]:
        a = np.zeros((4, 4))
        a[0, 1] = a[2, 3] = 1.0
        a[1, 2] = sign * model.gravity
        a[3, 2], a[3, 3] = -(frequency**2), -2.0 * model.damping * frequency
        b = np.array([[0.0], [0.0], [0.0], [frequency**2]])
        return lqr(a, b, np.diag([*costs, 0.0, 0.0]), np.array([[TILT**-2]]))

    height = lqr(
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.array([[0.0], [1.0]]),
        np.diag(costs),
        np.array([[VERTICAL**-2]]),
    )
    roll, pitch = model.natural_frequency
    return Gains(tilt(roll, -1.0), tilt(pitch, 1.0), height)


def lqr(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[float, ...]:
    """K of u = -K x, one input, that minimises the integral of x'Qx + u'Ru for x' = A x + B u."""
    cost = solve_continuous_are(a, b, q, r)
    return tuple(map(float, np.linalg.solve(r, b.T @ cost)[0]))


def kalman(model: AssemblyModel, axis: int, torque_walk: float) -> Filter:
    """The matrices of the steady-state filter about `axis`, driven by the commanded torque [N m]."""
    drones = len(model.own_mass)
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 2] = a[1, 4] = 1.0 / model.inertia[axis]
    a[4] = np.array([-drones * model.kp[axis], -drones * model.kd[axis], 0.0, 0.0, -1.0]) / model.lag
    b = np.array([[0.0], [0.0], [0.0], [0.0], [1.0 / model.lag]])
    noise = {0: THETA_NOISE, 1: RATE_NOISE}
    transition, drive, gain = steady_filter(a, b, model.period, {3: torque_walk}, noise)
    return Filter(transition, drive[:, 0], gain)


def steady_filter(
    a: np.ndarray, b: np.ndarray, period: float, walks: Mapping[int, float], noise: Mapping[int, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A (n, n), B (n, m), K (n, k)) of the steady-state Kalman filter of x' = a x + b u, sampled every `period` [s].

    `walks`: intensity of the white noise that drives a state, by its number. `noise`: deviation of the measurement of
    a state, by its number; K has a column for each.
    """
    transition, drive = discretise(a, b, period)
    return transition, drive, steady_gain(transition, period, walks, noise)


def steady_gain(
    transition: np.ndarray, period: float, walks: Mapping[int, float], noise: Mapping[int, float]
) -> np.ndarray:
    """K (n, k) of the steady-state Kalman filter of x <- A x with `transition` A (n, n); see `steady_filter`."""
    process_noise = np.zeros_like(transition)
    for state, intensity in walks.items():
        process_noise[state, state] = intensity * period
    measured, measurement_noise = np.eye(len(transition))[list(noise)], np.diag([v**2 for v in noise.values()])
    predicted = solve_discrete_are(transition.T, measured.T, process_noise, measurement_noise)
    return predicted @ measured.T @ np.linalg.inv(measured @ predicted @ measured.T + measurement_noise)


def discretise(a: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """(A (n, n), B (n, m)) of x_k+1 = A x_k + B u_k for x' = a x + b u with u held for a `period` [s]."""
    n, m = b.shape
    whole = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * period)
    return whole[:n, :n], whole[:n, n:]
