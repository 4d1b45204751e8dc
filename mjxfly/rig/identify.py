"""Command line of `python -m mjxfly.rig.identify`: a plant file from logs of a flight or of a bench."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import cli, config, running
from mjxball.control import crazyflie
from mjxball.control.axes import inertia_about_o
from mjxball.control.constants import hover
from mjxball.control.crazyflie import PARAMETERS, THRUST_CEILING, PairGains, pair_gains
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxball.terminal import warn
from mjxfly.policy_setup import with_curve
from mjxfly.preflight import read_gains
from mjxfly.recording import one_curve, own_curve
from mjxfly.rig.fit import LONGEST_DELAY, Estimate, identify, pair_mass
from mjxfly.rig.log import Log, read_log
from mjxfly.setpoints import CurveName

LEAST_INERTIA = 1e-6  # of a drone about its own centre [kg m2]
DELAY_EITHER_WAY = 0.01  # [s] half width of the delay range in the plant file, which training samples


def parser() -> cli.Parser:
    """Return the argument parser."""
    about = "Estimate hover thrust, thrust gain, motor lag, inertia across the stick and delay from logs."
    result = cli.make_parser("python -m mjxfly.rig.identify", about)
    result.add_argument("logs", nargs="+", type=Path, metavar="LOG", help="of mjxfly --log, a bag, .npz; see docs")
    result.add_argument("--preset", choices=("flight", "stand"), default="flight", help="rig (default flight)")
    result.add_argument("--plant", type=Path, metavar="NAME|FILE", help="masses and places as measured, to start from")
    result.add_argument(
        "--gains", type=Path, metavar="FILE", help="what the drones flew with, if the log does not say (the preset's)"
    )
    result.add_argument("--out", type=Path, metavar="PLANT.json", help="write a plant file for train, eval, rig.gains")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Identify the plant, print the estimates, write the plant file; return the exit code."""
    options = parser().parse_args(arguments)
    return running.run_command(lambda: _identify(options))


def _identify(options: argparse.Namespace) -> int:
    if options.out:
        cli.output_file(options.out, ".json")
    known = cli.read_plant(options.plant).settings if options.plant else {}
    settings = cli.apply_plant(config.preset(options.preset), options.plant)
    if settings.plant.cg_axis != "y":
        raise InputError("identification is of the inertia about x; the stick must lie along y")
    gains = read_gains(options.gains) if options.gains else None
    logs = [read_log(path, settings) for path in options.logs]
    flown = [flown_with(settings, log, gains, path) for path, log in zip(options.logs, logs, strict=True)]
    curve = curve_of_all([own_curve(one) for one in flown])
    converted = with_curve(settings, curve)
    found = [identify(one, log) for one, log in zip(flown, logs, strict=True)]
    for path, log, one in zip(options.logs, logs, found, strict=True):
        for remark in log.remarks:
            warn(remark)
        print(f"{path.name}: {one.windows} s of flight, {curve} force curve\n{report(converted, one)}")  # noqa: T201
    mean = average(found)
    if len(found) > 1:
        print(f"all {len(found)} logs\n{report(converted, mean)}")  # noqa: T201
    values = {**known, **conversion(settings, converted), **plant_settings(converted, mean)}
    if options.out:
        write_atomically(options.out, json.dumps({"preset": options.preset, **values}, indent=1) + "\n")
    config.validate(config.apply_overrides(settings, values))  # after writing: a rig too weak to fly keeps its file
    return 0


def flown_with(settings: config.Config, log: Log, gains: PairGains | None, path: Path) -> config.Config:
    """Return `settings` with the log's force curve, and with `gains` or else the log's gains.

    Raises InputError if the log is of another stand, or its curves or gains are not supported by the identification.
    """
    if log.stand not in (None, settings.plant.stand):
        rig = "flight" if log.stand == "free" else "stand"
        raise InputError(f"flight log {path} is of the {rig}: say --preset {rig}")
    if log.curves is not None:
        curve = one_curve(log.curves)
        if curve is None:
            leader, follower = log.curves
            raise InputError(
                f"flight log {path} is of a leader with the {leader} and a follower with the {follower} force curve; "
                "identification takes one of both"
            )
        settings = with_curve(settings, curve)
    gains = gains or log.gains
    return with_gains(settings, gains) if gains else settings


def curve_of_all(curves: Sequence[CurveName]) -> CurveName:
    """Return the common force curve of all logs. Raises InputError if they differ."""
    if len(set(curves)) > 1:
        raise InputError(f"the logs are of different force curves ({', '.join(curves)}): identify each curve by itself")
    return curves[0]


def conversion(settings: config.Config, converted: config.Config) -> dict[str, Any]:
    """Return the autopilot's settings, by path, in which `converted` differs from `settings`."""
    pairs = {
        f"autopilot.{item.name}": (getattr(settings.autopilot, item.name), getattr(converted.autopilot, item.name))
        for item in dataclasses.fields(converted.autopilot)
    }
    return {
        name: [_rounded(value) for value in new] if isinstance(new, tuple) else _rounded(new)
        for name, (old, new) in pairs.items()
        if new != old
    }


