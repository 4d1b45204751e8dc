"""Command line of `python -m mjxball.view`."""

from __future__ import annotations

import argparse
import tempfile
import webbrowser
from pathlib import Path

from mjxball.cli import Parser, make_parser, output_file, run_command
from mjxball.errors import InputError
from mjxball.files import write_whole
from mjxball.view.flight import flight_from, save_flight
from mjxball.view.page import flight_page

CHANGES = ("omega", "amplitude", "mass", "goal", "seconds")  # flags, and fields of a scenario


def parser() -> Parser:
    """The argument parser of `python -m mjxball.view`."""
    about = "Play a flight in the browser: one HTML page that needs neither a server nor a network; or watch one live."
    result = make_parser("python -m mjxball.view", about)
    result.add_argument(
        "source",
        metavar="POLICY|RUN|LOG",
        help="recorded flight (.npz), flight log (.jsonl), or what to fly: a run directory, policy, baseline or "
        "module:Class, your own",
    )
    result.add_argument("--out", type=Path, metavar="FILE.html", help="write the page here and open nothing")
    result.add_argument("--save", type=Path, metavar="FILE.npz", help="write the flight itself too")
    result.add_argument(
        "--hidden", action="store_true", help="show what the follower's recurrent network remembers as well"
    )
    live = result.add_argument_group("while it is flown")
    live.add_argument(
        "--live", action="store_true", help="follow a flight log that is being written, on a page of this machine alone"
    )
    live.add_argument("--port", type=int, default=None, metavar="PORT", help="of that page (a free one)")
    live.add_argument("--attached", action="store_true", help=argparse.SUPPRESS)  # end when standard input does
    flown = result.add_argument_group(
        "scenario of what is flown on the spot", "the follower's reference scenario, changed by"
    )
    flown.add_argument("--plant", type=Path, metavar="NAME|FILE", help="shipped plant, or a file of a rig")
    flown.add_argument("--omega", type=float, metavar="W", help="CG speed [rad/s]")
    flown.add_argument("--amplitude", type=float, metavar="A", help="of the CG [m]")
    flown.add_argument("--mass", type=float, metavar="M", help="of the object [kg]")
    flown.add_argument("--goal", nargs=3, type=float, metavar=("X", "Y", "Z"), help="[m]")
    flown.add_argument("--seconds", type=float, metavar="S", help="length of the flight")
    flown.add_argument("--physics", choices=("newton-euler", "mjx", "mujoco"), default="newton-euler")
    return result


def main(arguments: list[str] | None = None) -> int:
    """Show a flight; return the exit code."""
    options = parser().parse_args(arguments)
    return run_command(lambda: _view(options))


def _view(options: argparse.Namespace) -> int:
    if options.live:
        return _follow(options)
    if options.port is not None:
        raise InputError("--port is the port of --live; any other page needs no server")
    for path, suffix in ((options.out, ".html"), (options.save, ".npz")):
        if path:
            output_file(path, suffix)
    given = {name: getattr(options, name) for name in CHANGES if getattr(options, name) is not None}
    flight = flight_from(options.source, given, options.physics, options.plant, options.hidden)
    if options.save:
        save_flight(options.save, flight)
        print(f"the flight is {options.save}")  # noqa: T201
    page = options.out or Path(tempfile.mkdtemp(prefix="mjxball-")) / "flight.html"
    write_whole(page, flight_page(flight).encode())
    print(f"the page is {page}")  # noqa: T201
    if not options.out:
        webbrowser.open(page.as_uri())
    return 0


def _follow(options: argparse.Namespace) -> int:
    from mjxball.view.live import follow

    if options.hidden:
        raise InputError("--hidden is of a flight that has ended: leave it out of --live")
    if options.out or options.save:
        raise InputError("--live writes no file; play the log with --out or --save once the flight has ended")
    path, port = Path(options.source), options.port or 0
    if not 0 <= port <= 65535:
        raise InputError(f"--port must be 1 to 65535, not {port}")
    if not path.absolute().parent.is_dir():
        raise InputError(f"directory {path.absolute().parent} of the log does not exist")
    return follow(path, port, options.attached)
