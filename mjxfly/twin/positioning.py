"""Positioning systems of the twin: what reaches a drone's Kalman filter, how often, how wrong, and when it is missing.

- mocap: poses, 100 a second, 0.3 mm and 1 mrad (Merriaux 2017, Sensors 17(7) 1591, Vicon: 0.15 mm at rest, below 2 mm
  in motion).
- lighthouse: two V2 base stations. 50 positions a second (Bitcraze, "Lighthouse positioning system"). Of the public
  flights lh2_kalman_flight 00 and 01 with a motion capture system beside (bitcraze/positioning_dataset; Taffanel 2021,
  arXiv 2104.11523; evaluated by us): mean error 16 mm, most of it a linear distortion of the world by some 1 % an axis;
  0.1 to 2 mm of jitter at rest; 1.2 gaps of more than 50 ms a second, 135 ms long in the mean.
- loco: TDoA 3, eight anchors in the corners of a room. 400 packets a second, of which 15 % are lost (Bitcraze's blog on
  TDoA 3, 2018). Errors of ranges differ by 54 mm from anchor to anchor (Bitcraze, "accuracy and precision of the Loco
  Positioning"); their noise is such that an estimate at rest moves by 5 to 20 mm, as there: 0.10 m a difference.
- flow: deck v2. 85 counts and 24 heights a second, with the deviations that the firmware's filter takes, 2 counts and
  2.5 mm (bitcraze/crazyflie-firmware 2026.08; rates of the flights flowv2_flight_carpet 01 to 03 of the same dataset,
  where the position is 0.24, 0.06 and 0.86 m off after 65 s).

A distortion and the anchors' errors are the world's and the same for both drones. Gyroscopes have no bias here, so yaw,
which loco and flow do not measure, keeps still. The measurement models are those of the firmware's filter, but the
Lighthouse's, which takes angles of sweeps: here the position that they make, with 1 mrad at 2.5 m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from mjxball.control.rotations import conjugate, matrix_from_quaternion, multiply_quaternions
from mjxfly.twin.conditions import Surroundings
from mjxfly.twin.estimators import Kalman

Pose = tuple[np.ndarray, np.ndarray]  # position (3,) [m], quaternion (4,)
POSITION_NOISE, ATTITUDE_NOISE = 3e-4, 1e-3  # of motion capture: standard deviations [m, rad]


# Parameters of decks, each with the value at which nothing reaches the filter.
SWITCHES = {"lighthouse.fwdToEstimator": 0.0, "loco.fwdToEstimator": 0.0, "motion.disable": 1.0}


class Positioning:
    """Motion capture of one drone: whole poses; and of every system, when it measures and its faults."""

    switched_by = ""  # which of `SWITCHES`

    def __init__(self, surroundings: Surroundings, random: np.random.Generator, phase: int):
        """`phase` [ms] of its first pose: the systems of two drones do not measure at the same moment."""
        self._every = max(round(1000 / surroundings.pose_hz), 1)
        self._noise, self._random = surroundings.noise, random
        self._phase = phase * self._every // 2
        self._loss = surroundings.pose_loss
        self._lost = not surroundings.deck
        self._off = False  # by a parameter of the deck
        self._frozen = np.zeros(7, bool)  # of x, y, z and the quaternion
        self._repeats = 1  # poses in a row that are one
        self._offset, self._count = np.zeros(3), 0
        self._last: np.ndarray | None = None  # (7,) position [m], quaternion

    def disturb(self, what: str, value: float) -> None:
        """See `Pair.disturb`: "frozen" or "lost", "frozen z" alone, each "repeated" `value` times, a "jump"."""
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

    def switch(self, name: str, value: float) -> None:
        """A parameter of `SWITCHES` was written; it matters to its own deck alone."""
        if name == self.switched_by:
            self._off = value == SWITCHES[name]

    def due(self, step: int) -> bool:
        """True if a measurement comes at millisecond `step`."""
        return (
            not (self._lost or self._off)
            and (step + self._phase) % self._every == 0
            and not (self._loss and self._random.random() < self._loss)
        )

    def measure(self, position: np.ndarray, quaternion: np.ndarray) -> Pose:
        """The pose that is measured of the true `position` (3,) and `quaternion` (4,)."""
        drawn = self._noise * self._random.standard_normal(6)
        turned = multiply_quaternions(quaternion, np.array([1.0, *(0.5 * ATTITUDE_NOISE * drawn[3:])]))
        place = position + POSITION_NOISE * drawn[:3]
        return self._disturbed(place, turned / np.sqrt(turned @ turned))

    def _disturbed(self, position: np.ndarray, quaternion: np.ndarray) -> Pose:
        found = np.concatenate([position + self._offset, quaternion])
        self._count += 1
        if self._last is not None:
            found = self._last if self._count % self._repeats else np.where(self._frozen, self._last, found)
        self._last = found
        return found[:3], found[3:]


class Deck(Positioning):
    """A system whose deck corrects the drone's filter by itself. What is frozen or jumps is the pose that it sees."""

    period = 1  # [ms] between two moments at which it may measure
    parameters: ClassVar[Mapping[str, float]] = {}  # that tell that it is there
    logged: ClassVar[Mapping[str, float]] = {}  # log variables of it, while all is well

    def __init__(self, surroundings: Surroundings, drone: int):
        """Of `drone`: 0 leader, 1 follower."""
        own, world = (np.random.default_rng([surroundings.seed, 8, *more]) for more in ((drone,), ()))
        super().__init__(surroundings, own, drone)
        self._every, self._phase = self.period, drone * self.period // 2
        self._draw_world(world)

    def _draw_world(self, world: np.random.Generator) -> None:
        """Draw what is wrong with the system itself, alike for both drones."""

    def _normal(self) -> float:
        return self._noise * float(self._random.standard_normal())

    def correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        """Correct `kalman` at millisecond `step` by what is seen of the true `position` (3,) and `quaternion` (4,).

        `rates` (3,) [rad/s] are the gyroscope's.
        """
        self._correct(kalman, *self._disturbed(position, quaternion), rates, step)

    def _correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        raise NotImplementedError


