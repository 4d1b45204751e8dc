"""Seconds from process start to a policy at the quality bar: `train.py` beside stock Brax SAC.

- `ours`: `train.py transport` with the settings below, seed 0 with an empty compilation cache (cold), then every seed
  with that cache (warm). The clock starts before the process and stops when its policy file is written.
- `stock`: Brax's `sac.train` on the same environment (`benchmarks/foreign_trainers.py brax-sac`), timed the same way:
  seed 0 cold, then the other seeds with its cache, `--together` of them at once, which gives their quality but not
  their time. Its policies at each of `--snapshots` parts of the way are evaluated, so that it may reach the bar before
  its end.
  Before the first of the two each is run once for a moment, without a cache and uncounted: a fresh machine reads the
  libraries from its disk only once, which would else be charged to whoever comes first.

The bar: on the reference scenario (CG 0.05 m at 0.31 rad/s, 0.2 kg, goal 1 1 1 m, 45 s) x-peak <= 0.02 m, settling
<= 3.5 s, RMSE <= 0.35 m, each as the median over the seeds.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness import ROOT, Row, arguments, medians, say, table, write
from mjxball.running import run_command

BAR = {"x_peak": 0.02, "settling_time": 3.5, "rmse": 0.35}
NO_CACHE = Path("off")  # what MJXBALL_CACHE takes for none


def launch(command: list[str], cache: Path, **environment: str) -> subprocess.Popen[str]:
    """Start a training process with its own compilation cache."""
    return subprocess.Popen(
        [sys.executable, *command],
        cwd=ROOT,
        env={**os.environ, "MJXBALL_CACHE": str(cache), "PYTHONUNBUFFERED": "1", **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def until_policy(child: subprocess.Popen[str], started: float, policy: Path) -> tuple[float, str]:
    """(seconds from `started` until `policy` was written last, output); `child` is ended when it says so."""
    lines = []
    for line in child.stdout or ():
        lines.append(line)
        if line.startswith("policy:"):
            child.kill()
            child.wait()
            return policy.stat().st_mtime - started, "".join(lines)
    raise RuntimeError(f"training failed with code {child.wait()}:\n{''.join(lines)[-3000:]}")


def read_libraries(options: argparse.Namespace, place: Path) -> None:
    """Run the trainers for a moment, so that no counted run is the first to read their libraries from the disk."""
    from mjxball.config import preset

    short = 2 * preset("transport").sac.warmup_steps
    out, policy = place / "first", place / "first.npz"
    firsts = {
        "ours": (our_command(options, 0, out, short), out / "policy.npz"),
        "stock": (stock_command(options, 0, policy, short), policy),
    }
    for trainer, (command, written) in firsts.items():
        if trainer in options.parts:
            started = time.time()
            seconds, _ = until_policy(launch(command, NO_CACHE), started, written)
            print(f"{trainer} for a moment, not counted: {seconds:.1f} s", flush=True)


def our_command(options: argparse.Namespace, seed: int, out: Path, steps: int) -> list[str]:
    """`train.py` with the settings to be measured."""
    replay = math.ceil(steps / options.worlds) * options.worlds
    flags = ["--sac.total_steps", steps, "--sac.replay_size", replay, "--sac.num_evaluations", 1]
    flags += ["--sac.learning_rate", options.learning_rate, "--sac.num_envs", options.worlds]
    flags += ["--sac.updates_per_step", options.updates, "--sac.batch_size", options.batch, "--sac.tau", options.tau]
    command = ["train.py", "transport", "--seed", seed, "--out", out, "--physics", options.physics, *flags]
    return [str(word) for word in command]


def stock_command(options: argparse.Namespace, seed: int, out: Path, steps: int | None = None) -> list[str]:
    """Stock SAC with the settings to be measured, for `steps` if given."""
    command = ["benchmarks/foreign_trainers.py", "brax-sac", out, "--seed", seed, "--physics", options.physics]
    command += ["--snapshots", options.snapshots, *options.stock]
    command += ["--steps", steps, "--snapshots", 1] if steps else []  # the last one said counts
    return [str(word) for word in command]


def ours(options: argparse.Namespace, place: Path) -> list[Row]:
    """One row for each run of `train.py`."""
    rows = []
    for number, seed in enumerate([0, *range(options.seeds)]):
        out = place / f"ours{number}"
        command = our_command(options, seed, out, options.steps)
        started = time.time()
        seconds, output = until_policy(launch(command, place / "cache"), started, out / "policy.npz")
        found = re.search(
            r"peak memory (\d+) MB(?:, (\d+) MB on each device)?; saving took ([\d.]+) of ([\d.]+)", output
        )
        row = {"trainer": "ours", "cache": "cold" if number == 0 else "warm", "seed": seed, "steps": options.steps}
        row |= {"seconds": seconds, "compiled": float(re.search(r"compiled in ([\d.]+)", output)[1])}
        row |= {"host_mb": int(found[1]), "device_mb": int(found[2] or 0), "saving": float(found[3]) / float(found[4])}
        rows.append(row | {"policy": out / "policy.npz"})
        say(rows[-1])
    return rows


def stock(options: argparse.Namespace, place: Path) -> list[Row]:
    """One row for each run of Brax's own SAC."""
    rows, seeds = [], list(range(options.seeds))
    groups = [seeds[:1]] + [seeds[k : k + options.together] for k in range(1, len(seeds), options.together)]
    for group in groups:
        started, children = time.time(), []
        for seed in group:
            command = stock_command(options, seed, place / f"stock{seed}.npz")
            children.append(launch(command, place / "stock", XLA_PYTHON_CLIENT_PREALLOCATE="false"))
        for seed, child in zip(group, children, strict=True):
            until_policy(child, started, place / f"stock{seed}.npz")
            for path in sorted(place.glob(f"stock{seed}-*.npz"), key=_steps_of):
                row = {"trainer": "stock", "cache": "cold" if seed == 0 else "shared", "seed": seed}
                row |= {"steps": _steps_of(path), "seconds": path.stat().st_mtime - started, "policy": path}
                rows.append(row)
                say(row)
    return rows


