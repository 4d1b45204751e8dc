"""What a follower needs: `transport-large` with one thing changed at a time, five seeds each, evaluated in every cell.

`python benchmarks/ablations.py train --out DIR [--steps N] [--seeds K] [--rows NAME ...]`  (a GPU: a minute a row)
`python benchmarks/ablations.py evaluate --out DIR [--noisy] [--json FILE]`                    (two cores: see --help)

`train` puts the members of each row into DIR/ROW. `evaluate` flies each of them once through the feasible cells of
`benchmarks/cells.py` (mass known) and prints, over the seeds of a row, least - median - most cells in which all four
metrics are wanted, and medians of each metric's count, of the median peak and of the failed flights.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from cells import WANTED, feasible, fly, wanted, wins_of
from mjxball import __version__
from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.cache import enable_compilation_cache
from mjxball.config import Config, preset
from mjxball.evaluate.policies import load_policy
from mjxball.physics.step import TRAINING_ENGINES

BASE = "transport-large"
# What the preset was when the rows were trained; its smoothness and return steps were chosen after them.
THEN = {"reward.smoothness": 0.02, "sac.n_step": 10}
ROWS: dict[str, dict[str, Any]] = {
    "base": {},
    "no-memory": {"follower.observation_averages": ()},
    "four-observations": {"follower.observation_averages": (), "follower.history": 4, "follower.previous_action": True},
    "third-average-1s": {"follower.observation_averages": (0.05, 0.2, 1.0)},
    "direct-action": {"follower.action": "direct"},
    "no-privileged-critic": {"follower.privileged_critic": False},
    "1-step": {"sac.n_step": 1},
    "5-step": {"sac.n_step": 5},
    "critic-layernorm": {"sac.critic_layer_norm": True},
    "2x64": {"sac.policy_layers": (64, 64), "sac.critic_layers": (64, 64)},
    "2x256": {"sac.policy_layers": (256, 256), "sac.critic_layers": (256, 256)},
    "no-randomisation": {
        "scenario.noise": (0.0, 0.0),
        "scenario.delay": (0.0, 0.0),
        "scenario.rotor_lag_scale": (1.0, 1.0),
    },
    "wide-randomisation": {
        "scenario.rotor_lag_scale": (0.5, 2.0),
        "scenario.thrust_scale": (0.8, 1.2),
        "scenario.inertia_scale": (0.6, 1.4),
        "scenario.gust": (0.0, 0.3),
    },
    "error-scale-5cm": {"reward.error_scale": 0.05},
    "speed-free": {"reward.velocity": 0.0},
    "speed-cheap": {"reward.velocity": 2.0},
    "speed-dear": {"reward.velocity": 15.0},
    "no-smoothness": {"reward.smoothness": 0.0},
    "discount-0.985": {"sac.discount": 0.985},
    "discount-0.95": {"sac.discount": 0.95},
    "curriculum": {"sac.curriculum": 0.5},
    "learning-rate-1e-3": {"sac.learning_rate": 1e-3},
}


def settings_of(row: str, steps: int) -> Config:
    """`BASE` as it was THEN, with `steps` and the change of `row`."""
    config = configs.replace(preset(BASE), "sac.total_steps", steps)
    for name, value in {**THEN, **ROWS[row]}.items():
        config = configs.replace(config, name, value)
    return configs.validate(config)


def train(out: Path, rows: list[str], steps: int, seeds: int, physics: str) -> None:
    """Train the members of every row that is not there yet."""
    from mjxball.train.run import Run
    from mjxball.train.run_directory import commit, source_hash, versions

    for row in rows:
        if (out / row).exists():
            continue
        began = time.monotonic()
        origin = {
            "command": f"python benchmarks/ablations.py train --rows {row} --steps {steps} --seeds {seeds}",
            "seed": 0,
            "physics": physics,
            "seeds": seeds,
            "sweep": None,
            "package_version": __version__,
            "commit": commit(),
            "source_hash": source_hash(),
            "versions": versions(),
        }
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            run.mkdir()
            if not Run(settings_of(row, steps), run, origin, None).train():
                raise SystemExit(130)  # Ctrl-C: a row that is not whole is no row
            (run / "members").rename(out / row)
        print(f"{row}: {time.monotonic() - began:.0f} s", flush=True)


def evaluate(out: Path, noisy: bool) -> list[dict[str, Any]]:
    """A row for each trained one."""
    config = preset("paper")
    cells = feasible(config)
    told = fly(make_baseline("lqg", config), cells, {}, False, 1)
    rival = fly(make_baseline("adaptive", config), cells, {}, noisy, 1)
    bars = [wanted(a, b) for a, b in zip(rival, told, strict=True)]
    found = []
    for row in (row for row in ROWS if (out / row).exists()):
        members = []
        for path in sorted((out / row).glob("*.npz")):
            flown = fly(load_policy(path, config), cells, {}, noisy, 1)
            wins = [wins_of(own, bar) for own, bar in zip(flown, bars, strict=True)]
            counts = {key: sum(key in won for won in wins) for key in WANTED}
            members.append(
                {
                    "all four": sum(len(won) == len(WANTED) for won in wins),
                    **counts,
                    "median peak": statistics.median(own["peak"] for own in flown),
                    "failed": sum(own["failed"] for own in flown),
                }
            )
        found.append({"row": row, "changed": ROWS[row], "cells": len(cells), "noisy": noisy, "members": members})
        show(found[-1])
    return found


def show(row: dict[str, Any]) -> None:
    """Print one row."""
    members = row["members"]
    medians = {key: statistics.median(member[key] for member in members) for key in members[0]}
    whole = [member["all four"] for member in members]
    counts = ", ".join(f"{key} {medians[key]:g}" for key in WANTED)
    print(
        f"{row['row']:20s} {len(members)} seeds: all four {min(whole)} - {medians['all four']:g} - {max(whole)} of "
        f"{row['cells']}; {counts}; peak {1e3 * medians['median peak']:.1f} mm; {medians['failed']:g} failed",
        flush=True,
    )


def main() -> None:
    """Train or evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("train", "evaluate"))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="NAME")
    parser.add_argument("--steps", type=int, default=1_024_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--physics", choices=TRAINING_ENGINES, default="newton-euler")
    parser.add_argument("--noisy", action="store_true", help="noise and 40 ms of delay")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    enable_compilation_cache()
    if options.part == "train":
        options.out.mkdir(parents=True, exist_ok=True)
        train(options.out, options.rows, options.steps, options.seeds, options.physics)
        return
    found = evaluate(options.out, options.noisy)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
