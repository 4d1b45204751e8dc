"""Gains for the coupled pair: the stiffest attitude loop that keeps stated margins over what is not known."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.rig.axis import Axis, axes
from mjxball.rig.loop import Gains, Margins, margins


@dataclass(frozen=True)
class Asked:
    """What is asked of every axis. `worst` is each margin's smallest over the corners of what is not known."""

    delay: float = 0.01  # of the loop itself: filters, estimator, sampling, motor drivers [s]
    phase: float = 50.0  # at nominal lag, inertia and delay [deg]
    gain: float = 3.0  # either way, likewise
    worst_phase: float = 15.0  # [deg]
    worst_gain: float = 2.0
    worst_delay: float = 0.02  # [s]
    lags: tuple[float, float] = (0.03, 0.15)  # of the motors [s]
    inertias: tuple[float, float] = (0.6, 1.4)  # factors
    error: float = 5.0  # attitude error that may take half of the headroom [deg]
    apart: float = 4.0  # the rate loop's bandwidth over the attitude loop's, at least
    derivative: float = 30.0  # largest kd of a rate loop, twelve times stock: noise of the gyro
    alone: float = 1.5  # an axis whose inertia is less than this times the drones' own keeps the delivered gains
    unloaded: float = 0.15  # share of the headroom that the integral of an axis without a load may take


ASKED = Asked()


class Design(NamedTuple):
    """Gains of one axis and what they are worth."""

    axis: Axis
    gains: Gains
    nominal: Margins
    worst: Margins  # each the smallest of the corners


def design(config: Config, asked: Asked = ASKED) -> tuple[Design, ...]:
    """Gains for roll, pitch and yaw of the pair in `config`. Raises ValueError if nothing keeps the margins."""
    return tuple(design_axis(axis, config, asked) for axis in axes(config))


def design_axis(axis: Axis, config: Config, asked: Asked = ASKED) -> Design:
    """The stiffest of a grid of gains: rate kp, its kd as a lead, attitude kp.

    The rate integral alone holds lasting moments, sized for `Axis.trim`: both drones turn one body, so that the
    integrals of two drones that see it differently run apart, and what they fight with must stay bounded.
    An axis that both turn as each does alone keeps the delivered gains, which are flown everywhere.
    """
    if axis.scale < asked.alone:
        return Design(axis, stock(axis), *judged(stock(axis), axis, config.plant.rotor_lag, asked))
    held = max(axis.trim, asked.unloaded * axis.headroom)
    number = ("roll", "pitch", "yaw").index(axis.name)
    integral = held / config.autopilot.rate_limits[number]
    lag = config.plant.rotor_lag
    for attitude, rate, lead in candidates(axis, lag, asked):
        gains = rounded(Gains((attitude, 0.0, 0.0), (rate, integral, lead * rate)))
        nominal = margins(gains, axis.gain, lag, asked.delay)
        if nominal.phase < asked.phase or min(nominal.gain_up, nominal.gain_down) < asked.gain:
            continue
        nominal, worst = judged(gains, axis, lag, asked)
        if worst.phase >= asked.worst_phase and min(worst.gain_up, worst.gain_down) >= asked.worst_gain:
            return Design(axis, gains, nominal, worst)
    raise ValueError(f"no gains keep the margins about {axis.name}")


def candidates(axis: Axis, lag: float, asked: Asked) -> list[tuple[float, float, float]]:
    """(attitude kp, rate kp, lead time) within authority and noise, the stiffest first."""
    stiffest = 0.5 * axis.headroom / asked.error
    rates, leads = np.geomspace(2.0, 60.0, 35) / axis.gain, np.linspace(0.0, lag, 6)
    grid = itertools.product(np.geomspace(0.8, 8.0, 24), rates, leads)
    apart = ((a, r, d) for a, r, d in grid if asked.apart * a <= r * axis.gain)
    kept = [(a, r, d) for a, r, d in apart if a * r <= stiffest and d * r <= asked.derivative]
    # Among the equally stiff the one with less lead, which is less noise.
    return sorted(((float(a), float(r), float(d)) for a, r, d in kept), key=lambda c: (-c[0] * c[1], c[2]))


def worst_margins(gains: Gains, axis: Axis, asked: Asked = ASKED) -> Margins:
    """Smallest margins over the corners of lag and inertia, at the longest delay."""
    corners = itertools.product(asked.lags, asked.inertias)
    found = [margins(gains, axis.gain / inertia, lag, asked.worst_delay) for lag, inertia in corners]
    return Margins(*(min(column) for column in zip(*found, strict=True)))


def judged(gains: Gains, axis: Axis, lag: float, asked: Asked = ASKED) -> tuple[Margins, Margins]:
    """(nominal, worst) margins."""
    return margins(gains, axis.gain, lag, asked.delay), worst_margins(gains, axis, asked)


def rounded(gains: Gains) -> Gains:
    """To three significant digits, as they are written to the drones."""
    attitude, rate = ([float(f"{value:.3g}") for value in row] for row in gains)
    return Gains((attitude[0], attitude[1], attitude[2]), (rate[0], rate[1], rate[2]))


def stock(axis: Axis) -> Gains:
    """The gains that a drone is delivered with."""
    return gains_of(Autopilot(), axis)


def gains_of(autopilot: Autopilot, axis: Axis) -> Gains:
    """The gains of one axis in `autopilot`."""
    return Gains(getattr(autopilot, axis.name), getattr(autopilot, f"{axis.name}_rate"))


def apply(autopilot: Autopilot, designs: tuple[Design, ...]) -> Autopilot:
    """`autopilot` with the gains of `designs`."""
    roll, pitch, yaw = (one.gains for one in designs)
    autopilot = replace(autopilot, roll=roll.attitude, pitch=pitch.attitude, yaw=yaw.attitude)
    return replace(autopilot, roll_rate=roll.rate, pitch_rate=pitch.rate, yaw_rate=yaw.rate)
