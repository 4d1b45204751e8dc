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
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json", help="where to write the entry")


def run(options: argparse.Namespace, command: str) -> int:
    """Fly the tracks and write the entry; return the exit code."""
    from mjxball.bench.entry import make_entry, table
    from mjxball.bench.followers import entrant

    cli.output_file(options.out, ".json")
    name, make = entrant(options.follower)
    entry = make_entry(name, make, options.tracks, options.draw, clock())
    origin = {"command": command, "commit": commit(), "versions": versions()}
    write_atomically(options.out, json.dumps({**entry, **origin}, indent=1, allow_nan=False) + "\n")
    print(f"{table(entry)}\nthe entry is {options.out}")
    return 0
