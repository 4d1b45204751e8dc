"""Consistency of a recording: axes and units of its velocities and rates, and its clocks. Pure.

Recorded velocities are compared with the change of the positions, body rates with the change of the attitudes. Two
drones on one stick have the same body rates, which gives the offset between their clocks. Their vertical acceleration
follows the thrust setpoints after the motors' lag, which gives the offset between setpoints and states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxfly.limits import NAMES
from mjxfly.log_sources import Samples
from mjxfly.packets import GRAVITY

SILENCE = 0.1  # [s] between two rows that counts as a gap
UNEVEN = 0.1  # largest deviation of a quaternion's length from 1
SPARSE = 2.5  # median steps between two rows that count as a gap in a slower series
HORIZON = 0.2  # [s] over which motion is compared
# In 5 s of public flights of one drone over a radio (NanoBench), positions change by 0.94 to 1.21 of the estimated
# velocities, attitudes by 0.82 to 1.20 of the rates, but never both by more or both by less; lags vary by 0.03 s.
MIN_CORRELATION = 0.8  # least correlation for a ratio to be used
SCALE, UNIT = 1.12, 1.35  # factor at which both ratios together, or one alone, count as wrong

GRID = 0.005  # [s]
SMOOTH, SLOW = 0.1, 1.0  # [s] moving averages of the band-pass: smoothing, and the trend that is subtracted
WINDOW, SEARCH = 3.0, 0.4  # [s] length of a window, and search range of its lag about that of the whole recording
ALIKE, CLEAR = 0.5, 0.8  # least correlation of two whole signals that match, and of a window for its lag to count
FARTHEST = 5.0  # [s] largest offset that is searched between the clocks of one recording
NEAR = 0.04  # [s] allowed between two drones' clocks; 0.02 s changes identified lag and inertia by 3 % and 1 %
TURNING, LIFTING = 0.01, 0.06  # least rms of body rates [rad/s], vertical acceleration [m/s2] in a window that counts
MOVING = 0.1  # [m/s] or [rad/s] least rms of a motion whose ratio is judged
LIFT_LAGS = (0.015, 0.25)  # [s] bounds of the time from setpoint to acceleration: motor lag and delay
LIFT_CHANGE = 0.06  # [s] by which that may change within a flight


def known(time: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n,) whether each of `time` (n,) lies in no gap of a series sampled at times `at` (m,)."""
    limit = max(SILENCE, SPARSE * float(np.median(np.diff(at)))) if len(at) > 1 else SILENCE
    after = np.searchsorted(at, time)
    before, following = at[np.maximum(after - 1, 0)], at[np.minimum(after, len(at) - 1)]
    inside = (following == time) | ((following - before <= limit) & (before <= time) & (time <= following))
    return np.asarray(inside | ((np.minimum(abs(time - at[0]), abs(time - at[-1])) <= limit) & (before == following)))


class Motion(NamedTuple):
    """Mean rates over spans of `HORIZON`, (m, 3): `measured` from differences, `said` from the recorded rates."""

    measured: np.ndarray
    said: np.ndarray

    @property
    def size(self) -> float:
        """Root mean square of the measured rates."""
        return _rms(self.measured)

    @property
    def error(self) -> float:
        """Root mean square of the difference."""
        return _rms(self.measured - self.said)

    @property
    def ratio(self) -> float:
        """Measured over recorded rates, 1 if they do not correlate enough."""
        product = float((self.measured * self.said).sum())
        lengths = float(np.linalg.norm(self.measured)), float(np.linalg.norm(self.said))
        return lengths[0] / lengths[1] if product > MIN_CORRELATION * lengths[0] * lengths[1] > 0 else 1.0


