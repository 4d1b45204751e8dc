"""Whether a drone's measurements keep changing, and move as its IMU says. Pure.

A frozen stream is found by its bits: no sensor repeats a value for half a second. Poses in wrong axes or of a wrong
scale, and an estimate that follows a frozen pose, are found by the IMU: the measured rotation is compared with the
integrated gyroscope, the measured displacement with the accelerometer integrated twice.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxfly.packets import GRAVITY, Sensed
from mjxfly.telemetry import Sample

REPEATING = 0.5  # [s] for which a value may stay bit-identical
SPARSE = 8  # the same over the mean time between two changes, if that is longer: poses at 10 Hz with losses
LIVE = 20  # changes after which a stream counts as live
GAP = 0.1  # [s] between two packets that counts as a gap


class Repeats:
    """Finds frozen parts of a stream. `update` with every packet."""

    def __init__(self, names: Sequence[str]):
        """`names` of the parts, each of which must keep changing."""
        self._names = names
        self._last: list[Hashable] = [None] * len(names)
        self._since = [0.0] * len(names)  # [s] of the last change
        self._changes = [0] * len(names)
        self._before, self._changed, self._interval = math.nan, math.nan, 0.0  # [s]

    def stands(self, seconds: float) -> bool:
        """True if no part of a live stream has changed in the `seconds` up to the newest packet."""
        return self.live and self._before - max(self._since) >= seconds - 1e-6

    @property
    def live(self) -> bool:
        """True once every part has changed `LIVE` times."""
        return min(self._changes) >= LIVE

    def update(self, parts: Sequence[Hashable], now: float) -> str:
        """The name of a part that has been frozen for too long, empty if none; `now` [s] is the packet's time."""
        gap = now - self._before
        if gap > GAP:
            self._since = [since + gap for since in self._since]
            self._changed += gap
        self._before = now
        if tuple(parts) != tuple(self._last):
            if not math.isnan(self._changed):
                self._interval += 0.1 * (now - self._changed - self._interval)
            self._changed = now
        for number, (part, last) in enumerate(zip(parts, self._last, strict=True)):
            if part != last:
                self._last[number], self._since[number] = part, now
                self._changes[number] += 1
        limit = max(REPEATING, SPARSE * self._interval)
        still = [name for name, since in zip(self._names, self._since, strict=True) if now - since >= limit]
        return still[0] if still and self.live else ""


WINDOW = 1.2  # [s] over which rotations and displacements are compared
TURN = 0.035  # [rad] by which the measured rotation may differ from the gyroscope's
LATE = 0.04  # [s] by which the measured attitude may lag the gyroscope
SHIFT, BIAS, SIGMAS = 0.012, 0.1, 4.0  # tolerance of displacements [m], [m/s2], standard deviations: `ImuWatch._felt`
CONTRADICTING = 0.1  # [s] for which they must differ
TURNED, MOVED = math.radians(10), 0.1  # [rad] and [m] about and along an axis in the window that verify the axis


class _Moment(NamedTuple):
    """Measured pose and IMU data at one packet."""

    time: float  # [s] of the firmware's clock
    fresh: bool  # the pose is a new measurement
    position: np.ndarray  # (3,) measured [m]
    quaternion: np.ndarray  # (4,) measured
    turned: np.ndarray  # (4,) rotation since the beginning, by the gyroscope
    rates: np.ndarray  # (3,) [rad/s]
    acceleration: np.ndarray  # (3,) in the world, by the accelerometer [m/s2]


