"""Attitude gains for a pair of Crazyflies: the stiffest loop that keeps the margins, on elastic mounts as well."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.control.axes import NAMES, Axis, axes
from mjxball.control.crazyflie import RATE_LIMITS
from mjxball.errors import InputError
from mjxfly.margins import REQUIREMENTS, Gains, Margins, delivered_gains, margins, nominal_and_worst
from mjxfly.mount_modes import MOUNTED, RIGID, Mount, has_mode_margin, loop_on_mount, lowest_mode, peak_gain

HIGH = 2j * math.pi * 80  # [1/s] about where gains that are as soft as can be meet the modes that they bear


class AxisDesign(NamedTuple):
    """Gains of one axis and their margins."""

    axis: Axis
    gains: Gains
    nominal: Margins
    worst: Margins  # the smallest of each margin over the corners
    lowest: float  # mode of the mounts from which on the gains keep their margin [Hz]; 0: any, inf: none


def design(config: Config, mount: Mount = RIGID) -> tuple[AxisDesign, ...]:
    """Gains for roll, pitch and yaw of the pair in `config`, safe with every mode of the mounts from `mount` on.

    Raises InputError if nothing keeps the margins.
    """
    return tuple(design_axis(axis, config, mount) for axis in axes(config))


def design_axis(axis: Axis, config: Config, mount: Mount = RIGID) -> AxisDesign:
    """The stiffest of a grid of gains: rate kp, its kd as a lead, attitude kp.

    Only the rate integral holds constant moments; it is sized for `Axis.trim`. Both drones turn one body, so the
    integrals of two drones that measure it differently drift apart and oppose each other, and that has to stay bounded.
    An axis with about the inertia of two single drones keeps the delivered gains, which many have flown, if the mounts
    allow it.
    """
    kept = delivered_gains(axis)
    if axis.inertia_ratio < REQUIREMENTS.keep_below and _is_safe(kept, axis, config, mount):
        return with_margins(kept, axis, config, mount)
    for candidate in candidates(axis, config.plant.rotor_lag):
        gains = with_integral(axis, *candidate)
        if not _may_be_safe(gains, axis, config, mount) or not keeps_margins(gains, axis, config.plant.rotor_lag):
            continue
        if _is_safe(gains, axis, config, mount):
            return with_margins(gains, axis, config, mount)
    raise InputError(_why_none(axis, config, mount))


def with_margins(gains: Gains, axis: Axis, config: Config, mount: Mount = RIGID) -> AxisDesign:
    """`gains` with their margins; the lowest mode is for the damping of `mount`."""
    modes = lowest_mode(loop_on_mount(gains, axis, config), mount.damping) if axis.name in MOUNTED else 0.0
    return AxisDesign(axis, gains, *nominal_and_worst(gains, axis, config.plant.rotor_lag), modes)


def keeps_margins(gains: Gains, axis: Axis, lag: float) -> bool:
    """Whether `gains` meet `REQUIREMENTS` on rigid mounts, at nominal `lag` [s] and in all corners."""
    nominal = margins(gains, axis.gain, lag, REQUIREMENTS.delay)
    if nominal.phase < REQUIREMENTS.phase or min(nominal.gain_up, nominal.gain_down) < REQUIREMENTS.gain:
        return False
    _, worst = nominal_and_worst(gains, axis, lag)
    return worst.phase >= REQUIREMENTS.worst_phase and min(worst.gain_up, worst.gain_down) >= REQUIREMENTS.worst_gain


def candidates(axis: Axis, lag: float) -> list[tuple[float, float, float]]:
    """(attitude kp, rate kp, lead time) within the limits of authority and noise, the stiffest first."""
    stiffest = 0.5 * axis.headroom / REQUIREMENTS.attitude_error
    rates, leads = np.geomspace(2.0, 60.0, 35) / axis.gain, np.linspace(0.0, lag, 6)
    grid = itertools.product(np.geomspace(0.8, 8.0, 24), rates, leads)
    stable = ((a, r, d) for a, r, d in grid if REQUIREMENTS.bandwidth_ratio * a <= r * axis.gain)
    kept = [(a, r, d) for a, r, d in stable if a * r <= stiffest and d * r <= REQUIREMENTS.largest_derivative]
    # Among equally stiff ones less lead first, which means less noise.
    return sorted(((float(a), float(r), float(d)) for a, r, d in kept), key=lambda c: (-c[0] * c[1], c[2]))


def with_integral(axis: Axis, attitude: float, rate: float, lead: float) -> Gains:
    """The gains of a candidate, to three significant digits, as they are written to the drones."""
    held = max(axis.trim, REQUIREMENTS.unloaded_share * axis.headroom)
    integral = held / RATE_LIMITS[NAMES.index(axis.name)]
    outer, *inner = (float(f"{value:.3g}") for value in (attitude, rate, integral, lead * rate))
    return Gains((outer, 0.0, 0.0), (inner[0], inner[1], inner[2]))


def apply(autopilot: Autopilot, designs: tuple[AxisDesign, ...]) -> Autopilot:
    """`autopilot` with the gains of `designs`."""
    roll, pitch, yaw = (one.gains for one in designs)
    autopilot = replace(autopilot, roll=roll.attitude, pitch=pitch.attitude, yaw=yaw.attitude)
    return replace(autopilot, roll_rate=roll.rate, pitch_rate=pitch.rate, yaw_rate=yaw.rate)


def _is_safe(gains: Gains, axis: Axis, config: Config, mount: Mount) -> bool:
    return axis.name not in MOUNTED or has_mode_margin(loop_on_mount(gains, axis, config), mount)


def _may_be_safe(gains: Gains, axis: Axis, config: Config, mount: Mount) -> bool:
    """Whether `gains` have their margin at the first mode, a quick check before those that take longer."""
    if axis.name not in MOUNTED or mount.is_rigid:
        return True
    first = peak_gain(loop_on_mount(gains, axis, config), np.array([mount.frequency]), mount.damping)
    return float(first[0]) * REQUIREMENTS.gain <= 1


def _why_none(axis: Axis, config: Config, mount: Mount) -> str:
    """Why no candidate is good, and which mode the softest of those that are without the mounts needs."""
    lag = config.plant.rotor_lag
    # By the gain of the rate loop at the modes, where its derivative counts most.
    soft = sorted(candidates(axis, lag), key=lambda c: (c[1] * abs(1 + c[2] * HIGH), c[0]))
    found = (with_integral(axis, *one) for one in soft)
    softest = next((gains for gains in found if keeps_margins(gains, axis, lag)), None)
    if softest is None or mount.is_rigid:
        return f"no gains keep the margins about {axis.name}: a lighter or shorter stick, or faster motors, would help"
    needed = lowest_mode(loop_on_mount(softest, axis, config), mount.damping)
    return (
        f"no gains keep the margins about {axis.name} with modes of the mounts from {mount.frequency:g} Hz on: at a "
        f"damping of {mount.damping:g} the softest ones need {needed:.0f} Hz; stiffer mounts or more damping would help"
    )