def way(time: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> Motion:
    """`Motion` of positions (n, 3) [m] and velocities (n, 3) [m/s] in the same axes."""
    begin, end = _spans(time)
    step = (time[end] - time[begin])[:, None]
    return Motion((position[end] - position[begin]) / step, _integral(time, velocity, begin, end) / step)


def turn(time: np.ndarray, quaternion: np.ndarray, rates: np.ndarray) -> Motion:
    """`Motion` of attitudes (n, 4) and rates (n, 3) [rad/s] in the drone's axes."""
    begin, end = _spans(time)
    apart = np.asarray(rotations.multiply_quaternions(rotations.conjugate(quaternion[begin]), quaternion[end]))
    apart = np.where(apart[:, :1] < 0, -apart, apart)
    step = (time[end] - time[begin])[:, None]
    return Motion(2 * apart[:, 1:] / step, _integral(time, rates, begin, end) / step)


def _spans(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of all spans of about `HORIZON` without a gap."""
    begin = np.arange(len(time))
    end = np.searchsorted(time, time + HORIZON)
    holes = np.concatenate([[0], np.cumsum(np.diff(time) > SILENCE)])
    within = np.minimum(end, len(time) - 1)
    sound = (end < len(time)) & (holes[within] == holes)
    return begin[sound], end[sound]


def _integral(time: np.ndarray, rows: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    pieces = 0.5 * (rows[1:] + rows[:-1]) * np.diff(time)[:, None]
    whole = np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(pieces, axis=0)])
    return np.asarray(whole[end] - whole[begin])


def _rms(rows: np.ndarray) -> float:
    return float(np.sqrt(np.square(rows).sum(axis=1).mean())) if len(rows) else 0.0


@dataclass(frozen=True)
class Lag:
    """Time by which a signal lags another one, linear in time from the beginning to the end of the recording."""

    alike: float  # correlation of the whole signals at one lag
    begin: float  # [s] on the first signal's clock
    end: float
    at_begin: float  # [s] lag of the second signal
    at_end: float
    clear: bool  # whether it was found in at least one window

    @property
    def worst(self) -> float:
        """The lag of larger magnitude [s]."""
        return max(self.at_begin, self.at_end, key=abs)

    def on_first_clock(self, time: np.ndarray) -> np.ndarray:
        """`time` [s] on the second clock, converted to the first."""
        firsts = np.array([self.begin, self.end])
        slope = (self.at_end - self.at_begin) / (self.end - self.begin)
        return np.asarray(firsts[0] + (time - firsts[0] - self.at_begin) / (1 + slope))


def lag(one: Samples, other: Samples, least: float, farthest: float = math.inf) -> Lag:
    """Lag of `other` against `one`, two signals (n, k); windows with an rms below `least` do not count."""
    (first, a), (second, b) = _band(one), _band(other)
    length = len(a) + len(b)
    products = np.fft.rfft(b, length, axis=0) * np.conj(np.fft.rfft(a, length, axis=0))
    agree = np.fft.irfft(products, length, axis=0).sum(axis=1)
    shifts = np.arange(length)
    shifts = np.where(shifts < len(b), shifts, shifts - length)
    overlap = np.minimum(len(a), len(b) - shifts) - np.maximum(0, -shifts)
    allowed = (2 * overlap >= min(len(a), len(b))) & (abs(shifts * GRID + second - first) <= farthest)
    best = int(shifts[np.where(allowed, agree, -np.inf).argmax()])
    begin, end = max(0, -best), min(len(a), len(b) - best)
    scale = np.linalg.norm(a[begin:end]) * np.linalg.norm(b[begin + best : end + best])
    alike = float((a[begin:end] * b[begin + best : end + best]).sum() / scale) if scale else 0.0
    found = np.array([*_window_lags(a, b, best, least)]).reshape(-1, 2)
    ends = first + GRID * np.array([begin, end])
    at = np.full(2, second - first + best * GRID)
    if len(found):
        middles, late = found.T
        slope, level = np.polyfit(middles, late, 1) if len(found) > 2 else (0.0, late.mean())
        at = second - first + level + slope * (ends - first)
    return Lag(alike, float(ends[0]), float(ends[1]), float(at[0]), float(at[1]), bool(len(found)))


def _band(samples: Samples) -> tuple[float, np.ndarray]:
    """(time of the first row, rows `GRID` apart) of `samples`, band-passed by two moving averages."""
    time, rows = samples
    grid = np.arange(time[0], time[-1], GRID)
    columns = np.stack([np.interp(grid, time, column) for column in rows.T], axis=1)

    def smoothed(values: np.ndarray, seconds: float) -> np.ndarray:
        size = min(round(seconds / GRID) | 1, len(values))
        padded = np.pad(values, ((size // 2, size - 1 - size // 2), (0, 0)), mode="edge")
        sums = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), padded]), axis=0)
        return np.asarray((sums[size:] - sums[:-size]) / size)

    return float(time[0]), smoothed(columns - smoothed(columns, SLOW), SMOOTH)


def _window_lags(a: np.ndarray, b: np.ndarray, shift: int, least: float) -> list[tuple[float, float]]:
    """(middle of the window from the first row of `a`, lag) [s] of all `CLEAR` windows, searched about `shift` rows."""
    size, search, found = round(WINDOW / GRID), round(SEARCH / GRID), []
    for begin in range(max(0, search - shift), min(len(a), len(b) - shift - search) - size + 1, size // 4):
        mine = a[begin : begin + size]
        theirs = b[begin + shift - search : begin + shift + search + size]
        products = sum(np.correlate(x, y, "valid") for x, y in zip(theirs.T, mine.T, strict=True))
        squares = np.cumsum(np.concatenate([[0.0], np.square(theirs).sum(axis=1)]))
        power = squares[size:] - squares[:-size]
        if min(power.mean(), np.square(mine).sum()) < size * least**2:
            continue
        alike = products / np.sqrt(np.maximum(power, 1e-300) * np.square(mine).sum())
        best = int(alike.argmax())
        if alike[best] >= CLEAR and 0 < best < len(alike) - 1:
            before, top, after = alike[best - 1 : best + 2]
            between = 0.5 * (before - after) / (before - 2 * top + after) if top > max(before, after) else 0.0
            found.append((GRID * (begin + size / 2), GRID * (shift + best - search + between)))
    return found


def faults(sent: Samples, recorded: Sequence[Samples]) -> list[str]:
    """Faults of the clocks of leader and follower, as phrases for messages.

    `sent` (T, 2, 4) are the setpoints of a flight in the air, `recorded` the states (S, 13) of both drones; those
    outside the time of `sent` are ignored.
    """
    begin, end = sent[0][[0, -1]]
    within = [(time >= begin) & (time <= end) for time, _ in recorded]
    states = [(time[own], rows[own]) for (time, rows), own in zip(recorded, within, strict=True)]
    if min(len(time) for time, _ in states) < 2:
        return []
    found = [text for name, own in zip(NAMES, states, strict=True) if (text := _scale_fault(name, own))]
    leader, follower = ((time, rows[:, 10:13]) for time, rows in states)
    between = lag(leader, follower, TURNING, FARTHEST)
    if between.clear and abs(between.worst) > NEAR:
        found.append(f"by their rates {_offset_text('the follower', between, 'the leader')}")
    elif not between.clear and between.alike < ALIKE and min(_moving(leader), _moving(follower)) > MOVING:
        found.append(f"at best the two drones' rates agree by {between.alike:.2f}, and on one stick they are the same")
    elif text := _lift_fault(sent, states):
        found.append(text)
    return found


def _moving(samples: Samples) -> float:
    return _rms(_band(samples)[1])


def _offset_text(one: str, lag: Lag, other: str) -> str:
    what = f"{abs(lag.at_begin):.3f} s {'late' if lag.at_begin > 0 else 'early'}"
    if abs(lag.at_end - lag.at_begin) > 0.01:
        what += f" at first and {abs(lag.at_end):.3f} s {'late' if lag.at_end > 0 else 'early'} at last"
    return f"{one}'s states are {what} against {other}'s"


def _scale_fault(name: str, states: Samples) -> str:
    time, rows = states
    moved, turned = way(time, rows[:, :3], rows[:, 3:6]), turn(time, rows[:, 6:10], rows[:, 10:13])
    ratios = [one.ratio if one.size > MOVING else 1.0 for one in (moved, turned)]
    factors = np.log(ratios)
    both = max(factors.min(), -factors.max())  # a wrong clock scales both alike
    if both <= math.log(SCALE) and abs(factors).max() <= math.log(UNIT):
        return ""
    return (
        f"the {name}'s positions change by {ratios[0]:.2f} of its velocities, and its attitudes by {ratios[1]:.2f} of "
        "its rates: its clock or its units are wrong"
    )


def _lift_fault(sent: Samples, states: Sequence[Samples]) -> str:
    """A message unless the pair's vertical acceleration follows the sent thrust with a plausible lag, else "".

    Both are means over the drones, which the stick's rotation does not change.
    """
    ticks, setpoints = sent
    grid = np.arange(
        max(ticks[0], *(time[0] for time, _ in states)), min(ticks[-1], *(time[-1] for time, _ in states)), GRID
    )
    if len(grid) < 2:
        return ""
    thrust = setpoints[np.searchsorted(ticks, grid, side="right") - 1, :, 3].mean(axis=1)
    climb = np.mean([np.interp(grid, time, rows[:, 5]) for time, rows in states], axis=0)
    pushed = GRAVITY / max(float(thrust.mean()), 1.0) * thrust  # [m/s2], as if the mean thrust were that of hover
    found = lag((grid, pushed[:, None]), (grid, np.gradient(climb, grid)[:, None]), LIFTING, FARTHEST)
    middle, change = 0.5 * (found.at_begin + found.at_end), found.at_end - found.at_begin
    if not found.clear or (LIFT_LAGS[0] < middle < LIFT_LAGS[1] and abs(change) < LIFT_CHANGE):
        return ""
    return (
        f"by its climb the pair follows what was sent after {found.at_begin:.3f} s at first and {found.at_end:.3f} s "
        f"at last; expected {LIFT_LAGS[0]:g} to {LIFT_LAGS[1]:g} s, of motors, and no change"
    )
