"""Positioning systems of the twin: rates, errors and gaps of the measurements for a drone's Kalman filter.

- mocap: poses, 100 a second, 0.3 mm and 1 mrad (Merriaux 2017, Sensors 17(7) 1591, Vicon: 0.15 mm at rest, below 2 mm
  in motion).
- lighthouse: two V2 base stations. 50 positions a second (Bitcraze, "Lighthouse positioning system"). Errors from our
  evaluation of the flights lh2_kalman_flight 00 and 01, which have motion capture as a reference
  (bitcraze/positioning_dataset; Taffanel 2021, arXiv 2104.11523): 16 mm in the mean, mostly a linear distortion of
  about 1 % an axis; 0.1 to 2 mm of jitter at rest; 1.2 gaps of more than 50 ms a second, 135 ms long in the mean.
- loco: TDoA 3, eight anchors in the corners of a room. 400 packets a second, of which 15 % are lost (Bitcraze's blog on
  TDoA 3, 2018). Range biases have a standard deviation of 54 mm over the anchors (Bitcraze, "accuracy and precision of
  the Loco Positioning"). The noise of 0.10 m a range difference makes an estimate at rest move by 5 to 20 mm, as there.
- flow: deck v2. 85 counts and 24 heights a second, with the standard deviations of the firmware's filter, 2 counts and
  2.5 mm (bitcraze/crazyflie-firmware 2026.08). The rates are those of the flights flowv2_flight_carpet 01 to 03 of the
  same dataset, where the position is 0.24, 0.06 and 0.86 m off after 65 s.

Both drones share the distortion and the anchors' biases. Gyroscopes have no bias here, so yaw, which loco and flow do
not measure, does not drift. The measurement models are those of the firmware's filter, except Lighthouse: the firmware
takes sweep angles, the twin the position that they yield, with 1 mrad at 2.5 m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from mjxball.control.rotations import conjugate, matrix_from_quaternion, multiply_quaternions
from mjxball.errors import InputError
from mjxfly.twin.conditions import Surroundings
from mjxfly.twin.estimators import Kalman

Pose = tuple[np.ndarray, np.ndarray]  # position (3,) [m], quaternion (4,)
POSITION_NOISE, ATTITUDE_NOISE = 3e-4, 1e-3  # of motion capture: standard deviations [m, rad]


# Parameters of decks, each with the value that switches the deck's measurements off.
SWITCHES = {"lighthouse.fwdToEstimator": 0.0, "loco.fwdToEstimator": 0.0, "motion.disable": 1.0}


class Positioning:
    """Motion capture of one drone, which measures poses. Base class of all systems: their timing and faults."""

    switched_by = ""  # a key of `SWITCHES`

    def __init__(self, surroundings: Surroundings, random: np.random.Generator, phase: int):
        """`phase`: 1 shifts the measurements by half a period, so that the two drones' do not coincide."""
        self._every = max(round(1000 / surroundings.pose_hz), 1)
        self._noise, self._random = surroundings.noise, random
        self._phase = phase * self._every // 2
        self._loss = surroundings.pose_loss
        self._lost = not surroundings.deck
        self._off = False  # switched off by a parameter of the deck
        self._frozen = np.zeros(7, bool)  # of x, y, z and the quaternion
        self._repeats = 1  # consecutive measurements that return the same pose
        self._offset, self._count = np.zeros(3), 0
        self._last: np.ndarray | None = None  # (7,) position [m], quaternion

    def disturb(self, what: str, value: float) -> None:
        """Inject "frozen", "frozen z", "lost" (0 or 1), "repeated" (equal poses in a row) or a "jump" of z [m].

        Raises InputError for any other.
        """
        match what:
            case "frozen":
                self._frozen[:] = bool(value)
            case "frozen z":
                self._frozen[2] = bool(value)
            case "lost":
                self._lost = bool(value)
            case "repeated":
                self._repeats = round(value)
            case "jump":
                self._offset = np.array([0.0, 0.0, value])
            case _:
                raise InputError(f"poses have the faults frozen, frozen z, lost, repeated and jump, not {what!r}")

    def switch(self, name: str, value: float) -> None:
        """Apply a written parameter of `SWITCHES`; that of another deck has no effect."""
        if name == self.switched_by:
            self._off = value == SWITCHES[name]

    def due(self, step: int) -> bool:
        """True if a measurement arrives at millisecond `step`."""
        return (
            not (self._lost or self._off)
            and (step + self._phase) % self._every == 0
            and not (self._loss and self._random.random() < self._loss)
        )

    def measure(self, position: np.ndarray, quaternion: np.ndarray) -> Pose:
        """Return the measured pose for the true `position` (3,) and `quaternion` (4,)."""
        noise = self._noise * self._random.standard_normal(6)
        turned = multiply_quaternions(quaternion, np.array([1.0, *(0.5 * ATTITUDE_NOISE * noise[3:])]))
        measured = position + POSITION_NOISE * noise[:3]
        return self._disturbed(measured, turned / np.sqrt(turned @ turned))

    def _disturbed(self, position: np.ndarray, quaternion: np.ndarray) -> Pose:
        pose = np.concatenate([position + self._offset, quaternion])
        self._count += 1
        if self._last is not None:
            pose = self._last if self._count % self._repeats else np.where(self._frozen, self._last, pose)
        self._last = pose
        return pose[:3], pose[3:]


