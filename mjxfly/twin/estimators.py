"""Sensors of the drones, and the firmware's two estimators of one drone: extended Kalman and complementary filter.

The Kalman filter is written from the facts of bitcraze/crazyflie-firmware 2026.08: position, velocity in body axes and
attitude error; 100 predictions a second from averaged IMU samples; the covariance bounded; while the supervisor says
flying, the specific force counts along body z alone. A Crazyflie without a positioning deck runs the complementary
filter: attitude from gyroscope and accelerometer, height above the sea from the barometer; x, y and the horizontal
velocity stay 0. NumPy, one drone at a time, no clocks of their own.
"""

from __future__ import annotations

import math

import numpy as np

from mjxball.control.rotations import (
    conjugate,
    cross,
    integrate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
)

GRAVITY = 9.81  # [m/s2]
MAX_COVARIANCE, MIN_VARIANCE = 100.0, 1e-6  # of the covariance
START = np.array([100.0, 100.0, 1.0, *[0.01] * 6])  # standard deviations after a reset [m, m/s, rad]
SLOW = 0.01  # [s] of a prediction
# Variance that is added each millisecond, squared process noise: 0.5 and 1.0 m/s2, 0.1 rad/s.
NOISE = np.diag([(k * 1e-3) ** 2 for k in (5e-4, 5e-4, 1e-3, 0.5, 0.5, 1.0, 0.1, 0.1, 0.1)])
DEAD_ZONE = 1e-4  # [rad] a smaller attitude error is dropped
REVERSION = 0.001  # share of level attitude that is mixed in at each prediction, on the ground
MOST_POSITION, MOST_VELOCITY = 100.0, 10.0  # [m, m/s] beyond which it resets itself
UNIT = np.array([1.0, 0.0, 0.0, 0.0])


class Kalman:
    """State of one drone's filter."""

    def __init__(self) -> None:
        self.covariance = np.zeros((9, 9))
        self.position, self.body_velocity = np.zeros(3), np.zeros(3)
        self.quaternion = UNIT.copy()

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) body -> world."""
        return np.asarray(matrix_from_quaternion(self.quaternion))

    def reset(self, position: np.ndarray | None = None, quaternion: np.ndarray | None = None) -> None:
        """Begin anew at the origin, level, or where the arguments say, with large variances."""
        self.covariance = np.diag(np.minimum(START**2, MAX_COVARIANCE))
        self.position = np.zeros(3) if position is None else np.array(position)
        self.body_velocity = np.zeros(3)
        self.quaternion = UNIT.copy() if quaternion is None else np.array(quaternion)

    @property
    def velocity(self) -> np.ndarray:
        """(3,) in the world [m/s]."""
        return self.matrix @ self.body_velocity

    def predict(self, acceleration: np.ndarray, rates: np.ndarray, flying: bool, dt: float = SLOW) -> None:
        """`dt` [s] on, from averaged specific force (3,) [m/s2] and `rates` (3,) [rad/s]."""
        matrix, velocity = self.matrix, self.body_velocity
        down = matrix[2]  # the world's up in body axes
        force = acceleration * np.array([0.0, 0.0, 1.0]) if flying else acceleration
        half = skew(0.5 * dt * rates)
        step = np.eye(9)
        step[0:3, 3:6] = dt * matrix
        step[0:3, 6:9] = -dt * matrix @ skew(velocity)
        step[3:6, 3:6] -= dt * skew(rates)
        step[3:6, 6:9] = -dt * GRAVITY * skew(down)
        step[6:9, 6:9] += 0.5 * half @ half - half
        self.covariance = bounded(step @ self.covariance @ step.T + 1000 * dt * NOISE)
        moved = dt * velocity + 0.5 * dt * dt * force
        self.position = self.position + matrix @ moved
        self.position[2] -= 0.5 * dt * dt * GRAVITY
        self.body_velocity = velocity + dt * (force - skew(rates) @ velocity - GRAVITY * down)
        self.quaternion = integrate_quaternion(self.quaternion, dt * rates)
        if not flying:
            turned = (1 - REVERSION) * self.quaternion + REVERSION * UNIT
            self.quaternion = turned / math.sqrt(float(turned @ turned))
        far = np.abs(self.position).max() > MOST_POSITION or np.abs(self.body_velocity).max() > MOST_VELOCITY
        if far or not np.isfinite(self.position).all():
            self.reset()

    def correct(self, position: np.ndarray, quaternion: np.ndarray | None, deviations: tuple[float, float]) -> None:
        """Take a measured `position` (3,) [m], and `quaternion` (4,) if there is one, with standard deviations."""
        count = 3 if quaternion is None else 6
        rows = [0, 1, 2, 6, 7, 8][:count]
        error = np.zeros(count)
        error[:3] = position - self.position
        if quaternion is not None:
            w, x, y, z = multiply_quaternions(quaternion, conjugate(self.quaternion))
            error[3:] = 2.0 / (w if abs(w) > 1e-3 else 1e-3) * np.array([x, y, z])
        noise = np.array([deviations[0] ** 2] * 3 + [deviations[1] ** 2] * 3)[:count]
        shared = self.covariance[:, rows]
        self._take(shared @ np.linalg.inv(shared[rows] + np.diag(noise)), error, shared)

    def correct_one(self, row: np.ndarray, error: float, deviation: float) -> None:
        """Take one number: measured minus predicted, its derivatives `row` (9,) by the state, its `deviation`."""
        shared = (self.covariance @ row)[:, None]
        self._take(shared / (float(row @ shared[:, 0]) + deviation**2), np.array([error]), shared)

    def _take(self, gain: np.ndarray, error: np.ndarray, shared: np.ndarray) -> None:
        change = gain @ error
        self.position = self.position + change[0:3]
        self.body_velocity = self.body_velocity + change[3:6]
        self.covariance = self.covariance - gain @ shared.T
        self._turn(change[6:9])
        self.covariance = bounded(self.covariance)

    def _turn(self, error: np.ndarray) -> None:
        """Move the attitude error (3,) [rad] into the attitude."""
        if not DEAD_ZONE < np.abs(error).max() < 10:
            return
        self.quaternion = integrate_quaternion(self.quaternion, error)
        half = skew(0.5 * error)
        rotation = np.eye(9)
        rotation[6:9, 6:9] += 0.5 * half @ half - half
        self.covariance = rotation @ self.covariance @ rotation.T


def skew(v: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) that makes the cross product v x."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def bounded(covariance: np.ndarray) -> np.ndarray:
    """`covariance` (9, 9) symmetric and within the filter's bounds."""
    even = np.minimum(0.5 * (covariance + covariance.T), MAX_COVARIANCE)
    diagonal = even.ravel()[::10]
    np.maximum(diagonal, MIN_VARIANCE, out=diagonal)
    return even


