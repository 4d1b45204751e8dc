"""Attitude gains for a pair of Crazyflies: the stiffest loop with margins for uncertain lag, inertia and delay."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.control.axes import Axis, axes
from mjxball.control.crazyflie import RATE_LIMITS

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


class AxisDesign(NamedTuple):
    """Gains of one axis and their margins."""

    axis: Axis
    gains: Gains
    nominal: Margins
    worst: Margins  # the smallest of each margin over the corners


def design(config: Config) -> tuple[AxisDesign, ...]:
    """Gains for roll, pitch and yaw of the pair in `config`. Raises ValueError if nothing keeps the margins."""
    return tuple(design_axis(axis, config) for axis in axes(config))


def design_axis(axis: Axis, config: Config) -> AxisDesign:
    """The stiffest of a grid of gains: rate kp, its kd as a lead, attitude kp.

    Only the rate integral holds constant moments; it is sized for `Axis.trim`. Both drones turn one body, so the
    integrals of two drones that measure it differently drift apart and oppose each other, and that has to stay bounded.
    An axis with about the inertia of two single drones keeps the delivered gains, which many have flown.
    """
    if axis.inertia_ratio < REQUIREMENTS.keep_below:
        return AxisDesign(
            axis,
            delivered_gains(axis),
            *nominal_and_worst(delivered_gains(axis), axis, config.plant.rotor_lag),
        )
    held = max(axis.trim, REQUIREMENTS.unloaded_share * axis.headroom)
    number = ("roll", "pitch", "yaw").index(axis.name)
    integral = held / RATE_LIMITS[number]
    lag = config.plant.rotor_lag
    for attitude, rate, lead in candidates(axis, lag):
        gains = rounded(Gains((attitude, 0.0, 0.0), (rate, integral, lead * rate)))
        nominal = margins(gains, axis.gain, lag, REQUIREMENTS.delay)
        if nominal.phase < REQUIREMENTS.phase or min(nominal.gain_up, nominal.gain_down) < REQUIREMENTS.gain:
            continue
        nominal, worst = nominal_and_worst(gains, axis, lag)
        if worst.phase >= REQUIREMENTS.worst_phase and min(worst.gain_up, worst.gain_down) >= REQUIREMENTS.worst_gain:
            return AxisDesign(axis, gains, nominal, worst)
    raise ValueError(f"no gains keep the margins about {axis.name}")


def candidates(axis: Axis, lag: float) -> list[tuple[float, float, float]]:
    """(attitude kp, rate kp, lead time) within the limits of authority and noise, the stiffest first."""
    stiffest = 0.5 * axis.headroom / REQUIREMENTS.attitude_error
    rates, leads = np.geomspace(2.0, 60.0, 35) / axis.gain, np.linspace(0.0, lag, 6)
    grid = itertools.product(np.geomspace(0.8, 8.0, 24), rates, leads)
    stable = ((a, r, d) for a, r, d in grid if REQUIREMENTS.bandwidth_ratio * a <= r * axis.gain)
    kept = [(a, r, d) for a, r, d in stable if a * r <= stiffest and d * r <= REQUIREMENTS.largest_derivative]
    # Among equally stiff ones less lead first, which means less noise.
    return sorted(((float(a), float(r), float(d)) for a, r, d in kept), key=lambda c: (-c[0] * c[1], c[2]))


def worst_margins(gains: Gains, axis: Axis) -> Margins:
    """Smallest margins over the corners of lag and inertia, at the longest delay."""
    corners = itertools.product(REQUIREMENTS.lags, REQUIREMENTS.inertias)
    found = [margins(gains, axis.gain / inertia, lag, REQUIREMENTS.worst_delay) for lag, inertia in corners]
    return Margins(*(min(column) for column in zip(*found, strict=True)))


def nominal_and_worst(gains: Gains, axis: Axis, lag: float) -> tuple[Margins, Margins]:
    """Nominal margins, and the worst over the corners."""
    return margins(gains, axis.gain, lag, REQUIREMENTS.delay), worst_margins(gains, axis)


def rounded(gains: Gains) -> Gains:
    """`gains` to three significant digits, as they are written to the drones."""
    attitude, rate = ([float(f"{value:.3g}") for value in row] for row in gains)
    return Gains((attitude[0], attitude[1], attitude[2]), (rate[0], rate[1], rate[2]))


def delivered_gains(axis: Axis) -> Gains:
    """The gains that a drone is delivered with."""
    return gains_of(Autopilot(), axis)


def gains_of(autopilot: Autopilot, axis: Axis) -> Gains:
    """The gains of one axis in `autopilot`."""
    return Gains(getattr(autopilot, axis.name), getattr(autopilot, f"{axis.name}_rate"))


def apply(autopilot: Autopilot, designs: tuple[AxisDesign, ...]) -> Autopilot:
    """`autopilot` with the gains of `designs`."""
    roll, pitch, yaw = (one.gains for one in designs)
    autopilot = replace(autopilot, roll=roll.attitude, pitch=pitch.attitude, yaw=yaw.attitude)
    return replace(autopilot, roll_rate=roll.rate, pitch_rate=pitch.rate, yaw_rate=yaw.rate)
