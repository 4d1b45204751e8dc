"""Command line of `python -m mjxfly.rig.design`: whether a rig can fly, which loads it balances, a plan view."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from mjxball import cli, pictures, running
from mjxball.config import Config, cg_limit, thrust_over_weight, total_mass
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxball.plant.trim import heaviest_object, largest_amplitude
from mjxball.terminal import say
from mjxfly.margins import unstable_axes

# Unit vectors 30 degrees apart; the opposite directions are covered because `largest_amplitude` tests both signs.
DIRECTIONS = tuple((math.cos(turn * math.pi / 6), math.sin(turn * math.pi / 6)) for turn in range(6))
SHARES = (0.25, 0.5, 1.0)  # CG offsets at which the heaviest load is reported, as fractions of `cg_limit`


def parser() -> cli.Parser:
    """Return the argument parser."""
    result = cli.make_parser("python -m mjxfly.rig.design", "Say whether a rig can fly and what load it balances.")
    about = "shipped plant, file of a rig, or a model of a drone, MJCF or URDF (pair)"
    result.add_argument("--plant", type=Path, metavar="NAME|FILE", help=about)
    result.add_argument("--out", type=Path, metavar="PLAN.svg", help="write a picture of the rig from above")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the report and write the plan; return the exit code, 1 if the rig cannot balance its own object."""
    options = parser().parse_args(arguments)
    return running.run_command(lambda: _design(options))


def _design(options: argparse.Namespace) -> int:
    if options.out:
        cli.output_file(options.out, ".svg")
    settings = cli.plant_setup(options.plant)
    for name in unstable_axes(settings):
        raise InputError(
            f"{options.plant}: with its autopilot.{name} and {name}_rate the rig does not hold its {name}; "
            "mjxfly.rig.gains computes gains"
        )
    held = balanced(settings)
    for line in report(settings, held):
        say(line)
    if options.out:
        write_atomically(options.out, picture(settings, held))
    return 0 if held >= 0 else 1


def balanced(settings: Config) -> float:
    """Return the largest CG offset from O [m] at which the rig trims its own object, at most `cg_limit`.

    It is negative if the rig cannot trim the object even at O. If the CG moves in the plane, it is the minimum over
    twelve directions.
    """
    plant, margin = settings.plant, settings.scenario.trim_margin
    directions = DIRECTIONS if len(plant.directions) == 2 else (None,)
    amplitudes = (largest_amplitude(settings, plant.object_mass, margin, direction) for direction in directions)
    return min(*amplitudes, cg_limit(plant))


def report(settings: Config, held: float) -> list[str]:
    """Return the report's lines: mass, hover thrust, CG limit `held` [m] of the rig's object, heaviest loads."""
    plant, limit = settings.plant, cg_limit(settings.plant)
    load, share = f"its object of {plant.object_mass:.3g} kg", 1 / thrust_over_weight(plant)
    can = f"can fly and balances {load} up to {held:.3g} m" if held >= 0 else f"cannot balance {load} even at 0 m"
    axis = plant.cg_axis[0]
    loads = (f"{heaviest_object(settings, part * limit):.3g} kg at {part * limit:.3g} m" for part in SHARES)
    return [
        f"{plant.count} drones, {total_mass(plant):.4g} kg in all: hovering takes {share:.0%} of the rotors' force",
        f"the rig {can} from O, keeping {settings.scenario.trim_margin:.0%} of what hovering leaves",
        f"the heaviest object that it balances, by the distance of its CG from O along {axis}: {', '.join(loads)}",
    ]


def picture(settings: Config, held: float) -> str:
    """Return the plan view as SVG, x to the right, with the region of the object's CG that the rig can trim."""
    plant = settings.plant
    mounts = [drone.mount for drone in plant.drones]
    far = tuple(max(held, 0.0) if axis in plant.directions else 0.0 for axis in (0, 1))
    return pictures.plan(mounts, plant.leader, plant.of_drones("arm"), plant.object_size, far)


if __name__ == "__main__":
    sys.exit(main())
