"""Seconds from process start to the policy file, and its quality, for every algorithm of `train.py`.

`python benchmarks/algorithms.py [--seeds K] [--algorithms sac ppo gradient] [--flags "sac=--seed 3"] [--json FILE]`

Of each algorithm seed 0 is trained with an empty cache (cold), then every seed with that cache (warm), one after the
other, with all the cores that this one may use (`taskset`). Before that each is run once for a moment, uncounted: a
machine reads libraries from its disk only once. Prints one row an algorithm: seconds cold and warm (median), those of
compiling, seeds at the bar of `benchmarks/training.py`, median and worst metrics on the reference scenario.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from training import BAR, launch, say, until_policy, versions

SHORT = {
    "sac": "--sac.total_steps 25600 --sac.replay_size 25600",
    "ppo": "--ppo.total_steps 40960",
    "gradient": "--gradient.gradient_steps 1",
}


def train(name: str, seed: int, flags: str, place: Path, out: Path) -> dict[str, Any]:
    """One training, up to the last writing of its policy."""
    command = [
        "train.py",
        "transport",
        "--algorithm",
        name,
        "--seed",
        str(seed),
        "--out",
        str(out),
        *shlex.split(flags),
    ]
    started = time.time()
    seconds, output = until_policy(launch(command, place), started, out / "policy.npz")
    compiled = re.search(r"compiled in ([\d.]+)", output)
    rates = [
        float(rate) * {"": 1.0, "k": 1e3, "M": 1e6}[unit] for rate, unit in re.findall(r"([\d.]+) ?(k|M|)/s", output)
    ]
    row = {
        "algorithm": name,
        "seed": seed,
        "seconds": seconds,
        "compiled": float(compiled[1]) if compiled else math.nan,
    }
    return row | {"rate": statistics.median(rates) if rates else math.nan, "policy": out / "policy.npz"}


def evaluate(rows: list[dict[str, Any]]) -> None:
    """Add the metrics of the reference scenario, and whether they are at the bar, to every row."""
    from mjxball.config import preset
    from mjxball.evaluate.policies import load_policy
    from mjxball.evaluate.results import fly_scenarios
    from mjxball.evaluate.scenarios import REFERENCE

    settings = preset("transport")
    policies = [load_policy(row.pop("policy"), settings) for row in rows]
    for row, cell in zip(rows, fly_scenarios(settings, policies, [REFERENCE], "newton-euler"), strict=True):
        record = cell.record()
        row |= {name: math.inf if record[name] is None or record["failed"] else record[name] for name in BAR}
        row["at_bar"] = all(row[name] <= bar for name, bar in BAR.items())


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """One algorithm's row of the table; the first of `rows` is the cold one, and a seed's twin."""
    cold, *warm = rows
    found = {"algorithm": cold["algorithm"], "cold": cold["seconds"], "compiled": cold["compiled"]}
    found |= {"warm": statistics.median(row["seconds"] for row in warm)}
    found |= {"rate": statistics.median(row["rate"] for row in warm)}
    found |= {"at_bar": f"{sum(row['at_bar'] for row in warm)} of {len(warm)}"}
    for name in BAR:
        values = [row[name] for row in warm]
        found |= {name: statistics.median(values), f"{name}_worst": max(values)}
    return found


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", choices=tuple(SHORT), default=list(SHORT))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--flags", nargs="*", default=[], metavar="ALGORITHM=FLAGS", help="further flags of train.py")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    flags = dict.fromkeys(SHORT, "") | dict(one.split("=", 1) for one in options.flags)
    found: dict[str, Any] = {"bar": BAR, "flags": flags, "runs": [], "table": []}
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for algorithm in options.algorithms:
            train(algorithm, 0, f"{flags[algorithm]} {SHORT[algorithm]}", place / "first", place / f"first-{algorithm}")
            rows = []
            for number, seed in enumerate([0, *range(options.seeds)]):
                cache, out = place / f"cache-{algorithm}", place / f"{algorithm}{number}"
                rows.append(train(algorithm, seed, flags[algorithm], cache, out))
                say(rows[-1])
            evaluate(rows)
            found["runs"] += [row | {"cache": "warm" if number else "cold"} for number, row in enumerate(rows)]
            found["table"].append(summary(rows))
            say(found["table"][-1])
    found["versions"] = versions() | {"cores": len(os.sched_getaffinity(0))}
    for row in found["table"]:
        say(row)
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
