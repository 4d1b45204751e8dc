"""Command line of `python -m mjxfly.rig.gains`: attitude and rate gains of two Crazyflies on one stick."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from mjxball import cli, config, running
from mjxball.control.crazyflie import gains_to_json, pair_gains
from mjxball.files import write_atomically
from mjxfly.gain_design import AxisDesign, apply, design, with_margins
from mjxfly.margins import REQUIREMENTS, delivered_gains
from mjxfly.mount_modes import MOUNTED, RIGID, Mount, add_mount_options, mount_of

PRESETS = ("flight", "stand")


def parser() -> cli.Parser:
    """Return the argument parser."""
    result = cli.make_parser("python -m mjxfly.rig.gains", "Compute gains for the coupled pair, with their margins.")
    result.add_argument("--preset", choices=PRESETS, default="flight", help="rig (default flight)")
    result.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, or file of mjxfly.rig.identify or by hand"
    )
    add_mount_options(result)
    result.add_argument("--out", type=Path, metavar="GAINS.json", help="write what mjxfly --gains uploads")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Design the gains, print them with their margins, write the file; return the exit code."""
    options = parser().parse_args(arguments)
    return running.run_command(lambda: _gains(options))


def _gains(options: argparse.Namespace) -> int:
    settings = cli.apply_plant(config.preset(options.preset), options.plant)
    _ = settings.plant.pair  # InputError for teams
    mount = mount_of(options, settings.plant)
    if options.out:
        cli.output_file(options.out, ".json")
    designs = design(settings, mount)
    print(report(designs, settings, mount))  # noqa: T201
    if options.out:
        write_atomically(options.out, parameter_file(apply(settings.autopilot, designs)))
    return 0


def parameter_file(autopilot: config.Autopilot) -> str:
    """Return both drones' firmware parameters as JSON, the file that `mjxfly --gains` reads."""
    return json.dumps(gains_to_json(pair_gains(autopilot)), indent=1) + "\n"


def report(designs: Sequence[AxisDesign], settings: config.Config, mount: Mount = RIGID) -> str:
    """Return a table: per axis the designed and the delivered gains, with nominal and worst margins and modes."""
    head = (
        "axis",
        "inertia",
        "gains",
        "attitude kp ki kd",
        "rate kp ki kd",
        "phase",
        "gain",
        "delay",
        "worst",
        "modes",
    )
    rows: list[tuple[str, ...]] = [head]
    lag = settings.plant.rotor_lag
    for one in designs:
        delivered = delivered_gains(one.axis)
        rows.append(_row(one, "kept" if one.gains == delivered else "designed"))
        rows.append(_row(with_margins(delivered, one.axis, settings, mount), "delivered"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    (low, high), (light, heavy) = REQUIREMENTS.lags, REQUIREMENTS.inertias
    lines += [
        f"margins at {1e3 * lag:.0f} ms motor lag and {1e3 * REQUIREMENTS.delay:.0f} ms loop delay; worst: phase and "
        f"gain over lag {1e3 * low:.0f} to {1e3 * high:.0f} ms, inertia x {light:g} to {heavy:g}, "
        f"delay {1e3 * REQUIREMENTS.worst_delay:.0f} ms",
        f"modes: frequencies of a drone on its mount, of damping ratio {mount.damping:g}, at which the loop's gain is "
        f"at most 1 / {REQUIREMENTS.gain:g}, whatever its phase",
    ]
    if mount.is_rigid:
        lowest = max(one.lowest for one in designs)
        lines.append(f"measure the mount's mode (mjxfly.rig.mount): below {lowest:.0f} Hz it takes gains of --mount-hz")
    for one in designs:
        if one.nominal.phase and not one.worst.phase:
            alone = ", as one drone alone with delivered gains is" if one.gains == delivered_gains(one.axis) else ""
            lines.append(
                f"{one.axis.name} is unstable in the worst corner{alone}: measure the lag (mjxfly.rig.identify)"
            )
    return "\n".join(lines)


def _row(one: AxisDesign, label: str) -> tuple[str, ...]:
    gain_texts = (" ".join(f"{value:g}" for value in row) for row in one.gains)
    nominal, worst = one.nominal, one.worst
    inertia = f"{one.axis.inertia_ratio:.1f} x"
    if not nominal.phase:
        return (one.axis.name, inertia, label, *gain_texts, "unstable", "", "", "unstable", "")
    gain = f"x {nominal.gain_up:.1f}, / {nominal.gain_down:.1f}"
    left = f"{worst.phase:.0f} deg, x {worst.gain_up:.1f}, / {worst.gain_down:.1f}" if worst.phase else "unstable"
    modes = f"from {one.lowest:.0f} Hz" if one.axis.name in MOUNTED else ""
    phase = f"{nominal.phase:.0f} deg"
    return (one.axis.name, inertia, label, *gain_texts, phase, gain, _ms(nominal.delay), left, modes)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms"


if __name__ == "__main__":
    sys.exit(main())