class Deck(Positioning):
    """A system whose deck corrects the drone's filter on board. Faults change the true pose that it measures."""

    period = 1  # [ms] of its measurements
    parameters: ClassVar[Mapping[str, float]] = {}  # that indicate its presence
    logged: ClassVar[Mapping[str, float]] = {}  # its log variables without faults

    def __init__(self, surroundings: Surroundings, drone: int):
        """`drone`: 0 leader, 1 follower."""
        noise, world = (np.random.default_rng([surroundings.seed, 8, *more]) for more in ((drone,), ()))
        super().__init__(surroundings, noise, drone)
        self._every, self._phase = self.period, drone * self.period // 2
        self._sample_errors(world)

    def _sample_errors(self, world: np.random.Generator) -> None:
        """Sample the systematic errors, which both drones share; `world` has the same seed for both."""

    def _normal(self) -> float:
        return self._noise * float(self._random.standard_normal())

    def correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        """Correct `kalman` at millisecond `step` by measurements of the true `position` (3,) and `quaternion` (4,).

        `rates` (3,) [rad/s]: reading of the gyroscope.
        """
        self._correct(kalman, *self._disturbed(position, quaternion), rates, step)

    def _correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        raise NotImplementedError


class Lighthouse(Deck):
    """Position and yaw from two base stations."""

    period, switched_by = 20, "lighthouse.fwdToEstimator"
    parameters: ClassVar = {"deck.bcLighthouse4": 1.0}
    logged: ClassVar = {f"lighthouse.bs{name}": 0b11 for name in ("Receive", "Active", "GeoVal", "CalVal", "CalCon")}
    DISTORTION, JITTER, YAW_JITTER = 0.01, 1e-3, 0.01  # [1], [m], [rad]
    DEVIATIONS = 2.5e-3, 0.01  # standard deviations that the filter assumes, of position and yaw [m, rad]
    GAPS, SHORTEST, LONGER = 1.2, 0.05, 0.085  # gaps: rate [1/s], shortest [s], mean excess over the shortest [s]

    def _sample_errors(self, world: np.random.Generator) -> None:
        self._distortion = self._noise * self.DISTORTION * world.standard_normal((3, 3))
        self._blind = 0  # [ms] end of the gap

    def due(self, step: int) -> bool:
        """See `Positioning.due`."""
        if not super().due(step) or step < self._blind:
            return False
        if self._noise and self._random.random() < self.GAPS * self._every * 1e-3:
            self._blind = step + round(1000 * (self.SHORTEST + self._random.exponential(self.LONGER)))
        return True

    def _correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        jitter = self.JITTER * self._noise * self._random.standard_normal(3)
        measured = position + self._distortion @ position + jitter
        kalman.correct(measured, None, (self.DEVIATIONS[0], 1.0))
        turned = multiply_quaternions(conjugate(kalman.quaternion), quaternion)
        yaw = 2 * turned[3] * math.copysign(1.0, turned[0]) + self.YAW_JITTER * self._normal()
        kalman.correct_one(np.eye(9)[8], yaw, self.DEVIATIONS[1])