class ImuWatch:
    """Compares one drone's measured motion with its IMU. `update` with every packet of sensed values."""

    def __init__(self, axes: Sequence[int] = (0, 1, 2), noise: float = 0.0):
        """`axes` of the world that are compared; `noise` [m] of positions beyond that of motion capture."""
        self._axes, self._tolerance = list(axes), SHIFT + SIGMAS * math.sqrt(6) * noise  # of a second difference
        self._moments: collections.deque[_Moment] = collections.deque()
        self._turned = np.array([1.0, 0.0, 0.0, 0.0])
        self._state: Sample | None = None
        self._wrong_since = math.inf
        self._turned_by, self._moved_by = np.zeros(3), np.zeros(3)  # largest within a window so far, [rad] and [m]

    def turn(self, sample: Sample) -> None:
        """Integrate the rates of a new state into the gyroscope's attitude."""
        before, self._state = self._state, sample
        if before is None or sample.stamp == before.stamp:
            return
        step = sample.stamp - before.stamp
        if not 0 < step <= GAP:
            self._moments.clear()
            return
        turn = 0.5 * step * (sample.state.rates + before.state.rates)
        self._turned = rotations.integrate_quaternion(self._turned, turn)

    def update(
        self, time: float, force: Sequence[float], position: np.ndarray, quaternion: np.ndarray, fresh: bool = True
    ) -> str:
        """Contradiction of measured motion and IMU, empty if there is none; `time` [s] of the firmware's clock.

        `force` (3,) [m/s2] is the accelerometer's; `position` (3,) [m] and `quaternion` (4,) repeat unless `fresh`.
        """
        if self._state is None or (self._moments and not 0 < time - self._moments[-1].time <= GAP):
            self._moments.clear()
            return ""
        felt = rotations.matrix_from_quaternion(quaternion) @ np.array(force) - np.array([0.0, 0.0, GRAVITY])
        rates = self._state.state.rates
        self._moments.append(_Moment(time, fresh, position, quaternion, self._turned, rates, felt))
        while time - self._moments[0].time > WINDOW:
            self._moments.popleft()
        known = [one for one in self._moments if one.fresh]
        if not fresh or time - known[0].time < 0.7 * WINDOW:
            return ""
        why = self._turn_fault(known[0], known[-1]) or self._way_fault(known)
        self._wrong_since = min(self._wrong_since, time) if why else math.inf
        if not why:
            turn = 2 * relative(known[0].quaternion, known[-1].quaternion)[1:]
            self._turned_by = np.maximum(self._turned_by, np.abs(turn))
            self._moved_by = np.maximum(self._moved_by, np.abs(known[-1].position - known[0].position))
        return why if time - self._wrong_since >= CONTRADICTING else ""

    def unverified_axes(self) -> str:
        """Instruction to move the drone by hand so that the remaining axes are verified; empty if all are."""
        turns = [name for name, angle in zip("xyz", self._turned_by, strict=True) if angle < TURNED]
        moves = [name for name, way in zip("xyz", self._moved_by, strict=True) if way < MOVED]
        orders = [f"turn it {math.degrees(TURNED):.0f} degrees about its {', '.join(turns)}"] if turns else []
        orders += [f"move it {MOVED:g} m along {', '.join(moves)}"] if moves else []
        return " and ".join(orders)

    @staticmethod
    def _turn_fault(first: _Moment, last: _Moment) -> str:
        measured = relative(first.quaternion, last.quaternion)
        felt = relative(first.turned, last.turned)
        beside = relative(felt, measured)[1:]
        angle = 2 * math.asin(min(math.sqrt(float(beside @ beside)), 1.0))
        slack = LATE * (np.linalg.norm(first.rates) + np.linalg.norm(last.rates))
        if angle <= TURN + slack:
            return ""
        return f"its attitude turned {math.degrees(angle):.1f} degrees otherwise than its gyroscope within {WINDOW:g} s"

    def _way_fault(self, known: Sequence[_Moment]) -> str:
        """Compare the second difference of the position with the accelerometer's, over the window and its last half."""
        last = known[-1]
        for share in (0.5, 1.0):
            begin = next(one for one in known if last.time - one.time <= share * WINDOW)
            middle = min(known, key=lambda one: abs(one.time - 0.5 * (begin.time + last.time)))
            before, after = middle.time - begin.time, last.time - middle.time
            if min(before, after) < 0.15 * share * WINDOW or not 0.5 <= after / before <= 2.0:
                continue
            way = last.position - middle.position - (middle.position - begin.position) * after / before
            felt, limit = self._felt(begin.time, middle.time, last.time)
            beside = (way - felt)[self._axes]
            size = math.sqrt(float(beside @ beside))
            if size > limit:
                return f"it moved {1000 * size:.0f} mm otherwise than its accelerometer within {share * WINDOW:g} s"
        return ""

    def _felt(self, begin: float, middle: float, end: float) -> tuple[np.ndarray, float]:
        """(second difference of position (3,) by the accelerometer at three times [s], its tolerance) [m].

        The tolerance allows for `BIAS` and for the accelerometer's noise in the window.
        """
        seen = [one for one in self._moments if one.time >= begin]
        times, felt = np.array([one.time for one in seen]), np.array([one.acceleration for one in seen])
        # Weight of the acceleration at each moment [s]: it rises from the first time to the middle, then falls.
        ratio = (end - middle) / (middle - begin)
        share = np.where(times > middle, end - times, (times - begin) * ratio)[:, None]
        noise = math.sqrt(0.5 * float(np.square(np.diff(felt, axis=0)).sum(axis=1).mean()))
        step = (end - begin) / max(len(seen) - 1, 1)
        limit = (
            self._tolerance
            + BIAS * float(share.sum()) * step
            + SIGMAS * noise * step * math.sqrt(float(np.square(share).sum()))
        )
        return np.trapezoid(share * felt, times, axis=0), limit


