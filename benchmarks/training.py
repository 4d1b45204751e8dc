"""Seconds from process start to a policy at the quality bar: `train.py` beside stock Brax SAC; populations.

`python benchmarks/training.py [--parts ours stock population scaling distributed] [--seeds K] [--json FILE] ...`

- `ours`: `train.py transport` with the settings below, seed 0 with an empty compilation cache (cold), then every seed
  with that cache (warm). The clock starts before the process and stops when its policy file is written.
- `stock`: Brax's `sac.train` on the same environment (`benchmarks/stock_sac.py`), timed the same way: seed 0 cold,
  then the other seeds with its cache, `--together` of them at once, which gives their quality but not their time. Its
  policies at each of `--snapshots` parts of the way are evaluated, so that it may reach the bar before its end.
  Before the first of the two each is run once for a moment, without a cache and uncounted: a fresh machine reads the
  libraries from its disk only once, which would else be charged to whoever comes first.
- `population`: training rate of 1 and of `--members` followers in one program, compilation left out, and memory.
- `scaling`: training rate of a population on 1, 2, 4, ... of the GPUs here, with the members on one GPU kept the same
  (weak) and with their total kept the same (strong).
- `distributed`: the rate of `train.py --distributed` over `--processes` processes with one GPU each.

The bar: on the reference scenario (CG 0.05 m at 0.31 rad/s, 0.2 kg, goal 1 1 1 m, 45 s) x-peak <= 0.02 m, settling
<= 3.5 s, RMSE <= 0.35 m, each as the median over the seeds.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import platform
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
BAR = {"x_peak": 0.02, "settling_time": 3.5, "rmse": 0.35}
PATIENCE = 900  # [s] for one training
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
    command = ["benchmarks/stock_sac.py", out, "--seed", seed, "--physics", options.physics]
    command += ["--snapshots", options.snapshots, *options.stock]
    command += ["--steps", steps, "--snapshots", 1] if steps else []  # the last one said counts
    return [str(word) for word in command]


def ours(options: argparse.Namespace, place: Path) -> list[dict[str, Any]]:
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
        row["seconds"] = seconds
        row |= {"compiled": float(re.search(r"compiled in ([\d.]+)", output)[1]), "host_mb": int(found[1])}
        row |= {"device_mb": int(found[2] or 0), "saving": float(found[3]) / float(found[4])}
        rows.append(row | {"policy": out / "policy.npz"})
        say(rows[-1])
    return rows


def stock(options: argparse.Namespace, place: Path) -> list[dict[str, Any]]:
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


def evaluate(rows: list[dict[str, Any]]) -> None:
    """Add the metrics of the reference scenario to every row."""
    from mjxball.config import preset
    from mjxball.evaluate.policies import load_policy
    from mjxball.evaluate.results import fly_scenarios
    from mjxball.evaluate.scenarios import REFERENCE

    settings = preset("transport")
    policies = [load_policy(row["policy"], settings) for row in rows]
    for row, cell in zip(rows, fly_scenarios(settings, policies, [REFERENCE], "newton-euler"), strict=True):
        record = cell.record()
        row |= {name: record[name] for name in BAR}
        row["policy"] = row["policy"].name
        say(row)


def summary(rows: list[dict[str, Any]], trainer: str) -> list[dict[str, Any]]:
    """Of one trainer, for each number of steps: times, and medians of the metrics over the seeds."""
    mine, found = [row for row in rows if row["trainer"] == trainer], []
    for steps in sorted({row["steps"] for row in mine}):
        there = [row for row in mine if row["steps"] == steps]
        runs = there[1:] if trainer == "ours" else there  # the cold run of seed 0 is the warm one's twin
        medians = {
            name: statistics.median(math.inf if row[name] is None else row[name] for row in runs) for name in BAR
        }
        warm = [row["seconds"] for row in there if row["cache"] == "warm"]
        times = {"cold": there[0]["seconds"], "warm": statistics.median(warm) if warm else None}
        reached = all(medians[name] <= bar for name, bar in BAR.items())
        found.append({"steps": steps, **times, **medians, "at the bar": reached})
    return found


def speed_up(summaries: dict[str, list[dict[str, Any]]]) -> tuple[float | None, str]:
    """How many times sooner than stock ours is at the bar, both cold, and that in words."""
    (mine,), theirs = summaries["ours"], summaries["stock"]
    if not mine["at the bar"]:
        return None, "ours is not at the bar: no ratio"
    there = [row for row in theirs if row["at the bar"]]
    ratio = (there[0] if there else theirs[-1])["cold"] / mine["cold"]
    return ratio, f"stock cold / ours cold: {ratio:.2f}" + ("" if there else " at least: stock never reaches the bar")


def rate_of(members: int, devices: list[Any], options: argparse.Namespace) -> dict[str, Any]:
    """Environment steps per second of `members` followers on `devices` with updates, and peak memory."""
    import jax

    from mjxball.config import preset
    from mjxball.train import program as programs
    from mjxball.train.population import Population

    population = Population(preset("transport"), options.physics, members, devices=devices)
    compiled = population.compile(creating=True)
    state = population.start(compiled, 0)
    state, *_ = compiled.advance(state, programs.warmup(100))
    steps, rates = options.chunk, []
    for _ in range(4):
        started = time.perf_counter()
        state, *_ = compiled.advance(state, programs.train(steps))
        jax.block_until_ready(state)
        rates.append(members * population.config.sac.num_envs * steps / (time.perf_counter() - started))
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / members
    stats = devices[0].memory_stats() or {}
    return {
        "members": members,
        "devices": population.devices,
        "rate": statistics.median(rates[1:]),
        "state_mb_per_member": held / 1e6,
        "peak_mb_per_device": stats.get("peak_bytes_in_use", 0) / 1e6,
    }


def population(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rates of one follower and of many, on one device."""
    import jax

    rows = [rate_of(members, jax.local_devices()[:1], options) for members in (1, *options.members)]
    for row in rows:
        row["cost_per_member"] = rows[0]["rate"] / row["rate"]  # of training one alone
        say(row)
    return rows


