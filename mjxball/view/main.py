"""Command line of `python -m mjxball.view`."""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

from mjxball.cli import Parser, make_parser, output_file
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxball.running import run_command
from mjxball.terminal import Working
from mjxball.view.flight import Flight, flight_from, save_flight
from mjxball.view.page import flight_page

VIDEOS = (".mp4", ".gif")
CHANGES = ("omega", "amplitude", "mass", "goal", "seconds")  # flags with the names of fields of a scenario


def parser() -> Parser:
    """Argument parser of `python -m mjxball.view`."""
    return make_view_parser("python -m mjxball.view", "recorded flight (.npz)")


def make_view_parser(name: str, recorded: str) -> Parser:
    """Argument parser of the viewer command `name`; `recorded` describes the files that it plays."""
    about = "Play a flight in the browser: one HTML page that needs neither a server nor a network."
    result = make_parser(name, about)
    result.add_argument(
        "source",
        nargs="+",
        metavar="POLICY|RUN|FLIGHT",
        help=f"{recorded}, or what to fly: a run directory, policy, baseline or module:Class, your own; two are shown "
        "side by side with one clock",
    )
    result.add_argument("--out", type=Path, metavar="FILE.html", help="write the page here and open nothing")
    result.add_argument("--save", type=Path, metavar="FILE.npz", help="write the flight itself too")
    result.add_argument(
        "--hidden", action="store_true", help="show what the follower's recurrent network remembers as well"
    )
    film = result.add_argument_group("video by MuJoCo's renderer")
    film.add_argument(
        "--video", type=Path, metavar="FILE.mp4|FILE.gif", help="write a video instead of a page, and open nothing"
    )
    film.add_argument("--speed", type=float, metavar="X", help="flight time over playing time (1)")
    flown = result.add_argument_group(
        "scenario of what is flown on the spot", "the follower's reference scenario, changed by"
    )
    flown.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, file of a rig, or a model of a drone"
    )
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
    return run_command(lambda: show(options, flight_from))


def show(options: argparse.Namespace, flight_from: Callable[..., Flight]) -> int:
    """Show the sources in `options`, each read or flown by `flight_from`; return the exit code. Raises InputError."""
    if len(options.source) > 2:
        raise InputError(f"two flights fit side by side, not {len(options.source)}")
    if options.speed is not None and not options.video:
        raise InputError("--speed is of --video; a page has its own")
    _check(options)
    given = {name: getattr(options, name) for name in CHANGES if getattr(options, name) is not None}
    flights = []
    for one in options.source:
        with Working(f"preparing the flight of {Path(one).name}"):
            flights.append(flight_from(one, given, options.physics, options.plant, options.hidden))
    if len({flight.title for flight in flights}) < len(flights):  # equal titles would be ambiguous
        named = zip(options.source, flights, strict=True)
        flights = [dataclasses.replace(one, title=f"{Path(source).name}: {one.title}"[:200]) for source, one in named]
    if options.video:
        with Working("drawing the video"):
            film = _video(flights, options.video.suffix, options.speed or 1.0)
        write_atomically(options.video, film)
        print(f"the video is {options.video}")  # noqa: T201
    if options.save:
        save_flight(options.save, flights[0])
        print(f"the flight is {options.save}")  # noqa: T201
    if options.out or not options.video:
        page = options.out or Path(tempfile.mkdtemp(prefix="mjxball-")) / "flight.html"
        write_atomically(page, flight_page(*flights).encode())
        print(f"the page is {page}")  # noqa: T201
        if not options.out:
            webbrowser.open(page.as_uri())
    return 0


def _check(options: argparse.Namespace) -> None:
    """Raise InputError for options that exclude each other or cannot be written, before anything is simulated."""
    if options.save and len(options.source) > 1:
        raise InputError("--save writes one flight: leave one of the two out")
    if options.speed is not None and not 0.01 <= options.speed <= 100:
        raise InputError(f"--speed must be 0.01 to 100, not {options.speed:g}")
    if options.video and options.video.suffix not in VIDEOS:
        raise InputError(f"--video must end in {' or '.join(VIDEOS)}, not {options.video}")
    for path, suffix in ((options.out, ".html"), (options.save, ".npz"), (options.video, None)):
        if path:
            output_file(path, suffix or path.suffix)


def _video(flights: Sequence[Flight], suffix: str, speed: float) -> bytes:
    from mjxball.evaluate.render import render

    labels = [flight.title.partition(":")[0].partition(",")[0] for flight in flights]
    if len(set(labels)) < len(labels):
        labels = [f"{label} {number}" for number, label in enumerate(labels, 1)]
    arrays = {label: flight.arrays for label, flight in zip(labels, flights, strict=True)}
    return render([flight.plant for flight in flights], arrays, suffix, speed=speed)
