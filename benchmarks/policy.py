"""Microseconds per command of a NumPy follower: the shipped 2 x 64 network and a random 2 x 256 one.

`python benchmarks/policy.py [POLICY.npz] [--json FILE]`. One observation at a time, as in flight.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import statistics
import time
from pathlib import Path

import numpy as np

from mjxball.control.observation import ACTION_SIZE, OBSERVATION_SIZE
from mjxball.policy import Policy, PolicyFile, load_file

SHIPPED = Path(__file__).parents[1] / "policies" / "balance.npz"
CALLS = 200  # in one repetition
REPETITIONS = 100


def widened(contents: PolicyFile, width: int) -> PolicyFile:
    """The same file with two random hidden layers of `width` units."""
    draw = np.random.default_rng(0)
    sizes = (contents.observation_mean.size, width, width, 2 * ACTION_SIZE)
    shapes = list(itertools.pairwise(sizes))
    weights = tuple((draw.normal(size=shape) / np.sqrt(shape[0])).astype(np.float32) for shape in shapes)
    biases = tuple(np.zeros(shape[1], np.float32) for shape in shapes)
    return dataclasses.replace(contents, weights=weights, biases=biases)


def microseconds(policy: Policy) -> dict[str, float]:
    """Median, 95th percentile and smallest of the repetitions' means [us per call]."""
    seen = np.random.default_rng(1).normal(scale=0.3, size=(CALLS, OBSERVATION_SIZE))
    means = []
    for _ in range(REPETITIONS + 3):
        policy.reset()
        start = time.perf_counter()
        for row in seen:
            policy(row)
        means.append((time.perf_counter() - start) / CALLS * 1e6)
    means = sorted(means[3:])  # the first ones warm caches up
    return {"median": statistics.median(means), "p95": means[int(0.95 * len(means))], "least": means[0]}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", nargs="?", type=Path, default=SHIPPED, metavar="POLICY.npz")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    options = parser.parse_args()
    shipped = load_file(options.policy)
    rows = []
    for name, contents in ((options.policy.stem, shipped), ("random", widened(shipped, 256))):
        layers = " x ".join(str(bias.size) for bias in contents.biases[:-1])
        rows.append({"policy": name, "layers": layers, **microseconds(Policy(contents, name))})
    print(f"{'policy':>12}{'layers':>12}{'median us':>12}{'p95 us':>10}{'least us':>10}")
    for row in rows:
        print(f"{row['policy']:>12}{row['layers']:>12}{row['median']:12.1f}{row['p95']:10.1f}{row['least']:10.1f}")
    if options.json:
        options.json.write_text(json.dumps({"numpy": np.__version__, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
