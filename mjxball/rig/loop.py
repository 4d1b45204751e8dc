"""The cascade around one axis of the pair, linearised: loop gain and its margins."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Array = np.ndarray
FREQUENCIES = np.geomspace(0.02, 400.0, 1200)  # [rad/s]


class Gains(NamedTuple):
    """kp, ki, kd of an attitude loop and of the rate loop below it, in the firmware's units."""

    attitude: tuple[float, float, float]
    rate: tuple[float, float, float]


class Margins(NamedTuple):
    """How far a stable loop is from instability; all 0 for an unstable one."""

    phase: float  # [deg]
    gain_up: float  # factor on the loop's gain
    gain_down: float  # factor by which it may be divided, inf without integrators
    delay: float  # [s]
    crossover: float  # highest frequency of unit gain [rad/s]


def loop_gain(gains: Gains, gain: float, lag: float, delay: float, frequency: Array) -> Array:
    """L (k,) at `frequency` (k,) [rad/s], the loop cut at the motor commands.

    `gain` [deg/s2] of the axis per unit, `lag` and `delay` [s]. Both derivatives are the measurement's.
    """
    s = 1j * frequency
    (ap, ai, ad), (rp, ri, rd) = gains
    outer = (ap + ai / s + ad * s) / s
    control = (rp + ri / s) * (1 + outer) + rd * s
    return control * gain / (s * (lag * s + 1)) * np.exp(-s * delay)


def closed_poles(gains: Gains, gain: float, lag: float, delay: float) -> Array:
    """Poles of the closed loop [1/s], the delay in its third-order Padé form."""
    (ap, ai, ad), (rp, ri, rd) = gains
    poly = np.polynomial.polynomial
    # The controller is number / s^3 and the axis gain / (s (lag s + 1)); ascending powers of s.
    number = poly.polyadd(poly.polymul([ri, rp], [ai, ap, 1 + ad]), [0, 0, 0, 0, rd])
    bottom = poly.polymul([0, 0, 0, 0, 1], [1, lag])
    pade = np.array([120, 60 * delay, 12 * delay**2, delay**3])
    top = poly.polymul(gain * number, pade * [1, -1, 1, -1])
    whole: Array = np.trim_zeros(
        poly.polyadd(top, poly.polymul(bottom, pade))
    )  # without the integrators that are not there
    return poly.polyroots(whole)


def is_stable(gains: Gains, gain: float, lag: float, delay: float) -> bool:
    """Whether all poles of the closed loop lie left."""
    return bool((closed_poles(gains, gain, lag, delay).real < 0).all())


def margins(gains: Gains, gain: float, lag: float, delay: float) -> Margins:
    """Margins of the loop; found on a grid of frequencies, good to 1 %."""
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
