#!/usr/bin/env python3
"""The block of README.md between `<!-- docs/readme.py -->` and `<!-- end -->`, made of the leaderboard's entries.

`python docs/readme.py` rewrites it.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from leaderboard import KINDS, best
from mjxball.bench import CONDITIONS
from mjxball.running import run_command

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
BLOCK = re.compile(r"(?<=<!-- docs/readme.py -->\n).*?(?=<!-- end -->)", re.DOTALL)
ROWS = {
    "pair": "a pair",
    "team": "a team of 3 to 6",
    "rigs": "a random rig of 2 to 6",
    "crazyflie": "two Crazyflies",
}
RESULTS = REPOSITORY / "benchmarks" / "results"
FIRST = {  # what README trains
    RESULTS / "first_command.json": (
        "The first command trains a follower for a pair with {shares} % (calm/disturbed) in {seconds} s on two cores,"
    ),
    RESULTS
    / "first_command_sac.json": "the paper's way, `--algorithm sac` on MJX, one with {shares} % in {seconds} s.",
}


def row(track: str, text: str) -> str:
    """One line of the table: the best of each kind with disturbances; the better one is bold."""
    found = {kind: best(names, track, CONDITIONS[-1]) for kind, names in KINDS.items()}
    most = max(share for share, _ in found.values())
    shown = [text]
    for kind in ("classical", "learned"):
        share, entries = found[kind]
        who = ", ".join(f"`{entry['follower']}`" for entry in entries)
        cell = f"{who} {share:.0f}" if entries else "-"
        shown.append(f"**{cell}**" if share == most and entries else cell)
    return " | ".join(shown)


def leads() -> str:
    """In how many of the tasks a classical follower is better without disturbances."""
    both = [[best(KINDS[kind], track, CONDITIONS[0])[0] for kind in ("classical", "learned")] for track in ROWS]
    ahead = sum(classical > learned for classical, learned in both)
    return f"In calm flights a classical follower leads in {ahead} of these {len(both)} tasks."


def sentences() -> list[str]:
    """What the first training is worth."""
    said = []
    for path, text in FIRST.items():
        if path.exists():
            record = json.loads(path.read_text())
            shares = "/".join(f"{100 * record['median'][one]:.0f}" for one in CONDITIONS)
            seconds = record["median"]["policy"]
            said.append(text.format(shares=shares, seconds=f"{seconds:.0f}"))
    return said


def block() -> str:
    """The text of the block."""
    table = ["task | best classical | best learned", "---|---|---", *(row(*one) for one in ROWS.items())]
    return "\n".join(["", *table, "", leads(), *sentences(), "", ""])


def main() -> int:
    """Rewrite the block."""
    README.write_text(BLOCK.sub(lambda _: block(), README.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