def _steps_of(snapshot: Path) -> int:
    return int(snapshot.stem.rpartition("-")[2])


def evaluate(rows: list[Row]) -> None:
    """Add the metrics of the reference scenario, and whether they are at the bar, to every row."""
    from mjxball.config import preset
    from mjxball.evaluate.policies import load_policy
    from mjxball.evaluate.results import fly_scenarios
    from mjxball.evaluate.scenarios import REFERENCE

    settings = preset("transport")
    policies = [load_policy(row["policy"], settings) for row in rows]
    for row, cell in zip(rows, fly_scenarios(settings, policies, [REFERENCE], "newton-euler"), strict=True):
        record = cell.record()
        row |= {name: math.inf if record[name] is None or record["failed"] else record[name] for name in BAR}
        row |= {"at_bar": all(row[name] <= bar for name, bar in BAR.items()), "policy": row["policy"].name}


def summary(rows: list[Row], trainer: str) -> list[Row]:
    """Of one trainer, for each number of steps: times, and medians of the metrics over the seeds."""
    mine, found = [row for row in rows if row["trainer"] == trainer], []
    for steps in sorted({row["steps"] for row in mine}):
        there = [row for row in mine if row["steps"] == steps]
        middle = medians(there[1:] if trainer == "ours" else there, BAR)  # the cold run of seed 0 is a warm one's twin
        warm = [row for row in there if row["cache"] == "warm"]
        row = {"trainer": trainer, "steps": steps, "cold": there[0]["seconds"]}
        row |= {"warm": medians(warm, ["seconds"])["seconds"] if warm else None}
        found.append({**row, **middle, "at the bar": all(middle[name] <= bar for name, bar in BAR.items())})
    return found


def main(given: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("--parts", nargs="+", choices=("ours", "stock"), default=("ours", "stock"))
    parser.add_argument("--physics", default="mjx", choices=("mjx", "newton-euler"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=320_000, help="environment steps of a run of train.py")
    parser.add_argument("--learning-rate", type=float, default=3e-3)
    parser.add_argument("--num-envs", "--worlds", dest="worlds", metavar="N", type=int, default=128)
    parser.add_argument("--updates-per-step", "--updates", dest="updates", metavar="N", type=int, default=4)
    parser.add_argument("--batch-size", "--batch", dest="batch", metavar="N", type=int, default=256)
    parser.add_argument("--tau", type=float, default=0.02)
    parser.add_argument("--snapshots", type=int, default=1, help="policies of each stock run that are evaluated")
    parser.add_argument("--stock", nargs=argparse.REMAINDER, default=[], help="flags for brax-sac; must come last")
    parser.add_argument("--together", type=int, default=4, help="stock runs at once, after the first")
    options = parser.parse_args(given)
    found: dict[str, Any] = {"bar": BAR, "settings": {k: v for k, v in vars(options).items() if k != "json"}}
    with tempfile.TemporaryDirectory() as name:
        place, rows = Path(name), []
        read_libraries(options, place)
        for part, measure in (("ours", ours), ("stock", stock)):
            rows += measure(options, place) if part in options.parts else []
        evaluate(rows)
    found |= {"runs": rows, "summary": [line for part in options.parts for line in summary(rows, part)]}
    table(rows, ("trainer", "cache", "seed", "steps", "seconds", *BAR, "at_bar"))
    table(found["summary"])
    write(options.json, found)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