def euler_of(quaternion: np.ndarray) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of the sequence Rz Ry Rx, which the firmware's controller uses."""
    w, x, y, z = quaternion.tolist()
    roll = math.atan2(2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    pitch = math.asin(min(max(-2 * (x * z - w * y), -1.0), 1.0))
    return roll, pitch, math.atan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)


PERIOD = 0.004  # [s] of the attitude
GAIN = 0.8  # of the direction of gravity [1/s]
SEA = 48.0  # [m] height above the sea of the place where it flies
AIR_NOISE = 0.15  # [m] of the barometer
AIR_TIME = 0.3  # [s] over which the barometer is smoothed


class Complementary:
    """State of one drone's filter."""

    def __init__(self, random: np.random.Generator):
        self._random = random
        self.quaternion = UNIT.copy()
        self.height, self.climb = SEA, 0.0

    def update(self, acceleration: np.ndarray, rates: np.ndarray, height: float, dt: float) -> None:
        """`dt` [s] on, from specific force (3,) [m/s2], `rates` (3,) [rad/s] and the true `height` [m]."""
        size = math.sqrt(float(acceleration @ acceleration))
        if size > 1e-3:
            up = matrix_from_quaternion(self.quaternion)[2]
            rates = rates + GAIN * cross(acceleration / size, up)
        self.quaternion = integrate_quaternion(self.quaternion, dt * rates)
        share = dt / AIR_TIME
        old = self.height
        noise = AIR_NOISE * float(self._random.standard_normal())
        self.height += share * (SEA + height + noise - self.height)
        self.climb = (self.height - old) / dt


RATE = 1000.0  # [Hz]
CUTOFF = np.array([30.0] * 3 + [80.0] * 3)  # [Hz] of accelerometer and gyroscope
# Standard deviations of one sample with motors running and at rest: [m/s2] and [rad/s].
RUNNING = np.array([0.3] * 3 + [math.radians(0.5)] * 3)
RESTING = np.array([0.03] * 3 + [math.radians(0.05)] * 3)
BLOCK = 1000  # samples of noise taken at once


class Imu:
    """Filtered samples (2, 6) of both drones: specific force [m/s2], rates [rad/s], body axes."""

    def __init__(self, random: np.random.Generator, noise: float):
        self._random, self._noise = random, noise
        warped = np.tan(math.pi * CUTOFF / RATE)
        scale = 1 + math.sqrt(2.0) * warped + warped**2
        self._b0 = warped**2 / scale
        self._b1 = 2 * self._b0
        self._a1 = 2 * (warped**2 - 1) / scale
        self._a2 = (1 - math.sqrt(2.0) * warped + warped**2) / scale
        self._at = BLOCK
        self.settle(np.array([[0.0, 0.0, 9.81, 0.0, 0.0, 0.0]] * 2))

    def settle(self, value: np.ndarray) -> None:
        """Have seen nothing but `value` (2, 6) for long."""
        self.filtered = np.array(value, float)
        self._second = (self._b0 - self._a2) * value
        self._first = (self._b1 - self._a1) * value + self._second

    def sample(self, true: np.ndarray, running: np.ndarray) -> np.ndarray:
        """One millisecond on: `true` (2, 6), whose motors are `running` (2, 1); returns what the firmware sees."""
        if self._noise:
            if self._at >= BLOCK:
                self._samples, self._at = self._noise * self._random.standard_normal((BLOCK, 2, 6)), 0
            true = true + np.where(running, RUNNING, RESTING) * self._samples[self._at]
            self._at += 1
        out = self._b0 * true + self._first
        self._first = self._b1 * true - self._a1 * out + self._second
        self._second = self._b0 * true - self._a2 * out
        self.filtered = out
        return out
