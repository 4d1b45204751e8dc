#!/usr/bin/env python3
"""The block of README.md between `<!-- docs/readme.py -->` and `<!-- end -->`, made of the leaderboard's entries.

`python docs/readme.py` rewrites it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
BLOCK = re.compile(r"(?<=<!-- docs/readme.py -->\n).*?(?=<!-- end -->)", re.DOTALL)
FOLLOWERS = {
    "copy": "`copy`: the PD controller alone, optimum of the paper's reward",
    "adaptive": "`adaptive`",
    "pid": "`pid`",
    "observer": "`observer`: PD, disturbance observer",
    "lqg-offset-free": "`lqg-offset-free`",
    "mpc": "`mpc`",
    "lqg-slow": "`lqg-slow`",
    "sac": "**`sac`**: learned by SAC",
    "balance": "**`balance`**: learned by gradients",
}
TEXT = """
follower | settles to 2 % [s] | 90 % of peaks below [mm] | success [%] | mass unknown [%] | rotor at its limit [%]
---|---|---|---|---|---
{table}

`balance` settles soonest, undisturbed sways least, and serves known and unknown masses with one set of {parameters}
weights. Under noise its commands change by {own:.0f} mrad a step, those of the others that settle within 3 s by
{least:.0f} to {most:.0f}; of these `{sparing}` spares the rotors most. Of classical controllers `lqg-slow` succeeds
most often, where it knows the mass. The training below succeeds in {first:.0f} %.

"""


def tracks_of(name: str) -> dict[str, Any]:
    """Tracks of a follower's entry."""
    return json.loads((REPOSITORY / "benchmarks" / "leaderboard" / f"{name}.json").read_text())["tracks"]


def cell(track: dict[str, Any], key: str, factor: float, digits: int) -> str:
    """Undisturbed/disturbed."""
    values = [track[condition][key] for condition in ("undisturbed", "disturbed")]
    return "/".join("never" if value is None else f"{factor * value:.{digits}f}" for value in values)


def row(name: str) -> str:
    """One line of the table."""
    known, unknown = (tracks_of(name)[track] for track in ("pair", "pair-unknown"))
    columns = (("settling_50", 1, 2), ("peak_90", 1e3, 0), ("met", 100, 0))
    cells = [cell(known, *column) for column in columns]
    return " | ".join([FOLLOWERS[name], *cells, cell(unknown, "met", 100, 0), cell(known, "rotors_at_limit", 100, 1)])


def block() -> str:
    """The text of the block."""
    found = {name: tracks_of(name)["pair"]["disturbed"] for name in FOLLOWERS}
    quick = {name: one for name, one in found.items() if (one["settling_50"] or 99) <= 3}
    changes = {name: 1e3 * one["command_change"] for name, one in quick.items()}
    own = changes.pop("balance")
    with np.load(REPOSITORY / "policies" / "balance.npz") as policy:
        parameters = sum(policy[key].size for key in policy if key.startswith(("weight", "bias", "gru")))
    return TEXT.format(
        table="\n".join(map(row, FOLLOWERS)),
        parameters=f"{parameters:,}".replace(",", " "),
        own=own,
        least=min(changes.values()),
        most=max(changes.values()),
        sparing=min(quick, key=lambda name: quick[name]["rotors_at_limit"]),
        first=100 * tracks_of("transport-sac")["pair"]["undisturbed"]["met"],
    )


if __name__ == "__main__":
    README.write_text(BLOCK.sub(block(), README.read_text()))