def with_gains(settings: config.Config, gains: PairGains) -> config.Config:
    """Return `settings` with both drones' loop gains taken from the firmware parameters `gains`.

    Raises InputError if the follower's gains differ from the leader's by more than one common factor on all ki.
    """
    autopilot = settings.autopilot
    leader, follower = (
        {**before, **{name: value for name, value in own.items() if name in PARAMETERS}}
        for before, own in zip(pair_gains(autopilot), gains, strict=True)
    )
    largest = max((name for name in leader if name.endswith("_ki")), key=lambda name: leader[name])
    share = follower[largest] / leader[largest] if leader[largest] else 1.0
    if not 0 <= share <= 1:
        raise InputError("identification takes a follower whose ki are not above the leader's")
    autopilot = dataclasses.replace(crazyflie.with_gains(autopilot, leader), follower_ki_scale=share)
    if not all(math.isclose(value, follower[name], rel_tol=1e-3) for name, value in pair_gains(autopilot)[1].items()):
        raise InputError("identification takes a follower whose gains are the leader's, all ki by one factor less")
    return dataclasses.replace(settings, autopilot=autopilot)


def average(found: Sequence[Estimate]) -> Estimate:
    """Return the mean of several estimates, weighted by their inverse variances."""
    values = np.array([[one.thrust, one.inertia, one.lag, one.delay, one.uneven] for one in found])
    weights = 1 / np.array([[*one.spread, one.uneven_spread] for one in found]) ** 2
    thrust, inertia, lag, delay, uneven = map(float, (weights * values).sum(axis=0) / weights.sum(axis=0))
    *s, uneven_spread = map(float, np.sqrt(1 / weights.sum(axis=0)))
    misfit = float(np.sqrt(np.mean([one.misfit**2 for one in found])))
    windows = sum(one.windows for one in found)
    return Estimate(thrust, inertia, lag, delay, (s[0], s[1], s[2], s[3]), misfit, windows, uneven, uneven_spread)


def plant_settings(settings: config.Config, found: Estimate) -> dict[str, Any]:
    """Return the settings, by path, that turn `settings` into the identified plant.

    The inertia that masses and positions do not explain is added to the drones, half to each, about roll and yaw.
    """
    plant, (a, b) = settings.plant, settings.autopilot.motor_curve
    curve = (found.thrust * a, found.thrust * b)
    stronger = config.apply_overrides(settings, {"autopilot.motor_curve": curve})
    more = 0.5 * (found.inertia - float(inertia_about_o(settings)[0]))

    def own(before: tuple[float, float, float]) -> tuple[float, float, float]:
        return max(before[0] + more, LEAST_INERTIA), before[1], max(before[2] + more, LEAST_INERTIA)

    return {
        "plant.rotor_lag": _rounded(found.lag),
        "plant.rotor_force_max": _rounded(sum(curve)),
        **{
            f"plant.drones.{number}.inertia": [_rounded(value) for value in own(drone.inertia)]
            for number, drone in enumerate(plant.drones)
        },
        "autopilot.motor_curve": [_rounded(value) for value in curve],
        # A rig too weak to hover is reported by `validate`.
        "autopilot.hover_thrust": min(round(hover(stronger)[0]), THRUST_CEILING),
        "scenario.delay": [
            _rounded(max(found.delay - DELAY_EITHER_WAY, 0.0)),
            _rounded(found.delay + DELAY_EITHER_WAY),
        ],
    }


def report(settings: config.Config, found: Estimate) -> str:
    """Return one line for each estimate with its standard deviation, and hints about a poor log."""
    a, b = settings.autopilot.motor_curve
    stronger = config.apply_overrides(settings, {"autopilot.motor_curve": (found.thrust * a, found.thrust * b)})
    command, slope = hover(stronger)
    gain = 8 * slope * 1000 / pair_mass(settings)
    thrust, inertia, lag, delay = found.spread
    computed = float(inertia_about_o(settings)[0])
    lines = [
        f"  hover thrust  {command:.0f} units, force {found.thrust:.3f} +- {thrust:.3f} of the motor curve",
        f"  thrust gain   {gain:.3f} m/s2 per 1000 units",
        f"  motor lag     {1e3 * found.lag:.1f} +- {1e3 * found.lag * lag:.1f} ms",
        f"  inertia       {1e3 * found.inertia:.4f} +- {1e3 * found.inertia * inertia:.4f} g m2 across the stick, "
        f"{found.inertia / computed:.2f} of what masses and places give",
        f"  delay         {1e3 * found.delay:.1f} +- {1e3 * delay:.1f} ms",
        f"  uneven        leader {100 * found.uneven:+.1f} %, follower {-100 * found.uneven:+.1f} %, "
        f"+- {100 * found.uneven_spread:.1f}",
        f"  misfit        {found.misfit:.2f} of the noise that was assumed",
    ]
    if max(thrust, inertia, lag) > 0.1:
        lines.append("  too little moves in this log: fly steps of roll and of height")
    if not 0.0 < found.delay < LONGEST_DELAY:
        lines.append(
            f"  the delay is not within 0 to {1e3 * LONGEST_DELAY:.0f} ms: log setpoints and states by one clock"
        )
    if found.inertia < 0.95 * computed:
        lines.append("  less inertia than masses and places give: weigh and measure the rig again")
    return "\n".join(lines)


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")


if __name__ == "__main__":
    sys.exit(main())
