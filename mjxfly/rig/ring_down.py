"""Frequency and damping of a mode from the oscillation that a tap leaves, by a fit of damped sines (ours)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

Array = np.ndarray
LOWEST = 4.0  # [Hz] slower oscillations are taken for motion of the hand
LENGTH, SHORTEST = 0.8, 0.15  # [s] of an oscillation that is fitted
CONTACT = 0.02  # [s] after the largest rate, in which the finger may still touch the drone
MOST = 12  # taps of one log that are fitted
FAINT, SMALL = 0.03, 0.4  # a tap's largest rate is more than this [rad/s], and than this share of the largest one
EXPLAINED = 0.8  # least share of an oscillation's variance that its fit explains
STEPS = 30  # of Gauss-Newton
STILL = 3  # coefficients of the polynomial in time that stands for motion of the hand


class Mode(NamedTuple):
    """A mode, from one oscillation or several."""

    frequency: float  # [Hz], undamped
    damping: float  # ratio
    deviation: float  # standard deviation of `frequency` [Hz]
    taps: int = 1


def find_mode(time: Array, rate: Array) -> Mode | None:
    """The mode in `rate` (T,) [rad/s] at `time` (T,) [s] of a drone that is tapped; None if no tap rings.

    Frequencies from `LOWEST` up to half of the rate of rows are found; a faster mode shows at another frequency.
    """
    spacing = float(np.median(np.diff(time)))
    found = [fit(time[rows], rate[rows], spacing) for rows in taps(time, rate)]
    modes = [one for one in found if one is not None]
    if not modes:
        return None
    # A tap at the wrong place or a touch spoils single ones: those near the median count, by their precision.
    middle = float(np.median([one.frequency for one in modes]))
    near = [one for one in modes if abs(one.frequency - middle) <= max(0.05 * middle, 3 * one.deviation)]
    if not near:
        return None
    weights = np.array([1 / one.deviation**2 for one in near])
    frequency, damping = (float(weights @ values / weights.sum()) for values in np.transpose([one[:2] for one in near]))
    scatter = np.std([one.frequency for one in near]) / math.sqrt(len(near))
    return Mode(frequency, damping, max(float(scatter), float(weights.sum() ** -0.5)), len(near))


def taps(time: Array, rate: Array) -> list[slice]:
    """Rows of the oscillations after the largest rates, in order of time."""
    rows = max(3, round(1 / LOWEST / float(np.median(np.diff(time)))))
    left = np.abs(rate - np.convolve(rate, np.full(rows, 1 / rows), mode="same"))
    least, begins = max(FAINT, SMALL * float(left.max())), list[float]()
    while len(begins) < MOST and left.max() > least:
        begin = float(time[int(left.argmax())])
        begins.append(begin)
        left[(time > begin - LENGTH) & (time < begin + LENGTH)] = 0.0
    found = []
    for begin in sorted(begins):
        first, last = np.searchsorted(time, [begin + CONTACT, begin + LENGTH])
        if time[min(last, len(time) - 1)] - begin > SHORTEST + CONTACT:
            found.append(slice(int(first), int(last)))
    return found


def fit(time: Array, rate: Array, spacing: float) -> Mode | None:
    """Least-squares fit of exp(-d t) (a cos w t + b sin w t) and a parabola; None if it explains too little.

    w and d by Gauss-Newton from the largest peak of the periodogram, all else is linear. `spacing` of rows in [s].
    """
    t, count = time - time[0], len(time)
    if count < 2 * (STILL + 4):
        return None
    powers = np.vander(t / t[-1], STILL)
    still = rate - powers @ np.linalg.lstsq(powers, rate, rcond=None)[0]
    grid = np.arange(LOWEST, 0.5 / spacing, 0.25 / t[-1])
    window = np.hanning(2 * count)[count:]  # falls from 1 to 0: the oscillation begins at its largest
    spectrum = np.abs(np.exp(-2j * math.pi * np.outer(grid, t)) @ (window * still))
    unknown = np.array([2 * math.pi * grid[int(spectrum.argmax())], 3.0 / t[-1]])
    residual, inverse = _residual(t, rate, unknown), np.eye(2)
    for _ in range(STEPS):
        step = np.array([1e-4 * unknown[0], 1e-3 * unknown[0]])
        jacobian = np.stack(
            [(_residual(t, rate, unknown + change) - residual) / change.sum() for change in np.diag(step)], axis=1
        )
        inverse = np.linalg.pinv(jacobian.T @ jacobian)
        change = -inverse @ jacobian.T @ residual
        unknown = unknown + np.clip(change, -0.1 * unknown[0], 0.1 * unknown[0])
        unknown[1] = np.clip(unknown[1], 0.0, unknown[0])
        residual = _residual(t, rate, unknown)
    frequency = math.hypot(*unknown) / (2 * math.pi)
    if residual @ residual > (1 - EXPLAINED) * still @ still or not LOWEST <= frequency < 0.5 / spacing:
        return None
    noise = float(residual @ residual) / (count - STILL - 4)
    deviation = math.sqrt(noise * float(inverse[0, 0])) / (2 * math.pi)
    return Mode(frequency, float(unknown[1] / math.hypot(*unknown)), max(deviation, 1e-3 * frequency))


def _residual(t: Array, rate: Array, unknown: Array) -> Array:
    """What the best damped sine of angular frequency and decay `unknown` (2,) [1/s] leaves of `rate`."""
    decay = np.exp(-unknown[1] * t)
    columns = [decay * np.cos(unknown[0] * t), decay * np.sin(unknown[0] * t), *np.vander(t / t[-1], STILL).T]
    basis = np.stack(columns, axis=1)
    return rate - basis @ np.linalg.lstsq(basis, rate, rcond=None)[0]