class Loco(Deck):
    """Differences of ranges to two anchors (TDoA)."""

    period, switched_by = 5, "loco.fwdToEstimator"  # two packets in each period
    parameters: ClassVar = {"deck.bcLoco": 1.0, "deck.bcDWM1000": 1.0}
    logged: ClassVar = {"loco.mode": 3, "ranging.state": 0, "tdoaEngine.stEst": 340.0}
    ANCHORS = np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-2.0, 2.0) for z in (0.2, 2.5)])  # [m]
    LOST, BIAS, JITTER = 0.15, 0.054, 0.10  # fraction of packets, [m], [m]
    DEVIATION = 0.15  # standard deviation that the filter assumes [m]

    def _sample_errors(self, world: np.random.Generator) -> None:
        self._bias = self._noise * self.BIAS * world.standard_normal(len(self.ANCHORS))

    def _correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        ranges = np.linalg.norm(self.ANCHORS - position, axis=1) + self._bias
        for _ in range(2):
            if self._random.random() < self.LOST:
                continue
            one, other = self._random.choice(len(self.ANCHORS), 2, replace=False)
            lines = kalman.position - self.ANCHORS[[one, other]]
            lengths = np.linalg.norm(lines, axis=1)
            row = np.zeros(9)
            row[:3] = lines[1] / lengths[1] - lines[0] / lengths[0]
            measured = ranges[other] - ranges[one] + self.JITTER * self._normal()
            kalman.correct_one(row, measured - (lengths[1] - lengths[0]), self.DEVIATION)


class Flow(Deck):
    """Optical flow of a camera that looks down, and the range to the ground."""

    period, switched_by = 12, "motion.disable"
    parameters: ClassVar = {"deck.bcFlow2": 1.0}
    PIXELS, APERTURE, COUNTS = 35.0, 0.71674, 10.0  # of the camera: [pixels], [rad], counts a pixel
    DEVIATION, HEIGHT = 2.0, 2.5e-3  # standard deviations [counts], [m]
    LOWEST = 0.1  # [m] lower bound of the height in the flow model
    HEIGHTS = 42  # [ms] between two measurements of the height

    def _sample_errors(self, world: np.random.Generator) -> None:
        self._before: tuple[np.ndarray, np.ndarray, int] | None = None  # position, quaternion, [ms]
        self._ranged = -self.HEIGHTS  # [ms] time of the last height

    def _correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        before, self._before = self._before, (position, quaternion, step)
        matrix = matrix_from_quaternion(quaternion)
        if step - self._ranged >= self.HEIGHTS:
            self._ranged, level = step, max(float(kalman.matrix[2, 2]), 0.1)
            row = np.eye(9)[2] / level
            measured = position[2] / max(matrix[2, 2], 0.1) + self.HEIGHT * self._normal()
            kalman.correct_one(row, measured - kalman.position[2] / level, self.HEIGHT)
        if before is None or step == before[2]:
            return
        dt = (step - before[2]) * 1e-3
        moved = matrix.T @ (position - before[0]) / dt
        turned = 2 * multiply_quaternions(conjugate(before[1]), quaternion)[1:3] / dt
        scale, height = self.COUNTS * self.PIXELS * dt / self.APERTURE, max(float(kalman.position[2]), self.LOWEST)
        for axis, turn in ((0, -1), (1, 0)):
            sign = 1.0 if axis else -1.0
            count = scale * (moved[axis] * matrix[2, 2] / max(position[2], self.LOWEST) + sign * turned[turn])
            measured = round(count + self.DEVIATION * self._normal())
            speed = kalman.body_velocity[axis] * kalman.matrix[2, 2] / height
            row = np.zeros(9)
            row[2], row[3 + axis] = -scale * speed / height, scale * kalman.matrix[2, 2] / height
            kalman.correct_one(row, measured - scale * (speed + sign * rates[turn]), self.DEVIATION)


DECKS: dict[str, type[Deck]] = {"lighthouse": Lighthouse, "loco": Loco, "flow": Flow}


def positioning_of(surroundings: Surroundings, random: np.random.Generator, drone: int) -> Positioning:
    """Return the positioning system of one drone; `random` is used by motion capture only."""
    deck = DECKS.get(surroundings.positioning)
    return Positioning(surroundings, random, drone) if deck is None else deck(surroundings, drone)
