#!/usr/bin/env python3
"""Tables of the leaderboard, made of the entries in benchmarks/leaderboard/ when the site is built.

`python docs/leaderboard.py` prints them; an entry of another version or of other flights, or one that no flights can
give, is refused.
"""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any

from mjxball.bench import CONDITIONS
from mjxball.bench.checks import read_entry
from mjxball.bench.entry import HEADS, cells
from mjxball.bench.tracks import TRACKS
from mjxball.errors import InputError
from mjxball.running import run_command

ENTRIES = Path(__file__).parents[1] / "benchmarks" / "leaderboard"
COLUMNS = ["follower", "", *HEADS, "date, commit"]


@functools.cache
def entries() -> list[dict[str, Any]]:
    """All entries. Raises InputError for one that is none, and for two of one follower."""
    found = [read_entry(path) for path in sorted(ENTRIES.glob("*.json"))]
    names = [entry["follower"] for entry in found]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two entries are of {twice[0]}")
    return found


def table(track: str) -> str:
    """The rows of one track, the most successful in the world first."""
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


def __getattr__(name: str) -> Any:
    """What the directive `generated` calls: the table of a track, whose name here has no hyphen."""
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
