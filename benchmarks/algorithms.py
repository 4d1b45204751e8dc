"""Seconds from process start to the policy file, and its quality, for every algorithm of `train.py` on one device.

`python benchmarks/algorithms.py [--seeds K] [--algorithms sac ppo gradient] [--gpu] [--flags "sac=--seed 3"]
[--whole] [--policies DIR] [--json FILE]`

Of each algorithm seed 0 is trained with an empty cache (cold), then every seed with that cache (warm), one after the
other, with all the cores that this one may use (`taskset`). Before that each is run once for a moment, uncounted: a
machine reads libraries from its disk only once. Prints one row an algorithm: seconds cold and warm (median), those of
compiling, environment steps a second, seeds at the bar of `benchmarks/training.py`, median and worst metrics on the
reference scenario. `--gpu` takes the settings that suit one; `--whole` also waits for the end of every command,
evaluation and figures included. `--policies DIR` keeps the warm runs' policies.

`python benchmarks/algorithms.py --judge FILE.json --policies DIR` adds to the table of such a run how its policies do
where the best follower is judged, medians over the seeds: levels of `benchmarks/balance.py`, cells of
`benchmarks/cells.py` (mass known, known and disturbed, unknown, unknown and disturbed).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from training import BAR, _finite, launch, say, until_policy, versions

SHORT = {
    "sac": "--sac.total_steps 25600 --sac.replay_size 25600",
    "ppo": "--ppo.total_steps 40960",
    "gradient": "--gradient.gradient_steps 1",
}
ON_GPU = {
    "sac": "--sac.total_steps 384000 --sac.replay_size 384000 --sac.learning_rate 5e-3 --sac.num_envs 512 "
    "--sac.updates_per_step 16 --sac.batch_size 256 --sac.tau 0.03 --sac.num_evaluations 1",
    "ppo": "--ppo.num_evaluations 1",
    "gradient": "",
}


def train(name: str, seed: int, flags: str, place: Path, out: Path, whole: bool = False) -> dict[str, Any]:
    """One training, up to the last writing of its policy, or `whole`."""
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
    started, policy = time.time(), out / "policy.npz"
    child = launch(command, place)
    if whole:
        output, _ = child.communicate()
        if child.returncode:
            raise RuntimeError(f"training failed with code {child.returncode}:\n{output[-3000:]}")
        seconds, ended = policy.stat().st_mtime - started, time.time() - started
    else:
        (seconds, output), ended = until_policy(child, started, policy), math.nan
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
    row |= {"whole": ended} if whole else {}
    return row | {"rate": statistics.median(rates) if rates else math.nan, "policy": policy}


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
    if "whole" in cold:
        found |= {"whole_cold": cold["whole"], "whole_warm": statistics.median(row["whole"] for row in warm)}
    found |= {"rate": statistics.median(row["rate"] for row in warm)}
    found |= {"at_bar": f"{sum(row['at_bar'] for row in warm)} of {len(warm)}"}
    for name in BAR:
        values = [row[name] for row in warm]
        found |= {name: statistics.median(values), f"{name}_worst": max(values)}
    return found


def judge(file: Path, place: Path) -> None:
    """Add the counts of the benchmarks of the best follower to the table in `file`, and each seed's to its run."""
    import seeds
    from mjxball.config import preset
    from mjxball.evaluate.policies import load_policy

    found, settings = json.loads(file.read_text()), preset("paper")
    for row in found["table"]:
        runs = [run for run in found["runs"] if run["algorithm"] == row["algorithm"] and run["cache"] == "warm"]
        policies = [load_policy(place / f"{run['algorithm']}-{run['seed']}.npz", settings) for run in runs]
        of_levels, of_cells = seeds.of_levels(settings, policies), seeds.of_cells(settings, policies)
        for run, levels, cells in zip(runs, of_levels, of_cells, strict=True):
            run |= {"levels": levels["reached"], "failed": levels["failed"], "cells": cells["cells"]}
        names = list(runs[0]["levels"])
        row["levels"] = {name: statistics.median(run["levels"][name] for run in runs) for name in names}
        row["cells"] = [statistics.median(run["cells"][k] for run in runs) for k in range(len(runs[0]["cells"]))]
        say(row)
    file.write_text(json.dumps(found, indent=2) + "\n")


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", choices=tuple(SHORT), default=list(SHORT))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--flags", nargs="*", default=[], metavar="ALGORITHM=FLAGS", help="further flags of train.py")
    parser.add_argument("--gpu", action="store_true", help="the settings of one GPU")
    parser.add_argument("--whole", action="store_true", help="wait for evaluation and figures, too")
    parser.add_argument("--policies", type=Path, metavar="DIR", help="where policies are kept, or found by --judge")
    parser.add_argument("--judge", type=Path, metavar="FILE.json", help="add the benchmarks to what was measured")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    if options.judge:
        judge(options.judge, options.policies)
        return
    own = dict(one.split("=", 1) for one in options.flags)
    flags = {name: f"{ON_GPU[name] if options.gpu else ''} {own.get(name, '')}".strip() for name in SHORT}
    found: dict[str, Any] = {"bar": BAR, "flags": flags, "runs": [], "table": []}
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for algorithm in options.algorithms:
            train(algorithm, 0, f"{flags[algorithm]} {SHORT[algorithm]}", place / "first", place / f"first-{algorithm}")
            rows = []
            for number, seed in enumerate([0, *range(options.seeds)]):
                cache, out = place / f"cache-{algorithm}", place / f"{algorithm}{number}"
                rows.append(train(algorithm, seed, flags[algorithm], cache, out, options.whole))
                say(rows[-1])
                if options.policies and number:
                    options.policies.mkdir(parents=True, exist_ok=True)
                    shutil.copy(rows[-1]["policy"], options.policies / f"{algorithm}-{seed}.npz")
            evaluate(rows)
            found["runs"] += [row | {"cache": "warm" if number else "cold"} for number, row in enumerate(rows)]
            found["table"].append(summary(rows))
            say(found["table"][-1])
    found["versions"] = versions() | {"cores": len(os.sched_getaffinity(0))}
    for row in found["table"]:
        say(row)
    if options.json:
        options.json.write_text(json.dumps(_finite(found), indent=2) + "\n")


if __name__ == "__main__":
    main()
