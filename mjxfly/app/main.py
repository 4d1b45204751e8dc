"""Make apps for the firmware of two Crazyflies, `python -m mjxfly.app POLICY|RUN DIR`.

DIR is a new directory with an app for each drone; see docs/hardware.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mjxball.cli import make_parser, plant_setup
from mjxball.errors import InputError
from mjxball.export import add_source, contents_of, in_team
from mjxball.policy import team
from mjxball.running import run_command
from mjxfly.app.generate import check_place, write_app


def main(arguments: list[str] | None = None) -> int:
    """Write the apps; return the exit code."""
    about, place = (__doc__ or "").split("\n\n")
    parser = make_parser("python -m mjxfly.app", about, epilog=place)
    add_source(parser)
    parser.add_argument("place", metavar="DIR", type=Path, help="directory to make; must not exist")
    parser.add_argument("--int8", action="store_true", help="weights of 8 bits, which can be uploaded later")
    options = parser.parse_args(arguments)
    return run_command(lambda: _make(options))


def _make(options: argparse.Namespace) -> int:
    """Write the apps; a policy for any rig uses the plant `crazyflie` by default."""
    check_place(options.place)
    policy, name, plant = contents_of(options.source), options.source.stem, options.plant
    if plant is None and team.is_for_any(policy.metadata):
        plant = team.CRAZYFLIES
    drones = 2 if plant is None else plant_setup(plant).plant.count
    if drones != 2:
        raise InputError(f"an app is for pairs of Crazyflies, and {plant} has {drones} drones")
    write_app(in_team(policy, name, plant, options.drone), name, options.place, options.int8)
    print(options.place)  # noqa: T201
    return 0
