"""Command line of `python -m mjxfly.rig.mount`: the mode of the drones' mounts, from a log in which they are tapped."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mjxball import cli, running
from mjxball.errors import InputError
from mjxball.policy.container import read_arrays
from mjxball.terminal import say, warn
from mjxfly import flight_log
from mjxfly.limits import NAMES
from mjxfly.mount_modes import MOUNTED
from mjxfly.rig.ring_down import Mode, find_mode

STAMPS = 2**24  # [ms] after which a drone's clock of 24 bits begins anew
LEAST_DAMPING = 0.005  # that gains are computed for
RESOLVED = 400.0  # [Hz] rows a second that show every mode which the gyroscope's filter lets pass
INERTIA, LEVER, TAPED = 1.66e-5, 0.0325, 0.002  # [kg m2, m, kg] of a Crazyflie, of its motors, of a weight to tape on
Series = Mapping[str, tuple[np.ndarray, np.ndarray]]  # by drone: time (T,) [s], body rates (T, 3) [rad/s]


def parser() -> cli.Parser:
    """Return the argument parser."""
    about = "Measure frequency and damping of the drones' mounts from a log of taps, motors off."
    result = cli.make_parser("python -m mjxfly.rig.mount", about)
    about = "of mjxfly --dry-run --log, or .npz of time (T,) s and rates (T, 3) rad/s of one drone; see docs"
    result.add_argument("log", type=Path, metavar="LOG", help=about)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the modes of all drones and axes that ring; return the exit code."""
    options = parser().parse_args(arguments)
    return running.run_command(lambda: _mount(options))


def _mount(options: argparse.Namespace) -> int:
    series = read_rates(options.log)
    for line in report(series, options.log):
        say(line)
    return 0


def read_rates(path: Path) -> Series:
    """Times and body rates of every drone in the log `path`. Raises InputError."""
    if path.suffix == ".npz":
        data = read_arrays(str(path), "log")
        try:
            time, rates = np.asarray(data["time"], float), np.asarray(data["rates"], float)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"log {path} is no .npz of time and rates: {error}") from None
        if time.ndim != 1 or rates.shape != (len(time), 3):
            raise InputError(f"log {path} must hold time (T,) and rates (T, 3)")
        return {"drone": _increasing(path, time, rates)}
    found = {}
    _, *records = flight_log.read(path, warn)
    for name in NAMES:
        rows = [one for one in records if one["kind"] == "state" and one["drone"] == name]
        if not rows:
            continue
        time = np.unwrap(np.array([one["raw"].stamp for one in rows], float), period=STAMPS) / 1000
        if not np.ptp(time):  # a recording without the drone's clock
            time = np.array([one["t"] for one in rows])
        found[name] = _increasing(path, time, np.array([one["raw"].state.rates for one in rows], float))
    if not found:
        raise InputError(f"log {path} holds no states of the drones")
    return found


def _increasing(path: Path, time: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finite rows in order of time, each time once. Raises InputError if there are too few."""
    kept = np.isfinite(time) & np.isfinite(rates).all(axis=1)
    time, rates = time[kept], rates[kept]
    time, first = np.unique(time, return_index=True)
    if len(time) < 50:
        raise InputError(f"log {path} holds {len(time)} rows of a drone; taps need a second and more")
    return time, rates[first]


def report(series: Series, path: Path) -> list[str]:
    """A line for each mode, and what gains need. Raises InputError if nothing rings."""
    lines, found, slowest = [], [], math.inf
    for name, (time, rates) in series.items():
        slowest = min(slowest, 1 / float(np.median(np.diff(time))))
        for number, axis in enumerate(MOUNTED):
            mode = find_mode(time, rates[:, number])
            if mode is not None:
                found.append(mode)
                lines.append(f"{name:8s} {axis:5s} {described(mode)}, {mode.taps} taps")
    if not found:
        raise InputError(
            f"no oscillation is found in log {path}: hold the stick, motors off, and tap a drone's arm a few times, a "
            "second apart, from above at the front and at the side"
        )
    lowest = min(found, key=lambda mode: mode.frequency)
    damping = max(min(mode.damping for mode in found), LEAST_DAMPING)
    mode = lowest._replace(damping=damping)
    least = math.floor(lowest.frequency - 2 * lowest.deviation)
    lines.append(f"mount mode: {described(mode)}; gains need --mount-hz {least} --mount-damping {damping:.2g}")
    if slowest < RESOLVED:
        fall = 1 - math.sqrt(INERTIA / (INERTIA + TAPED * LEVER**2))
        lines.append(
            f"a log of {slowest:.0f} rows a second does not tell it from a mode above {slowest / 2:.0f} Hz: tape "
            f"{1e3 * TAPED:g} g under a motor and tap again; it is this one if it falls by {100 * fall:.0f} %"
        )
    return lines


def described(mode: Mode) -> str:
    """Frequency and damping as text."""
    return f"{mode.frequency:.1f} Hz, damping {100 * mode.damping:.1f} %"


if __name__ == "__main__":
    sys.exit(main())
