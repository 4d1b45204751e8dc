"""Seconds from process start to the policy file, and its quality, for every algorithm of `train.py` on one device.

Of each algorithm seed 0 is trained with an empty cache (cold), then every seed with that cache (warm), one after the
other, with all the cores that this one may use (`taskset`). Before that each is run once for a moment, uncounted: a
machine reads libraries from its disk only once. Prints one row an algorithm: seconds cold and warm (median), those of
compiling, environment steps a second, seeds at the bar of `benchmarks/training.py`, median and worst metrics on the
reference scenario. `--gpu` takes the settings that suit one.
"""

from __future__ import annotations

import math
import re
import shlex
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness import Row, arguments, medians, say, table, write
from mjxball.running import run_command
from training import BAR, evaluate, launch, until_policy

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


def train(name: str, seed: int, flags: str, place: Path, out: Path) -> Row:
    """One training, up to the last writing of its policy."""
    command = ["train.py", "transport", "--algorithm", name, "--seed", str(seed), "--out", str(out)]
    started, policy = time.time(), out / "policy.npz"
    seconds, output = until_policy(launch([*command, *shlex.split(flags)], place), started, policy)
    compiled, units = re.search(r"compiled in ([\d.]+)", output), {"": 1.0, "k": 1e3, "M": 1e6}
    rates = [float(rate) * units[unit] for rate, unit in re.findall(r"([\d.]+) ?(k|M|)/s", output)]
    row = {"algorithm": name, "seed": seed, "seconds": seconds, "policy": policy}
    row |= {"compiled": float(compiled[1]) if compiled else math.nan}
    return row | {"rate": statistics.median(rates) if rates else math.nan}


def summary(rows: list[Row]) -> Row:
    """One algorithm's row of the table; the first of `rows` is the cold one, and a seed's twin."""
    cold, *warm = rows
    middle = medians(warm, ("seconds", "rate", *BAR))
    found = {"algorithm": cold["algorithm"], "cold": cold["seconds"], "compiled": cold["compiled"]}
    found |= {"warm": middle["seconds"], "rate": middle["rate"]}
    found |= {"at_bar": f"{sum(row['at_bar'] for row in warm)} of {len(warm)}"}
    for name in BAR:
        found |= {name: middle[name], f"{name}_worst": max(row[name] for row in warm)}
    return found


def main(given: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("--algorithms", nargs="+", choices=tuple(SHORT), default=list(SHORT))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--flags", nargs="*", default=[], metavar="ALGORITHM=FLAGS", help="further flags of train.py")
    parser.add_argument("--gpu", action="store_true", help="the settings of one GPU")
    options = parser.parse_args(given)
    own = dict(one.split("=", 1) for one in options.flags)
    flags = {name: f"{ON_GPU[name] if options.gpu else ''} {own.get(name, '')}".strip() for name in SHORT}
    found: dict[str, Any] = {"bar": BAR, "flags": flags, "runs": [], "table": []}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name in options.algorithms:
            train(name, 0, f"{flags[name]} {SHORT[name]}", place / "first", place / f"first-{name}")
            rows = []
            for number, seed in enumerate([0, *range(options.seeds)]):
                rows.append(train(name, seed, flags[name], place / f"cache-{name}", place / f"{name}{number}"))
                say(rows[-1])
            evaluate(rows)
            found["runs"] += [row | {"cache": "warm" if number else "cold"} for number, row in enumerate(rows)]
            found["table"].append(summary(rows))
    table(found["table"])
    write(options.json, found)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
