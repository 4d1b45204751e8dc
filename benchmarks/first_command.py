"""How good the follower of README's first command is, and when: `train.py` for some seeds, each with an empty cache.

A row has the seconds of the whole command, those until its follower was written, and the share of the flights of draw 0
of mjxball-bench, track pair, in which the follower succeeds, with power and time with a rotor at its limit. What
follows `--` goes to `train.py`. `--warm` repeats the first seed with the cache that it left.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from harness import ROOT, Row, arguments, follower_of, medians, say, write
from mjxball import running
from mjxball.bench.draw import groups_of
from mjxball.bench.quick import summaries

TRACK = "pair"


def main(given: Sequence[str] | None = None) -> int:
    """Train, fly, print, write."""
    given = list(sys.argv[1:] if given is None else given)
    cut = given.index("--") if "--" in given else len(given)
    more = given[cut + 1 :]
    parser = arguments(__file__, __doc__)
    parser.add_argument("--seeds", type=int, default=5, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--warm", action="store_true", help="then the first seed again, with its cache")
    options = parser.parse_args(given[:cut])
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as place:
        seeds = [options.first + number for number in range(options.seeds)]
        for number, seed in enumerate([*seeds, *seeds[: options.warm]]):
            warm = number >= len(seeds)
            out, cache = Path(place) / f"run{number}", Path(place) / f"cache{0 if warm else number}"
            rows.append({"seed": seed, "cache": "warm" if warm else "empty"})
            rows[-1] |= trained(seed, out, cache, more)
            say(rows[-1])
    cold = [row for row in rows if row["cache"] == "empty"]
    median = medians(cold, ("command", "policy", "calm", "disturbed"))
    say({"median": "", **median})
    write(options.json, {"track": TRACK, "arguments": more, "rows": rows, "median": median})
    return 0


def trained(seed: int, out: Path, cache: Path, more: Sequence[str]) -> Row:
    """Seconds and success of one command."""
    command = [sys.executable, "train.py", "--seed", str(seed), "--out", str(out), *more]
    environment = {**os.environ, "MJXBALL_CACHE": str(cache)}
    began, started = time.monotonic(), time.time()
    subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    whole = time.monotonic() - began
    written = (out / "policy.npz").stat().st_mtime - started
    (group,) = groups_of(TRACK, 0)
    (found,) = summaries(group, [follower_of(str(out / "policy.npz"), group.config)])
    row: Row = {"command": whole, "policy": written}
    for condition, own in found.items():
        row |= {condition: own["succeeded"] / own["flights"]}
        row |= {f"{condition} {name}": own[name] for name in ("rotor_power", "rotor_limit_share")}
    return row


if __name__ == "__main__":
    raise SystemExit(running.run_command(main))
