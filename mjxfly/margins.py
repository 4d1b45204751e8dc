"""Stability margins of a pair's attitude loops, and those that are required for uncertain lag, inertia and delay."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.control.axes import Axis, axes

Array = np.ndarray
FREQUENCIES = np.geomspace(0.02, 400.0, 1200)  # [rad/s]


class Gains(NamedTuple):
    """kp, ki, kd of an attitude loop and of the rate loop below it, in the firmware's units."""

    attitude: tuple[float, float, float]
    rate: tuple[float, float, float]


class Margins(NamedTuple):
    """Stability margins of a loop; all 0 if it is unstable."""

    phase: float  # [deg]
    gain_up: float  # factor on the loop's gain
    gain_down: float  # factor by which it may be divided, inf without integrators
    delay: float  # [s]
    crossover: float  # highest frequency of unit gain [rad/s]


def loop_gain(gains: Gains, gain: float, lag: float, delay: float, frequency: Array) -> Array:
    """Loop gain L (k,) at `frequency` (k,) [rad/s], with the loop cut at the motor commands.

    `gain` of the axis in [deg/s2] per unit, `lag` and `delay` in [s]. Both derivatives act on the measurement.
    """
    s = 1j * frequency
    (ap, ai, ad), (rp, ri, rd) = gains
    outer = (ap + ai / s + ad * s) / s
    control = (rp + ri / s) * (1 + outer) + rd * s
    return control * gain / (s * (lag * s + 1)) * np.exp(-s * delay)


def closed_poles(gains: Gains, gain: float, lag: float, delay: float) -> Array:
    """Poles of the closed loop [1/s], with a third-order Padé approximation of the delay."""
    (ap, ai, ad), (rp, ri, rd) = gains
    poly = np.polynomial.polynomial
    # The controller is numerator / s^3, the axis is gain / (s (lag s + 1)); ascending powers of s.
    numerator = poly.polyadd(poly.polymul([ri, rp], [ai, ap, 1 + ad]), [0, 0, 0, 0, rd])
    denominator = poly.polymul([0, 0, 0, 0, 1], [1, lag])
    pade = np.array([120, 60 * delay, 12 * delay**2, delay**3])
    top = poly.polymul(gain * numerator, pade * [1, -1, 1, -1])
    # Drop the integrators whose gain is 0; those of angle and rate stay, also without feedback.
    absent = (ai == 0) + (ri == 0)
    characteristic: Array = np.trim_zeros(poly.polyadd(top, poly.polymul(denominator, pade))[absent:], "b")
    return poly.polyroots(characteristic)


def is_stable(gains: Gains, gain: float, lag: float, delay: float) -> bool:
    """Whether all poles of the closed loop have negative real parts."""
    return bool((closed_poles(gains, gain, lag, delay).real < 0).all())


def unstable_axes(config: Config) -> list[str]:
    """Axes about which a pair of Crazyflies is unstable at the nominal delay; empty for other plants."""
    if config.autopilot.kind != "crazyflie" or config.plant.count != 2:
        return []
    lag, delay = config.plant.rotor_lag, REQUIREMENTS.delay
    return [
        axis.name for axis in axes(config) if not is_stable(gains_of(config.autopilot, axis), axis.gain, lag, delay)
    ]


def margins(gains: Gains, gain: float, lag: float, delay: float) -> Margins:
    """Margins of the loop, from a grid of frequencies and good to 1 %."""
    if not is_stable(gains, gain, lag, delay):
        return Margins(0.0, 0.0, 0.0, 0.0, 0.0)
    value = loop_gain(gains, gain, lag, delay, FREQUENCIES)
    size, angle = np.abs(value), np.unwrap(np.angle(value))
    turns = np.round((angle[-1] + np.pi / 2 + FREQUENCIES[-1] * delay + np.pi / 2) / (2 * np.pi))
    angle = angle - 2 * np.pi * turns  # at high frequency: -90 or -180 degrees and the delay's
    crossing = np.flatnonzero((size[:-1] >= 1) != (size[1:] >= 1))
    flips = np.flatnonzero(np.diff(np.floor((angle + np.pi) / (2 * np.pi))))
    at_flip = size[flips]
    down, up = at_flip[at_flip > 1], at_flip[at_flip <= 1]
    spare = angle[crossing] + np.pi
    return Margins(
        float(np.degrees(np.abs(spare).min())),
        float(1 / up.max()) if up.size else np.inf,
        float(down.min()) if down.size else np.inf,
        float((np.maximum(spare, 0) / FREQUENCIES[crossing]).min()),
        float(FREQUENCIES[crossing[-1]]),
    )


@dataclass(frozen=True)
class Requirements:
    """Margins required of every axis; `worst` ones are minima over the corners of `lags` and `inertias`."""

    delay: float = 0.01  # nominal delay: filters, estimator, sampling, motor drivers [s]
    phase: float = 50.0  # at nominal lag, inertia and delay [deg]
    gain: float = 3.0  # up and down, likewise
    worst_phase: float = 15.0  # [deg]
    worst_gain: float = 2.0
    worst_delay: float = 0.02  # [s]
    lags: tuple[float, float] = (0.03, 0.15)  # of the motors [s]
    inertias: tuple[float, float] = (0.6, 1.4)  # factors
    attitude_error: float = 5.0  # attitude error that may take half of the headroom [deg]
    bandwidth_ratio: float = 4.0  # the rate loop's bandwidth over the attitude loop's, at least
    largest_derivative: float = 30.0  # largest kd of a rate loop, for gyro noise; twelve times the delivered one
    keep_below: float = 1.5  # an axis whose inertia is less than this times the drones' own keeps the delivered gains
    unloaded_share: float = 0.15  # share of the headroom that the integral of an axis without a load may take


REQUIREMENTS = Requirements()


def worst_margins(gains: Gains, axis: Axis) -> Margins:
    """Smallest margins over the corners of lag and inertia, at the longest delay."""
    corners = itertools.product(REQUIREMENTS.lags, REQUIREMENTS.inertias)
    found = [margins(gains, axis.gain / inertia, lag, REQUIREMENTS.worst_delay) for lag, inertia in corners]
    return Margins(*(min(column) for column in zip(*found, strict=True)))


def nominal_and_worst(gains: Gains, axis: Axis, lag: float) -> tuple[Margins, Margins]:
    """Nominal margins, and the worst over the corners."""
    return margins(gains, axis.gain, lag, REQUIREMENTS.delay), worst_margins(gains, axis)


def delivered_gains(axis: Axis) -> Gains:
    """The gains that a drone is delivered with."""
    return gains_of(Autopilot(), axis)


def gains_of(autopilot: Autopilot, axis: Axis) -> Gains:
    """The gains of one axis in `autopilot`."""
    return Gains(getattr(autopilot, axis.name), getattr(autopilot, f"{axis.name}_rate"))
