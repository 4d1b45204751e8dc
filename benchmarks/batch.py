"""Seconds to fly many random scenarios in one call, metrics included, nothing recorded; compilation left out.

`python benchmarks/batch.py [POLICY.npz] [--flights N] [--seconds S] [--physics ...] [--json FILE]`
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.baselines import make_baseline
from mjxball.config import preset
from mjxball.control.followers import Follower
from mjxball.evaluate.batch import Batch
from mjxball.policy import Policy
from mjxball.sim.scenario import Scenario

SHIPPED = Path(__file__).parents[1] / "policies" / "balance.npz"


def scenarios(count: int, seconds: float) -> list[Scenario]:
    """Random CG motions, masses and goals."""
    random = np.random.default_rng(0)
    drawn = random.uniform(size=(count, 7))
    return [
        Scenario(
            omega=0.31 + 2.8 * w,
            amplitude=0.17 * a,
            mass=0.1 + 0.3 * m,
            phase=2 * np.pi * p,
            goal=(2 * x - 1, 2 * y - 1, 2 * z - 1),
            seconds=seconds,
        )
        for w, a, m, p, x, y, z in map(tuple, drawn.tolist())
    ]


def measure(follower: Follower, flights: list[Scenario], physics: str) -> dict[str, Any]:
    """The second of two equal calls, the first of which compiles."""
    batch = Batch(preset("paper"), follower, physics)
    batch.fly(flights)
    started = time.perf_counter()
    metrics = batch.fly(flights)
    seconds = time.perf_counter() - started
    peaks = [m.rmse for m in metrics if m.rmse is not None]
    failed = sum(m.failed for m in metrics)
    row = {"physics": physics, "follower": follower.name, "flights": len(flights), "seconds": seconds}
    return {**row, "failed": failed, "median rmse": float(np.median(peaks))}


def main() -> None:
    """Measure, print, write."""
    import jax

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", nargs="?", type=Path, default=SHIPPED, metavar="POLICY.npz")
    parser.add_argument("--flights", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--physics", nargs="+", default=["newton-euler", "mjx"], choices=["newton-euler", "mjx"])
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    flights = scenarios(options.flights, options.seconds)
    followers = [Policy.load(options.policy), make_baseline("lqg", preset("paper"))]
    rows = []
    for physics in options.physics:
        for follower in followers:
            rows.append(measure(follower, flights, physics))
            print(
                "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()),
                flush=True,
            )
    device = f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores"
    if options.json:
        options.json.write_text(json.dumps({"device": device, "jax": jax.__version__, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
