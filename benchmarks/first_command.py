"""How good the follower of README's first command is, and when: `train.py` for some seeds, each with an empty cache.

A row has the seconds of the whole command, those until its follower was written, and the share of the flights of draw 0
of mjxball-bench, track pair, in which the follower succeeds, with power and time with a rotor at its limit. What
follows `--` goes to `train.py`, or is another script and its flags, `OUT` for the policy file. A row's `curve` has the
success of every policy that was written on the way. `--warm` repeats the first seed with the cache that it left.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from harness import ROOT, Row, arguments, follower_of, medians, say, write
from mjxball import running
from mjxball.bench.draw import groups_of
from mjxball.bench.quick import summaries
from mjxball.errors import InputError

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
            say({name: value for name, value in rows[-1].items() if name != "curve"})
    cold = [row for row in rows if row["cache"] == "empty"]
    median = medians(cold, ("command", "policy", "calm", "disturbed"))
    say({"median": "", **median})
    write(options.json, {"track": TRACK, "arguments": more, "rows": rows, "median": median})
    return 0


def trained(seed: int, out: Path, cache: Path, more: Sequence[str]) -> Row:
    """Seconds and success of one command, and the success of each policy that it wrote on the way."""
    script = ["train.py", "--out", str(out), *more]
    if more and more[0].endswith(".py"):
        out.mkdir()
        script = [str(out / "policy.npz") if word == "OUT" else word for word in more]
    command = [sys.executable, *script, "--seed", str(seed)]
    environment = {**os.environ, "MJXBALL_CACHE": str(cache)}
    began, started, kept = time.monotonic(), time.time(), dict[float, Path]()
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL) as running_command:
        while running_command.poll() is None:
            time.sleep(0.2)
            kept |= copied(out, kept, started)
    whole = time.monotonic() - began
    if running_command.returncode:
        raise InputError(f"{' '.join(command)} ended with {running_command.returncode}")
    kept |= copied(out, kept, started)
    (group,) = groups_of(TRACK, 0)
    *found, last = summaries(group, [follower_of(str(path), group.config) for _, path in sorted(kept.items())])
    row: Row = {"command": whole, "policy": max(kept)}
    for condition, own in last.items():
        row |= {condition: share(own)}
        row |= {f"{condition} {name}": own[name] for name in ("rotor_power", "rotor_limit_share")}
    row["curve"] = [
        {"seconds": seconds, **{condition: share(own) for condition, own in one.items()}}
        for seconds, one in zip(sorted(kept), [*found, last], strict=True)
    ]
    return row


def share(own: Mapping[str, Any]) -> float:
    """Of the flights that succeed."""
    return own["succeeded"] / own["flights"]


def copied(out: Path, known: Collection[float], started: float) -> dict[float, Path]:
    """Copies of the policies in `out` by the second in which they were written, but for those that are `known`."""
    found = {path.stat().st_mtime - started: path for path in out.glob("*.npz")}
    new = {seconds: out.parent / f"{out.name}-{seconds:.3f}.npz" for seconds in found if seconds not in known}
    return {seconds: Path(shutil.copy2(found[seconds], place)) for seconds, place in new.items()}


if __name__ == "__main__":
    raise SystemExit(running.run_command(main))
