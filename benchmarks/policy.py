"""Microseconds per command of a NumPy follower: a policy for a pair, one for any rig, and one without a GRU.

`python benchmarks/policy.py [POLICY.npz ...] [--plant NAME or FILE.toml] [--json FILE]`. One observation at a time, as
in flight (18), and as a batch of one (1 x 18), which the law of arrays answers. A policy that has to be
told its team is told of the first follower of `--plant`, by default the pair.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjxball.cli import plant_setup
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.export import in_team
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import law_of, shipped_policy

SHIPPED = [shipped_policy(name) for name in ("balance", "universal", "flight")]
SHAPES = {"18": (OBSERVATION_SIZE,), "1 x 18": (1, OBSERVATION_SIZE)}
CALLS = 200  # in one repetition
REPETITIONS = 100


def told(contents: PolicyFile, plant: Path) -> PolicyFile:
    """`contents` as the first follower on `plant` flies it, if it has to be told its team."""
    if not law_of(contents.card).geometry:
        return contents
    return in_team(contents, "policy", plant, plant_setup(plant).plant.followers[0])


def microseconds(policies: Sequence[tuple[Policy, tuple[int, ...]]]) -> list[dict[str, float]]:
    """Of every policy, for observations of that shape: median, 95th percentile and smallest of means [us per call].

    A mean is of one repetition. They take turns, so that a machine that others keep busy is as slow for all of them.
    """
    random = np.random.default_rng(1)
    seen = [random.normal(scale=0.3, size=(CALLS, *shape)) for _, shape in policies]
    means: list[list[float]] = [[] for _ in policies]
    for _ in range(REPETITIONS + 3):
        for (policy, _), rows, found in zip(policies, seen, means, strict=True):
            policy.reset()
            start = time.perf_counter()
            for row in rows:
                policy(row)
            found.append((time.perf_counter() - start) / CALLS * 1e6)
    ordered = [sorted(found[3:]) for found in means]  # the first ones warm caches up
    return [
        {"median": statistics.median(found), "p95": found[int(0.95 * len(found))], "least": found[0]}
        for found in ordered
    ]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policies", nargs="*", type=Path, default=SHIPPED, metavar="POLICY.npz")
    parser.add_argument("--plant", type=Path, default=Path("pair"), metavar="NAME", help="or FILE.toml (default pair)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    options = parser.parse_args()
    measured = {"/".join(path.parts[-2:]): told(load_file(path), options.plant) for path in options.policies}
    cases = list(itertools.product(measured.items(), SHAPES.items()))
    times = microseconds([(Policy(contents, name), shape) for (name, contents), (_, shape) in cases])
    rows = []
    for ((name, contents), (label, _)), found in zip(cases, times, strict=True):
        layers = " x ".join(str(bias.size) for bias in contents.biases[:-1])
        rows.append({"policy": name, "layers": layers, "observation": label, **found})
    print(f"{'policy':>24}{'layers':>12}{'observation':>14}{'median us':>12}{'p95 us':>10}{'least us':>10}")
    for row in rows:
        print(f"{row['policy']:>24}{row['layers']:>12}{row['observation']:>14}", end="")
        print(f"{row['median']:12.1f}{row['p95']:10.1f}{row['least']:10.1f}")
    if options.json:
        options.json.write_text(json.dumps({"numpy": np.__version__, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
