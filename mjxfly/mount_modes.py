"""Attitude loops of two drones on elastic mounts: loop gain at the mounts' modes, stability, the lowest mode they bear.

The gains of a drone act on its own angle (`mjxball.plant.mounts`). With drones of inertia J each, and H of the stick
and all that is fixed to it, about the same axis, the angle of a drone follows the moment of its motors as

    1 / s^2 (H s^2 / 2 + c s + k) / (J H s^2 / 2 + (J + H / 2) (c s + k))   if both drones do the same,
    1 / (J s^2 + c s + k)                                                    if they do the opposite: the stick rests.

Above its mode a drone is as light as one alone: the gain of a loop about an axis that the stick makes 40 times heavier
rises by 40. A mode is therefore kept safe by its gain, whatever the phase, which a loop's delay leaves open.
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import numpy as np

from mjxball.config import Config, Plant
from mjxball.control.axes import NAMES, Axis
from mjxball.errors import InputError
from mjxfly.margins import REQUIREMENTS, Gains

Array = np.ndarray
LEAST_DAMPING = 1e-3  # ratio of a mode
GYRO_CUTOFF = 80.0  # [Hz] of the firmware's filter of the gyroscope, second order
HIGHEST = 1000.0  # [Hz] modes above it are not looked at: that filter and the motors leave the loop no gain
# Frequencies over that of a resonance at which its peak is looked for.
NEAR = np.unique(np.concatenate([np.geomspace(0.7, 1.4, 41), 1 + np.linspace(-0.06, 0.06, 61)]))


class Mount(NamedTuple):
    """Elastic mounts of both drones, see `mjxball.plant.mounts`."""

    frequency: float  # of a drone that turns about its own x or y on a stick held still [Hz]; inf: rigid
    damping: float = 0.02  # ratio; wood, carbon and screws have 1 to 3 %

    @property
    def is_rigid(self) -> bool:
        """Whether the mounts have no mode."""
        return math.isinf(self.frequency)


RIGID = Mount(math.inf)
MOUNTED = NAMES[:2]  # axes about which mounts are elastic


def add_mount_options(parser: argparse._ActionsContainer) -> None:
    """Add the flags --mount-hz and --mount-damping to `parser`."""
    about = "frequency of a drone on its mount (mjxfly.rig.mount): gains must suit every mode from it on (the plant's)"
    parser.add_argument("--mount-hz", type=float, metavar="HZ", help=about)
    about = f"--mount-hz: damping ratio of the modes ({RIGID.damping:g})"
    parser.add_argument("--mount-damping", type=float, metavar="RATIO", help=about)


def mount_of(options: argparse.Namespace, plant: Plant) -> Mount:
    """The mounts that the flags describe, else those of `plant`. Raises InputError for values out of range."""
    frequency, damping = options.mount_hz, options.mount_damping
    if plant.mount_frequency and frequency is None and damping is None:
        return Mount(plant.mount_frequency, max(plant.mount_damping, LEAST_DAMPING))
    if frequency is None and damping is not None:
        raise InputError("--mount-damping needs --mount-hz HZ")
    if frequency is not None and not 1 <= frequency <= HIGHEST:
        raise InputError(f"--mount-hz must be 1 to {HIGHEST:g}, not {frequency:g}")
    if damping is not None and not LEAST_DAMPING <= damping < 1:
        raise InputError(f"--mount-damping must be at least {LEAST_DAMPING:g} and below 1, not {damping:g}")
    return Mount(RIGID.frequency if frequency is None else frequency, RIGID.damping if damping is None else damping)


class Loop(NamedTuple):
    """An attitude loop of a drone on an elastic mount, cut at the motor commands."""

    gains: Gains
    gain: float  # angular acceleration of the rigid pair per unit of both drones' outputs [deg/s2]
    share: float  # of both drones' own inertia in that of the pair, 2 J / (2 J + H)
    lag: float  # of the motors [s]
    delay: float = REQUIREMENTS.delay  # of the loop, that of the gyroscope's filter included [s]
    cutoff: float = GYRO_CUTOFF  # of that filter [Hz]; inf: none


def loop_on_mount(gains: Gains, axis: Axis, config: Config) -> Loop:
    """The loop with `gains` about roll or pitch of the pair in `config`."""
    number = NAMES.index(axis.name)
    own = sum(drone.inertia[number] for drone in config.plant.pair)
    return Loop(gains, axis.gain, own / axis.inertia, config.plant.rotor_lag)


def fraction(loop: Loop, mount: Mount, opposed: bool, s: Array) -> tuple[Array, Array]:
    """Numerator and denominator of the loop gain without its delay, at `s` (k,) [1/s]; polynomials without a common 0.

    `opposed`: the drones turn against each other, else together.
    """
    (ap, ai, ad), (rp, ri, rd) = loop.gains
    filter_frequency, mode = 2 * math.pi * loop.cutoff, 2 * math.pi * mount.frequency
    filtered = 1 + s * math.sqrt(2.0) / filter_frequency + (s / filter_frequency) ** 2
    spring = 2 * mount.damping * mode * s + mode**2
    # The controller is a polynomial over s^3, of which every integrator whose gain is 0 cancels an s.
    absent = (ai == 0) + (ri == 0)
    control = ((ri + s * rp) * (ai + s * (ap + s * (1 + ad))) + rd * s**4) / s**absent
    motors = (1 + loop.lag * s) * filtered
    if opposed:  # the drone's s^2 cancels two more
        return loop.gain / loop.share * control, s ** (2 - absent) * motors * (s * s + spring)
    light = (1 - loop.share) * s * s
    return loop.gain * control * (light / loop.share + spring), s ** (4 - absent) * motors * (light + spring)


def peak_gain(loop: Loop, frequency: Array, damping: float) -> Array:
    """Largest loop gain (m,) near modes of `frequency` (m,) [Hz], together and opposed."""
    peaks = []
    for opposed in (False, True):
        resonance = frequency if opposed else frequency / math.sqrt(1 - loop.share)
        s = 2j * math.pi * resonance[:, None] * NEAR
        top, bottom = fraction(loop, Mount(frequency[:, None], damping), opposed, s)  # type: ignore[arg-type]
        peaks.append(np.abs(top / bottom).max(axis=1))
    return np.maximum(*peaks)


def lowest_mode(loop: Loop, damping: float) -> float:
    """Frequency [Hz] from which on every mode leaves the required gain margin, to 1 %; inf if none does."""
    frequency = np.geomspace(HIGHEST, 1.0, 690)
    short = np.flatnonzero(REQUIREMENTS.gain * peak_gain(loop, frequency, damping) > 1)
    if not short.size:
        return float(frequency[-1])
    return float(frequency[short[0] - 1]) if short[0] else math.inf


def has_mode_margin(loop: Loop, mount: Mount) -> bool:
    """Whether every mode from that of `mount` on is stable and leaves the gain margin of `lowest_mode`."""
    if mount.is_rigid:
        return True
    frequency = np.geomspace(mount.frequency, max(HIGHEST, 2 * mount.frequency), 60)
    if (REQUIREMENTS.gain * peak_gain(loop, frequency, mount.damping) > 1).any():
        return False
    return all(is_stable_on(loop, Mount(float(one), mount.damping)) for one in frequency[::6])


def is_stable_on(loop: Loop, mount: Mount) -> bool:
    """Whether the closed loop is stable, drones together and opposed, with the delay as it is.

    Of D(s) + N(s) exp(-s T) with D of degree n no zero has a positive real part if its argument grows by n pi / 2 from
    s = 0 to infinity along the imaginary axis (Mikhailov's criterion).
    """
    late = loop.delay - math.sqrt(2.0) / (2 * math.pi * loop.cutoff)
    for opposed in (False, True):
        resonance = 2 * math.pi * mount.frequency / (1 if opposed else math.sqrt(1 - loop.share))
        spread = np.concatenate([np.geomspace(1e-5, 1e3 * max(resonance, 100.0), 5000), resonance * NEAR])
        s = 1j * np.unique(spread)
        top, bottom = fraction(loop, mount, opposed, s)
        value = bottom + top * np.exp(-s * late)
        grown = np.unwrap(np.angle(value / (s + 50.0) ** degree(loop, opposed)))
        # It begins and ends at a real number: half a turn and more is that of a zero.
        if abs(grown[-1] - grown[0]) > math.pi / 2:
            return False
    return True


def degree(loop: Loop, opposed: bool) -> int:
    """Degree of the denominator of `fraction`."""
    (_, ai, _), (_, ri, _) = loop.gains
    integrators = 2 - (ai == 0) - (ri == 0)
    return integrators + 1 + 2 * math.isfinite(loop.cutoff) + 2 + (0 if opposed else 2)
