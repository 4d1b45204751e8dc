#!/usr/bin/env python3
"""Tables of the leaderboard, made of the entries in benchmarks/leaderboard/ when the site is built.

`python docs/leaderboard.py` prints them; an entry of another version or of other flights, or one that no flights can
give, is refused.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mjxball.baselines import CONTROLLERS
from mjxball.bench import CONDITIONS
from mjxball.bench.checks import read_entry
from mjxball.bench.entry import HEADS, cells
from mjxball.bench.tracks import TRACKS
from mjxball.errors import InputError
from mjxball.running import run_command

REPOSITORY = Path(__file__).parents[1]
ENTRIES = REPOSITORY / "benchmarks" / "leaderboard"
KINDS = {
    "learned": sorted(path.stem for path in (REPOSITORY / "policies").rglob("*.npz")),
    "classical": sorted(CONTROLLERS),
}
COSTS = ("success %", "error mm", "limit %", "power", "change mrad")  # columns of the best of each kind
COLUMNS = ["follower", "condition", *HEADS, "date, commit"]


@functools.cache
def entries() -> list[dict[str, Any]]:
    """All entries. Raises InputError for one that is none, and for two of one follower."""
    found = [read_entry(path) for path in sorted(ENTRIES.glob("*.json"))]
    names = [entry["follower"] for entry in found]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two entries are of {twice[0]}")
    return found


def table(track: str) -> str:
    """The rows of one track, the most successful in disturbed flights first."""
    flown = [entry for entry in entries() if track in entry["tracks"]]
    flown.sort(
        key=lambda entry: [entry["tracks"][track][one]["succeeded"] for one in reversed(CONDITIONS)], reverse=True
    )
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
    for entry in flown:
        beside = ((f"`{entry['follower']}`", entry["date"]), ("", entry["commit"][:7]))
        for condition, (called, made) in zip(CONDITIONS, beside, strict=True):
            shown = " | ".join(cells(entry["tracks"][track][condition]))
            lines.append(f"| {called} | {condition} | {shown} | {made} |")
    return "\n".join(lines)


def best(names: Iterable[str], track: str, condition: str) -> tuple[float, list[dict[str, Any]]]:
    """How often those of `names` succeed that do most often [%], and their entries; (-1, []) if none flew."""
    flown = [entry for entry in entries() if entry["follower"] in names and track in entry["tracks"]]
    found = [entry["tracks"][track][condition] for entry in flown]
    shares = [100 * one["succeeded"] / one["flights"] for one in found]
    most = max(shares, default=-1.0)
    return most, [entry for entry, share in zip(flown, shares, strict=True) if share == most]


def bests() -> str:
    """The best learned and the best classical follower of each track and condition, and what they cost to fly."""
    lines = [f"| track | condition | kind | follower | {' | '.join(COSTS)} |", f"|{'---|' * (4 + len(COSTS))}"]
    for track, own in TRACKS.items():
        for condition in CONDITIONS:
            for kind, names in KINDS.items():
                for entry in best(names, track, condition)[1]:
                    found = dict(zip(HEADS, cells(entry["tracks"][track][condition]), strict=True))
                    shown = " | ".join(found[head] for head in COSTS)
                    lines.append(f"| {own.title} | {condition} | {kind} | `{entry['follower']}` | {shown} |")
    return "\n".join(lines)


def __getattr__(name: str) -> Any:
    """What the directive `generated` calls for a track: its table. In the name `_` stands for a hyphen."""
    track = name.replace("_", "-")
    if track not in TRACKS:
        raise AttributeError(name)
    return lambda: table(track)


def main() -> int:
    """Print all tables."""
    for name, track in TRACKS.items():
        sys.stdout.write(f"{track.title}\n\n{table(name)}\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
