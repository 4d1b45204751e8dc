"""Sensors of the drones: IMU with noise and the firmware's low-pass filters at 1 kHz, and the positioning system."""

from __future__ import annotations

import math

import numpy as np

from mjxball.fly.twin.estimators import product
from mjxball.fly.twin.kind import Surroundings

RATE = 1000.0  # [Hz]
CUTOFF = np.array([30.0] * 3 + [80.0] * 3)  # [Hz] of accelerometer and gyroscope
# Standard deviations of one sample with motors running and at rest: [m/s2] and [rad/s].
RUNNING = np.array([0.3] * 3 + [math.radians(0.5)] * 3)
RESTING = np.array([0.03] * 3 + [math.radians(0.05)] * 3)
BLOCK = 1000  # samples of noise that are drawn at once


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
                self._drawn, self._at = self._noise * self._random.standard_normal((BLOCK, 2, 6)), 0
            true = true + np.where(running, RUNNING, RESTING) * self._drawn[self._at]
            self._at += 1
        out = self._b0 * true + self._first
        self._first = self._b1 * true - self._a1 * out + self._second
        self._second = self._b0 * true - self._a2 * out
        self.filtered = out
        return out


POSITION_NOISE, ATTITUDE_NOISE = 3e-4, 1e-3  # standard deviations [m, rad]
Pose = tuple[np.ndarray, np.ndarray]  # position (3,) [m], quaternion (4,)


class Positioning:
    """Poses of one drone."""

    def __init__(self, surroundings: Surroundings, random: np.random.Generator, phase: int):
        """`phase` [ms] of its first pose: the systems of two drones do not measure at the same moment."""
        self._every = max(round(1000 / surroundings.pose_hz), 1)
        self._noise, self._random = surroundings.noise, random
        self._phase = phase * self._every // 2
        self.lost = not surroundings.deck
        self.frozen = False
        self.offset = np.zeros(3)  # [m]
        self._last: Pose | None = None

    def due(self, step: int) -> bool:
        """True if a pose comes at millisecond `step`."""
        return not self.lost and (step + self._phase) % self._every == 0

    def measure(self, position: np.ndarray, quaternion: np.ndarray) -> Pose:
        """The pose that is measured of the true `position` (3,) and `quaternion` (4,)."""
        if self.frozen and self._last is not None:
            return self._last
        drawn = self._noise * self._random.standard_normal(6)
        turned = product(quaternion, np.array([1.0, *(0.5 * ATTITUDE_NOISE * drawn[3:])]))
        self._last = position + POSITION_NOISE * drawn[:3] + self.offset, turned / np.sqrt(turned @ turned)
        return self._last