class DroneWatch:
    """Finds frozen streams and contradictions to the IMU of one drone."""

    def __init__(self, axes: Sequence[int], noise: float = 0.0):
        """`axes` of the world along which the drone can move; `noise` [m] as in `ImuWatch`."""
        self._estimate = Repeats(("estimate", "gyroscope"))
        self._pose = Repeats(("x", "y", "z", "attitude"))
        self.imu = ImuWatch(axes, noise)
        self._seen: Sample | None = None
        self._sensed = -math.inf  # [s] of the newest packet
        self._measured: Sequence[object] = ()  # pose in it

    def stands(self, seconds: float) -> bool:
        """True if neither estimate nor gyroscope has changed for `seconds` although states arrive."""
        return self._estimate.stands(seconds)

    def state(self, sample: Sample) -> str:
        """Message on a frozen part of the drone's states, empty if there is none."""
        if self._seen is not None and sample.stamp == self._seen.stamp:
            return ""
        self._seen = sample
        self.imu.turn(sample)
        one = sample.state
        estimate = (*one.position.tolist(), *one.velocity.tolist(), *one.quaternion.tolist())
        still = self._estimate.update((estimate, tuple(one.rates.tolist())), sample.stamp)
        return f"the numbers of its {still} stand still" if still else ""

    def sensed(self, sensed: Sensed, time: float) -> tuple[str, str]:
        """Messages (frozen pose, contradiction to the IMU), each empty if none; `time` [s] of the firmware's clock."""
        if self._seen is None or time <= self._sensed:
            return "", ""
        self._sensed, before = time, self._measured
        self._measured = sensed[1:]
        fresh = self._measured != before
        still = self._pose.update((*sensed.position, sensed.quaternion), time)
        place, attitude = np.array(sensed.position), unit(sensed.quaternion)
        if not self._pose.live:  # no external poses, as with a positioning deck: use the estimate
            place, attitude = self._seen.state.position, self._seen.state.quaternion
        wrong = self.imu.update(time, sensed.force, place, attitude, fresh or not self._pose.live)
        return f"{still} of its measured pose stands still" if still else "", wrong


def relative(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(4,) quaternion of the rotation from `one` to `other`, in the body axes of `one`."""
    return np.asarray(rotations.multiply_quaternions(rotations.conjugate(one), other))


def unit(quaternion: Sequence[float]) -> np.ndarray:
    """A coarse `quaternion` (w, x, y, z) at unit length, with w computed from x, y, z."""
    w, *vector = quaternion
    return np.array([math.copysign(math.sqrt(max(1.0 - sum(v * v for v in vector), 0.0)), w), *vector])
