"""Command line of `python -m mjxfly.rig.gains`: attitude and rate gains of two Crazyflies on one stick."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from mjxball import cli, config, running
from mjxball.control.crazyflie import gains_to_json, pair_gains
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxfly.margins import (
    REQUIREMENTS,
    AxisDesign,
    Gains,
    Margins,
    apply,
    delivered_gains,
    design,
    nominal_and_worst,
)

PRESETS = ("flight", "stand")


def parser() -> cli.Parser:
    """Return the argument parser."""
    result = cli.make_parser("python -m mjxfly.rig.gains", "Compute gains for the coupled pair, with their margins.")
    result.add_argument("--preset", choices=PRESETS, default="flight", help="rig (default flight)")
    result.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, or file of mjxfly.rig.identify or by hand"
    )
    result.add_argument("--out", type=Path, metavar="GAINS.json", help="write what mjxfly --gains uploads")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Design the gains, print them with their margins, write the file; return the exit code."""
    options = parser().parse_args(arguments)
    return running.run_command(lambda: _gains(options))


def _gains(options: argparse.Namespace) -> int:
    settings = cli.apply_plant(config.preset(options.preset), options.plant)
    _ = settings.plant.pair  # InputError for teams
    if options.out:
        cli.output_file(options.out, ".json")
    try:
        designs = design(settings)
    except ValueError as error:
        raise InputError(f"{error}: a lighter or shorter stick, or faster motors, would help") from None
    print(report(designs, settings.plant.rotor_lag))  # noqa: T201
    if options.out:
        write_atomically(options.out, parameter_file(apply(settings.autopilot, designs)))
    return 0


def parameter_file(autopilot: config.Autopilot) -> str:
    """Return both drones' firmware parameters as JSON, the file that `mjxfly --gains` reads."""
    return json.dumps(gains_to_json(pair_gains(autopilot)), indent=1) + "\n"


def report(designs: Sequence[AxisDesign], lag: float) -> str:
    """Return a table: per axis the designed and the delivered gains, with nominal and worst margins; `lag` in [s]."""
    head = ("axis", "inertia", "gains", "attitude kp ki kd", "rate kp ki kd", "phase", "gain", "delay", "worst")
    rows: list[tuple[str, ...]] = [head]
    for one in designs:
        delivered = delivered_gains(one.axis)
        name = "kept" if one.gains == delivered else "designed"
        rows.append(_row(one, name, one.gains, one.nominal, one.worst))
        rows.append(_row(one, "delivered", delivered, *nominal_and_worst(delivered, one.axis, lag)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    (low, high), (light, heavy) = REQUIREMENTS.lags, REQUIREMENTS.inertias
    lines += [
        f"margins at {1e3 * lag:.0f} ms motor lag and {1e3 * REQUIREMENTS.delay:.0f} ms loop delay; worst: phase and "
        f"gain over lag {1e3 * low:.0f} to {1e3 * high:.0f} ms, inertia x {light:g} to {heavy:g}, "
        f"delay {1e3 * REQUIREMENTS.worst_delay:.0f} ms"
    ]
    for one in designs:
        if one.nominal.phase and not one.worst.phase:
            alone = ", as one drone alone with delivered gains is" if one.gains == delivered_gains(one.axis) else ""
            lines.append(
                f"{one.axis.name} is unstable in the worst corner{alone}: measure the lag (mjxfly.rig.identify)"
            )
    return "\n".join(lines)


def _row(one: AxisDesign, label: str, gains: Gains, nominal: Margins, worst: Margins) -> tuple[str, ...]:
    gain_texts = (" ".join(f"{value:g}" for value in row) for row in gains)
    inertia = f"{one.axis.inertia_ratio:.1f} x"
    if not nominal.phase:
        return (one.axis.name, inertia, label, *gain_texts, "unstable", "", "", "unstable")
    gain = f"x {nominal.gain_up:.1f}, / {nominal.gain_down:.1f}"
    left = f"{worst.phase:.0f} deg, x {worst.gain_up:.1f}, / {worst.gain_down:.1f}" if worst.phase else "unstable"
    return (one.axis.name, inertia, label, *gain_texts, f"{nominal.phase:.0f} deg", gain, _ms(nominal.delay), left)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms"


if __name__ == "__main__":
    sys.exit(main())
