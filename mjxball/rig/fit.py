"""Least squares over all windows of a log at once: what is sought is common, how a window begins is its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.crazyflie import PERIOD
from mjxball.errors import InputError
from mjxball.rig.axis import inertia_about_o
from mjxball.rig.log import Log
from mjxball.rig.model import Passed, Sought, Start, fly_windows, replay

Array = np.ndarray
WINDOW = 1.0  # [s]
FEWEST_WINDOWS, MOST_WINDOWS = 5, 40
NOISE = np.array([0.005, 0.02, 0.02])  # of roll [rad], its rate [rad/s], climb [m/s]
LOWEST_THRUST = 15000.0  # of both drones in a window that counts
ROUNDS, STEPS = 3, 4
# Logarithms of thrust, inertia, lag and of how uneven the thrust is, then the delay [s]; steps of differences, which
# must be small where two unknowns nearly do the same; prior widths; largest change.
DIFFERENCE = np.array([0.001, 0.002, 0.005, 0.001, 0.0004])
PRIOR = np.array([0.3, 0.7, 0.7, 0.05, 0.02])
LARGEST = np.array([0.2, 0.4, 0.4, 0.05, 0.01])
START_DIFFERENCE = np.array([0.0005, 0.002, 0.002, 0.02, 0.04, 0.08, 0.002])
COMMON, OWN = len(DIFFERENCE), len(START_DIFFERENCE)
UNKNOWN_LIFT = 0.1  # [m/s2] standard deviation of `Start.lift` from window to window
SHORTEST_LAG, LONGEST_DELAY = 0.005, 0.06  # [s]


class Found(NamedTuple):
    """What was identified, with one standard deviation of each by the fit's own account."""

    thrust: float  # factor on the force of every motor
    inertia: float  # [kg m2]
    lag: float  # [s]
    delay: float  # [s]
    spread: tuple[float, float, float, float]  # of thrust, inertia, lag (shares) and delay [s]
    misfit: float  # root mean square of what is left, in units of the assumed noise
    windows: int
    uneven: float = 0.0  # share by which the leader's force is above, and the follower's below, the factor `thrust`
    uneven_spread: float = 1.0


def identify(config: Config, log: Log) -> Found:
    """Fit the plant of `config` to `log`. Raises InputError if there is too little of it."""
    begins, ticks = _windows(log)
    nominal = np.array([0.0, np.log(inertia_about_o(config)[0]), np.log(config.plant.rotor_lag), 0.0, 0.01])
    common, own = nominal.copy(), _starts(log, begins)
    left = spread = np.zeros(COMMON)
    for _ in range(ROUNDS):
        passed = replay(config, log, _sought(common[None]))
        for _ in range(STEPS):
            common, own, left, spread = _step(config, log, passed, begins, ticks, common, own, nominal)
    misfit = float(np.sqrt(np.mean(left**2)))
    spread = spread * max(misfit, 1.0)
    thrust, inertia, lag = map(float, np.exp(common[:3]))
    uneven, delay = map(float, common[3:])
    deviations = (float(spread[0]), float(spread[1]), float(spread[2]), float(spread[4]))
    return Found(thrust, inertia, lag, delay, deviations, misfit, len(begins), uneven, float(spread[3]))


def _windows(log: Log) -> tuple[Array, int]:
    """(n,) ticks at which windows begin, one after the other wherever the log can be used, and their length."""
    ticks, begins = round(WINDOW / PERIOD), []
    usable = log.usable & (log.setpoints[..., 3].min(axis=1) > LOWEST_THRUST)
    unusable = np.append(np.flatnonzero(~usable), len(usable))
    begin = log.every
    while begin + ticks < len(usable):
        next_unusable = unusable[np.searchsorted(unusable, begin)]
        if begin + ticks <= next_unusable:
            begins.append(begin)
            begin += ticks
        else:
            begin = int(next_unusable) + 1
    if len(begins) < FEWEST_WINDOWS:
        raise InputError(
            f"the log holds {len(begins)} s of flight that can be used; "
            f"{FEWEST_WINDOWS} s or more are needed, 20 s with steps are good"
        )
    chosen = np.array(begins, int)
    if len(chosen) > MOST_WINDOWS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_WINDOWS).astype(int)]
    return chosen, ticks


