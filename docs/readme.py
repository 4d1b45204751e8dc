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
from mjxball.bench.success import interval
from mjxball.bench.tracks import TRACKS
from mjxball.cli import make_parser
from mjxball.running import run_command

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
BLOCK = re.compile(r"(?<=<!-- docs/readme.py -->\n).*?(?=<!-- end -->)", re.DOTALL)
ROWS = ("pair", "team", "rigs", "crazyflie")
RESULTS = REPOSITORY / "benchmarks" / "results"
FIRST = {  # what README trains
    RESULTS / "first_command.json": (
        "`python train.py` trains a follower for a pair in {seconds} s on two cores: {shares} % (medians)."
    ),
    RESULTS / "first_command_sac.json": (
        "The paper's algorithm, SAC on MJX (our reward, exact sensors; "
        "[`--algorithm sac`](docs/training.md#algorithms)): {shares} % after {seconds} s."
    ),
}


def row(track: str) -> str:
    """One line of the table: the best of each kind in each condition, the better one bold if that is certain."""
    return " | ".join([TRACKS[track].title, *(cell(track, condition) for condition in CONDITIONS)])


def cell(track: str, condition: str) -> str:
    """The best classical and the best learned follower, and how often they succeed; bold if intervals are apart."""
    found = [best(KINDS[kind], track, condition) for kind in ("classical", "learned")]
    shown, ends = [], []
    for share, entries in found:
        if entries:
            flown = entries[0]["tracks"][track][condition]
            ends.append(interval(flown["succeeded"], flown["flights"]))
            shown.append(", ".join(f"`{one['follower']}`" for one in entries) + f" {share:.0f}")
    for number, (low, _) in enumerate(ends):
        if any(low > high for _, high in ends):
            shown[number] = f"**{shown[number]}**"
    return ", ".join(shown) or "-"


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
    table = ["task | calm | disturbed", "---|---|---", *(row(one) for one in ROWS)]
    return "\n".join(["", *table, "", *sentences(), "", ""])


def main() -> int:
    """Rewrite the block."""
    make_parser("python docs/readme.py", __doc__).parse_args()
    README.write_text(BLOCK.sub(lambda _: block(), README.read_text()))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
