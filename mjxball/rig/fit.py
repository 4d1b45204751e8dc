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
MOST_WINDOWS = 40
NOISE = np.array([0.005, 0.02, 0.02])  # of roll [rad], its rate [rad/s], climb [m/s]
LOWEST_THRUST = 15000.0  # of both drones in a window that counts
ROUNDS, STEPS = 3, 4
# Logarithms of thrust, inertia and lag, then the delay [s]; steps of differences, prior widths, largest change.
DIFFERENCE = np.array([0.01, 0.02, 0.05, 0.004])
PRIOR = np.array([0.3, 0.7, 0.7, 0.02])
LARGEST = np.array([0.2, 0.4, 0.4, 0.01])
START_DIFFERENCE = np.array([0.005, 0.02, 0.02, 0.2, 0.4])
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


def identify(config: Config, log: Log) -> Found:
    """Fit the plant of `config` to `log`. Raises InputError if there is too little of it."""
    begins, ticks = _windows(log)
    nominal = np.array([0.0, np.log(inertia_about_o(config)[0]), np.log(config.plant.rotor_lag), 0.01])
    common, own = nominal.copy(), _starts(log, begins)
    left = spread = np.zeros(4)
    for _ in range(ROUNDS):
        passed = replay(config, log, _sought(common[None]))
        for _ in range(STEPS):
            common, own, left, spread = _step(config, log, passed, begins, ticks, common, own, nominal)
    misfit = float(np.sqrt(np.mean(left**2)))
    spread = spread * max(misfit, 1.0)
    thrust, inertia, lag = np.exp(common[:3])
    deviations = (float(spread[0]), float(spread[1]), float(spread[2]), float(spread[3]))
    return Found(float(thrust), float(inertia), float(lag), float(common[3]), deviations, misfit, len(begins))


def _windows(log: Log) -> tuple[Array, int]:
    ticks = round(WINDOW / PERIOD)
    begins = np.arange(log.every, len(log.climb) - ticks, ticks)
    lowest = log.setpoints[..., 3].min(axis=1)
    begins = np.array([begin for begin in begins if lowest[begin : begin + ticks].min() > LOWEST_THRUST], int)
    if len(begins) < 5:
        raise InputError(f"the log holds {len(begins)} s of flight; 5 s or more are needed, 20 s with steps are good")
    if len(begins) > MOST_WINDOWS:
        begins = begins[np.linspace(0, len(begins) - 1, MOST_WINDOWS).astype(int)]
    return begins, ticks


def _starts(log: Log, begins: Array) -> Array:
    """(n, 5) first guesses of `Start`."""
    return np.stack([log.euler[begins, 0], log.rates[begins, 0], log.climb[begins], 0 * begins, 0 * begins], axis=1)


def _sought(common: Array) -> Sought:
    thrust, inertia, lag = np.exp(common[:, :3]).T
    return Sought(thrust, inertia, np.maximum(lag, SHORTEST_LAG), np.clip(common[:, 3], 0.0, LONGEST_DELAY))


def _step(
    config: Config, log: Log, passed: Passed, begins: Array, ticks: int, common: Array, own: Array, nominal: Array
) -> tuple[Array, Array, Array, Array]:
    """One Gauss-Newton step: (common, own, residuals before it, standard deviations of `common`).

    All difference quotients of all windows are flown together. The windows' own unknowns are eliminated.
    """
    count, width = len(begins), 10
    commons = np.broadcast_to(common, (width, 4)).copy()
    commons[1:5] += np.diag(DIFFERENCE)
    owns = np.broadcast_to(own, (width, count, 5)).copy()
    owns[5:] += np.diag(START_DIFFERENCE)[:, None, :]
    sought, start = _sought(np.repeat(commons, count, axis=0)), Start(*owns.reshape(-1, 5).T)
    flown = fly_windows(config, log, passed, np.tile(begins, width), ticks, sought, start)
    flown = flown.reshape(len(flown), width, count, 3).transpose(1, 2, 0, 3)  # (10, n, rows, 3)
    when = begins[:, None] + np.arange(0, ticks, log.every)
    seen = np.stack([log.euler[when, 0], log.rates[when, 0], log.climb[when]], axis=-1)
    left = ((seen - flown[0]) / NOISE).reshape(count, -1)
    slopes = ((flown[1:] - flown[0]) / NOISE).reshape(9, count, -1)
    slopes /= np.concatenate([DIFFERENCE, START_DIFFERENCE])[:, None, None]
    normal, right = np.diag(1 / PRIOR**2), (nominal - common) / PRIOR**2
    eliminated = []
    for window in range(count):
        a, b = slopes[:4, window].T, slopes[4:, window].T
        inverse = np.linalg.pinv(b)
        eliminated.append((inverse, a))
        across = a - b @ (inverse @ a)
        normal = normal + across.T @ across
        right = right + across.T @ left[window]
    change = np.clip(np.linalg.solve(normal, right), -LARGEST, LARGEST)
    moved = np.stack([inverse @ (left[n] - a @ change) for n, (inverse, a) in enumerate(eliminated)])
    after = common + change
    after[3] = np.clip(after[3], 0.0, LONGEST_DELAY)
    return after, own + moved, left, np.sqrt(np.diag(np.linalg.inv(normal)))
