"""fly mjxball-bench and write an entry of the leaderboard"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from mjxball import cli
from mjxball.bench.tracks import TRACKS
from mjxball.commands.followers import clock
from mjxball.files import write_atomically
from mjxball.train.run_directory import commit, versions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `eval.py bench`."""
    parser.add_argument("follower", metavar="FOLLOWER", help="a policy, MODEL.onnx, module:Class, or a baseline's name")
    about = f"tracks to fly: {', '.join(TRACKS)} (default all)"
    parser.add_argument("--tracks", nargs="+", choices=TRACKS, default=list(TRACKS), metavar="NAME", help=about)
    about = "other flights than the published ones (default 0)"
    parser.add_argument("--draw", type=int, default=0, metavar="N", help=about)
    about = "repeat the evaluation of the entry with this key: noise and order of flights (default a fresh one)"
    parser.add_argument("--key", metavar="HEX", help=about)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json", help="where to write the entry")
    about = "write a table of all flights too: goal, arrival, the oracle's, errors, why a flight did not succeed"
    parser.add_argument("--flights", type=Path, metavar="FILE.csv", help=about)


def run(options: argparse.Namespace, command: str) -> int:
    """Fly the tracks and write the entry; return the exit code."""
    from mjxball.bench.entry import flight_table, make_entry, table

    cli.output_file(options.out, ".json")
    if options.flights is not None:
        cli.output_file(options.flights, ".csv")
    entry, flown = make_entry(options.follower, options.tracks, options.draw, options.key, clock())
    origin = {"command": command, "commit": commit(), "versions": versions()}
    write_atomically(options.out, json.dumps({**entry, **origin}, indent=1, allow_nan=False) + "\n")
    if options.flights is not None:
        write_atomically(options.flights, flight_table(flown))
    print(f"{table(entry)}\nthe entry is {options.out}")
    return 0