def _starts(log: Log, begins: Array) -> Array:
    """(n, OWN) first guesses of `Start`."""
    found = np.zeros((len(begins), OWN))
    found[:, 0], found[:, 1], found[:, 2] = log.euler[begins, 0], log.rates[begins, 0], log.climb[begins]
    return found


def _sought(common: Array) -> Sought:
    thrust, inertia, lag = np.exp(common[:, :3]).T
    uneven, delay = common[:, 3:].T
    return Sought(thrust, inertia, np.maximum(lag, SHORTEST_LAG), uneven, np.clip(delay, 0.0, LONGEST_DELAY))


def _step(
    config: Config, log: Log, passed: Passed, begins: Array, ticks: int, common: Array, own: Array, nominal: Array
) -> tuple[Array, Array, Array, Array]:
    """One Gauss-Newton step: (common, own, residuals before it, standard deviations of `common`).

    The windows' own unknowns are eliminated.
    """
    left, slopes = _slopes(config, log, passed, begins, ticks, common, own)
    lifts = np.zeros(COMMON + OWN)
    lifts[-1] = 1 / UNKNOWN_LIFT
    normal, right = np.diag(1 / PRIOR**2), (nominal - common) / PRIOR**2
    eliminated = []
    for window, mine in enumerate(own):
        known = np.vstack([slopes[:, window].T, lifts])
        rest = np.append(left[window], -mine[-1] / UNKNOWN_LIFT)
        a, b = known[:, :COMMON], known[:, COMMON:]
        inverse = np.linalg.pinv(b)
        eliminated.append((inverse, a, rest))
        across = a - b @ (inverse @ a)
        normal = normal + across.T @ across
        right = right + across.T @ rest
    change = np.clip(np.linalg.solve(normal, right), -LARGEST, LARGEST)
    moved = np.stack([inverse @ (rest - a @ change) for inverse, a, rest in eliminated])
    after = common + change
    after[-1] = np.clip(after[-1], 0.0, LONGEST_DELAY)
    return after, own + moved, left, np.sqrt(np.diag(np.linalg.inv(normal)))


def _slopes(
    config: Config, log: Log, passed: Passed, begins: Array, ticks: int, common: Array, own: Array
) -> tuple[Array, Array]:
    """Residuals (n, rows) and the slopes (COMMON + OWN, n, rows) of what is flown, both in units of `NOISE`.

    All difference quotients of all windows are flown together.
    """
    count, width = len(begins), 1 + COMMON + OWN
    commons = np.broadcast_to(common, (width, COMMON)).copy()
    commons[1 : 1 + COMMON] += np.diag(DIFFERENCE)
    owns = np.broadcast_to(own, (width, count, OWN)).copy()
    owns[1 + COMMON :] += np.diag(START_DIFFERENCE)[:, None, :]
    sought, start = _sought(np.repeat(commons, count, axis=0)), Start(*owns.reshape(-1, OWN).T)
    flown = fly_windows(config, log, passed, np.tile(begins, width), ticks, sought, start)
    flown = flown.reshape(len(flown), width, count, 3).transpose(1, 2, 0, 3)  # (width, n, rows, 3)
    when = begins[:, None] + np.arange(0, ticks, log.every)
    seen = np.stack([log.euler[when, 0], log.rates[when, 0], log.climb[when]], axis=-1)
    slopes = ((flown[1:] - flown[0]) / NOISE).reshape(width - 1, count, -1)
    slopes /= np.concatenate([DIFFERENCE, START_DIFFERENCE])[:, None, None]
    return ((seen - flown[0]) / NOISE).reshape(count, -1), slopes