class Lighthouse(Deck):
    """See the module."""

    period, switched_by = 20, "lighthouse.fwdToEstimator"
    parameters: ClassVar = {"deck.bcLighthouse4": 1.0}
    logged: ClassVar = {f"lighthouse.bs{name}": 0b11 for name in ("Receive", "Active", "GeoVal", "CalVal", "CalCon")}
    DISTORTION, JITTER, YAW_JITTER = 0.01, 1e-3, 0.01  # [1], [m], [rad]
    DEVIATIONS = 2.5e-3, 0.01  # that the filter takes, of position and yaw [m, rad]
    GAPS, SHORTEST, LONGER = 1.2, 0.05, 0.085  # [1/s], [s], mean beyond the shortest [s]

    def _draw_world(self, world: np.random.Generator) -> None:
        self._distortion = self._noise * self.DISTORTION * world.standard_normal((3, 3))
        self._blind = 0  # [ms] until which no base station is seen

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
        place = position + self._distortion @ position + jitter
        kalman.correct(place, None, (self.DEVIATIONS[0], 1.0))
        turned = multiply_quaternions(conjugate(kalman.quaternion), quaternion)
        yaw = 2 * turned[3] * math.copysign(1.0, turned[0]) + self.YAW_JITTER * self._normal()
        kalman.correct_one(np.eye(9)[8], yaw, self.DEVIATIONS[1])


class Loco(Deck):
    """See the module."""

    period, switched_by = 5, "loco.fwdToEstimator"  # two packets come in a period
    parameters: ClassVar = {"deck.bcLoco": 1.0, "deck.bcDWM1000": 1.0}
    logged: ClassVar = {"loco.mode": 3, "ranging.state": 0, "tdoaEngine.stEst": 340.0}
    ANCHORS = np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-2.0, 2.0) for z in (0.2, 2.5)])  # [m]
    LOST, BIAS, JITTER = 0.15, 0.054, 0.10  # share of packets, [m], [m]
    DEVIATION = 0.15  # that the filter takes [m]

    def _draw_world(self, world: np.random.Generator) -> None:
        self._bias = self._noise * self.BIAS * world.standard_normal(len(self.ANCHORS))

    def _correct(
        self, kalman: Kalman, position: np.ndarray, quaternion: np.ndarray, rates: np.ndarray, step: int
    ) -> None:
        true = np.linalg.norm(self.ANCHORS - position, axis=1) + self._bias
        for _ in range(2):
            if self._random.random() < self.LOST:
                continue
            one, other = self._random.choice(len(self.ANCHORS), 2, replace=False)
            ways = kalman.position - self.ANCHORS[[one, other]]
            lengths = np.linalg.norm(ways, axis=1)
            row = np.zeros(9)
            row[:3] = ways[1] / lengths[1] - ways[0] / lengths[0]
            measured = true[other] - true[one] + self.JITTER * self._normal()
            kalman.correct_one(row, measured - (lengths[1] - lengths[0]), self.DEVIATION)


class Flow(Deck):
    """See the module."""

    period, switched_by = 12, "motion.disable"
    parameters: ClassVar = {"deck.bcFlow2": 1.0}
    PIXELS, APERTURE, COUNTS = 35.0, 0.71674, 10.0  # of the camera: [pixels], [rad], counts a pixel
    DEVIATION, HEIGHT = 2.0, 2.5e-3  # [counts], [m]
    LOWEST = 0.1  # [m] height that the filter takes at least
    HEIGHTS = 42  # [ms] between two heights

    def _draw_world(self, world: np.random.Generator) -> None:
        self._before: tuple[np.ndarray, np.ndarray, int] | None = None  # position, quaternion, [ms]
        self._ranged = -self.HEIGHTS  # [ms]

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
    """The system of one drone in `surroundings`; `random` is motion capture's."""
    deck = DECKS.get(surroundings.positioning)
    return Positioning(surroundings, random, drone) if deck is None else deck(surroundings, drone)
