#!/usr/bin/env python3
"""The block of README.md between `<!-- docs/readme.py -->` and `<!-- end -->`, made of the leaderboard's entries.

`python docs/readme.py` rewrites it. A follower without an entry has no row.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard import KINDS, best, entries
from mjxball.bench import CONDITIONS
from mjxball.bench.entry import HEADS, cells
from mjxball.bench.tracks import TRACKS as BENCH_TRACKS
from mjxball.running import run_command

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
BLOCK = re.compile(r"(?<=<!-- docs/readme.py -->\n).*?(?=<!-- end -->)", re.DOTALL)
TRACKS = {"pair": "mass known", "pair-unknown": "mass unknown"}
CLASSICAL = {
    "copy": "`copy`: the PD controller alone",
    "adaptive": "`adaptive`",
    "pid": "`pid`",
    "observer": "`observer`",
    "mpc": "`mpc`",
    "lqg": "`lqg`",
}
TRAINED = {"sac": "**`sac`**: learned by SAC", "balance": "**`balance`**: learned by gradients"}
RESULTS = REPOSITORY / "benchmarks" / "results"
FIRST = {  # what README trains
    RESULTS / "first_command.json": (
        "The training below succeeds in {shares} % after {seconds} s on two cores, medians of {seeds} seeds;"
    ),
    RESULTS / "first_command_sac.json": (
        "`--algorithm sac`, the paper's algorithm on MJX, succeeds in {shares} % after {seconds} s."
    ),
}
COLUMNS = (
    "follower",
    "success [%]",
    "mass unknown [%]",
    "late error, 90 % [mm]",
    "rotor at its limit [%]",
    "power over hover",
    "change of commands [mrad]",
)

Tracks = dict[str, dict[str, Any]]  # an entry's results of each track and condition


def shown(tracks: Tracks, track: str, head: str) -> str:
    """calm/world of one column of the leaderboard; a dash if the track was not flown."""
    if track not in tracks:
        return "-"
    return "/".join(dict(zip(HEADS, cells(tracks[track][one]), strict=True))[head] for one in CONDITIONS)


def row(text: str, tracks: Tracks) -> str:
    """One line of the table."""
    columns = (("pair", "success %"), ("pair-unknown", "success %"))
    columns += (("pair", "late mm"), ("pair", "limit %"))
    columns += (("pair", "power"), ("pair", "change mrad"))
    return " | ".join([text, *(shown(tracks, *column) for column in columns)])


def leads() -> list[str]:
    """In how many of the cells of the chart, `best.svg`, a classical follower is better."""
    both = [[best(names, track, one)[0] for names in KINDS.values()] for track in BENCH_TRACKS for one in CONDITIONS]
    flown = [shares for shares in both if min(shares) >= 0]
    ahead = sum(classical > learned for learned, classical in flown)
    return [f"Classical followers lead in {ahead} of {len(flown)} cells."] if flown else []


def sentences() -> list[str]:
    """The size of `balance`, and what the first training is worth."""
    with np.load(REPOSITORY / "policies" / "balance.npz") as policy:
        parameters = sum(policy[key].size for key in policy if key.startswith(("weight", "bias", "gru")))
    said = [f"`balance` has {parameters:,} weights.".replace(",", " ", 1)]
    for path, text in FIRST.items():
        if path.exists():
            record = json.loads(path.read_text())
            shares = "/".join(f"{100 * record['median'][one]:.0f}" for one in CONDITIONS)
            seconds, seeds = record["median"]["policy"], len({one["seed"] for one in record["rows"]})
            said.append(text.format(shares=shares, seconds=f"{seconds:.0f}", seeds=seeds))
    return said


def block() -> str:
    """The text of the block."""
    found = {entry["follower"]: entry["tracks"] for entry in entries()}
    rows = [row(text, found[name]) for name, text in (CLASSICAL | TRAINED).items() if name in found]
    table = [" | ".join(COLUMNS), "|".join(["---"] * len(COLUMNS)), *rows]
    return "\n".join(["", *table, "", *leads(), *sentences(), "", ""])


def main() -> int:
    """Rewrite the block."""
    README.write_text(BLOCK.sub(lambda _: block(), README.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
