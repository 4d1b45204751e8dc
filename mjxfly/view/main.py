"""Command line of `python -m mjxfly.view`: the sources of mjxball.view, flight logs, and a flight in progress."""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

from mjxball.cli import Parser
from mjxball.errors import InputError
from mjxball.running import run_command
from mjxball.view.flight import flight_from
from mjxball.view.main import make_view_parser, show
from mjxfly.view.live import follow
from mjxfly.view.recorded import read_log


def parser() -> Parser:
    """Return the argument parser."""
    result = make_view_parser("python -m mjxfly.view", "flight log (.jsonl, .mcap), recorded flight (.npz)")
    live = result.add_argument_group("while it is flown")
    live.add_argument(
        "--live", action="store_true", help="follow a flight log that is being written, on a page of this machine alone"
    )
    live.add_argument("--port", type=int, default=None, metavar="PORT", help="of that page (a free one)")
    live.add_argument("--foxglove", type=int, metavar="PORT", help="for Foxglove too, on this machine alone")
    live.add_argument("--attached", action="store_true", help=argparse.SUPPRESS)  # end when standard input does
    return result


def main(arguments: list[str] | None = None) -> int:
    """Show a flight; return the exit code."""
    options = parser().parse_args(arguments)
    return run_command(lambda: _follow(options) if options.live else _play(options))


def _play(options: argparse.Namespace) -> int:
    if options.port is not None:
        raise InputError("--port is the port of --live; any other page needs no server")
    if options.foxglove is not None:
        raise InputError("--foxglove goes with --live; any other flight can be opened in Foxglove as a file")
    return show(options, functools.partial(flight_from, read_other=read_log))


def _follow(options: argparse.Namespace) -> int:
    if len(options.source) > 1:
        raise InputError("--live follows one log")
    if options.hidden:
        raise InputError("--hidden is of a flight that has ended: leave it out of --live")
    if options.out or options.save or options.video:
        raise InputError("--live writes no file; play the log with --out, --save or --video once the flight has ended")
    path, port = Path(options.source[0]), options.port or 0
    for name, number in (("port", port), ("foxglove", options.foxglove or 0)):
        if not 0 <= number <= 65535:
            raise InputError(f"--{name} must be 1 to 65535, not {number}")
    if not path.absolute().parent.is_dir():
        raise InputError(f"directory {path.absolute().parent} of the log does not exist")
    return follow(path, port, options.attached, options.foxglove)