def scaling(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rates of populations over several devices of this process, then over processes with one GPU each."""
    import jax

    devices, rows = jax.local_devices(), []
    most = options.members[-1]
    counts = [count for count in (1, 2, 4, 8) if count <= len(devices)]
    for count in counts:
        for members in sorted({most * count, most * counts[-1]}):
            rows.append(rate_of(members, devices[:count], options))
            say(rows[-1])
    return rows


def distributed(options: argparse.Namespace, place: Path, count: int) -> dict[str, Any]:
    """Rate of `train.py --distributed` over `count` processes with one GPU each: the median row of metrics.csv."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    out, members = place / f"distributed{count}", options.members[-1] * count
    command = ["train.py", "--out", str(out), "--physics", options.physics, "--seeds", str(members)]
    command += ["--sac.total_steps", str(options.chunk * 128 * 4), "--sac.num_evaluations", "1"]
    command += ["--distributed", "--coordinator", f"127.0.0.1:{port}", "--processes", str(count)]
    children = [
        launch([*command, "--process", str(k)], place / f"cache{k}", CUDA_VISIBLE_DEVICES=str(k)) for k in range(count)
    ]
    until_policy(children[0], time.time(), out / "policy.npz")
    for child in children[1:]:
        child.communicate(timeout=PATIENCE)
    with (out / "metrics.csv").open(newline="") as stream:
        rates = [float(row["rate"]) for row in csv.DictReader(stream)]
    row = {"members": members, "processes": count, "rate": statistics.median(rates[2:])}
    say(row)
    return row


def say(row: dict[str, Any]) -> None:
    """Print a row as it is measured."""
    shown = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items() if k != "policy"}
    print("  ".join(f"{k} {v}" for k, v in shown.items()), flush=True)


def _finite(value: Any) -> Any:
    """`value` with None for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def versions() -> dict[str, Any]:
    """Machine and libraries, for the JSON file."""
    import jax

    return {
        "device": f"{jax.local_device_count()} x {jax.devices()[0].device_kind}",
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("ours", "stock", "population", "scaling", "distributed")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts[:3])
    parser.add_argument("--physics", default="mjx", choices=("mjx", "newton-euler"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=320_000, help="environment steps of a run of train.py")
    parser.add_argument("--learning-rate", type=float, default=3e-3)
    parser.add_argument("--num-envs", "--worlds", dest="worlds", metavar="N", type=int, default=128)
    parser.add_argument("--updates-per-step", "--updates", dest="updates", metavar="N", type=int, default=4)
    parser.add_argument("--batch-size", "--batch", dest="batch", metavar="N", type=int, default=256)
    parser.add_argument("--tau", type=float, default=0.02)
    parser.add_argument("--snapshots", type=int, default=1, help="policies of each stock run that are evaluated")
    parser.add_argument("--stock", nargs=argparse.REMAINDER, default=[], help="flags for stock_sac.py; must come last")
    parser.add_argument("--together", type=int, default=4, help="stock runs at once, after the first")
    parser.add_argument("--members", type=int, nargs="+", default=[64], help="followers at once")
    parser.add_argument("--chunk", type=int, default=500, help="control steps of one measurement")
    parser.add_argument("--processes", type=int, nargs="+", default=[2, 4], help="for the part `distributed`")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    found: dict[str, Any] = {"bar": BAR, "settings": {k: v for k, v in vars(options).items() if k != "json"}}
    with tempfile.TemporaryDirectory() as name:
        place, rows = Path(name), []
        # Children first: a process that holds the GPU would keep most of its memory from them.
        read_libraries(options, place)
        for part, measure in (("ours", ours), ("stock", stock)):
            if part in options.parts:
                rows += measure(options, place)
        if "distributed" in options.parts:
            found["distributed"] = [distributed(options, place, count) for count in options.processes]
        if rows:
            evaluate(rows)
            found["runs"] = rows
            found["summary"] = {t: summary(rows, t) for t in ("ours", "stock") if t in options.parts}
    for part, measure in (("population", population), ("scaling", scaling)):
        if part in options.parts:
            found[part] = measure(options)
    found["versions"] = versions()
    for trainer, lines in found.get("summary", {}).items():
        for line in lines:
            print(f"{trainer}: ", end="")
            say(line)
    if {"ours", "stock"} <= set(options.parts):
        found["speed-up"], words = speed_up(found["summary"])
        print(words)
    if options.json:
        options.json.write_text(json.dumps(_finite(found), indent=2, default=str, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
