"""Cell by cell against the classical followers: who beats `adaptive`, and whose commands suit motors?

`python benchmarks/rivals.py [POLICY.npz ...] [--json FILE]`    (by default balance, transport, robust and paper)

The 70 feasible cells of `benchmarks/cells.py`, mass known, phase 0, undisturbed and with noise at level 1 and 40 ms of
delay. Of each follower: in how many cells it is strictly better than `adaptive` in peak, overshoot, settling and RMSE;
medians and largest over the cells of the rms change of its roll and pitch commands from step to step and of the share
of time that its rotors are at a limit; and in how many cells neither is above LQG's. Who fails or never settles counts
as infinitely bad.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from pathlib import Path
from typing import Any

from cells import WANTED, feasible, numbers_of
from mjxball.baselines import make_baseline
from mjxball.config import preset
from mjxball.control.followers import Follower
from mjxball.evaluate.batch import Batch
from mjxball.evaluate.policies import load_policy
from mjxball.policy.file import shipped_policy
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario

CLASSICAL = ("lqg", "lqg-slow", "adaptive", "copy")
TOLD = CLASSICAL[:2]
SHIPPED = ("balance", "transport", "robust", "paper")
COMMANDS = ("smoothness", "saturation")
ROUNDED = 1e-6  # float32: what two followers' numbers may differ by and be called equal


def fly(follower: Follower, cells: list[Any], disturbed: bool) -> list[dict[str, float]]:
    """What each cell is evaluated by."""
    disturbance = Disturbance(noise=1.0, delay=0.04, seed=0) if disturbed else Disturbance()
    scenarios = [Scenario(omega=w, amplitude=a, mass=m, disturbance=disturbance) for w, a, m in cells]
    rows = []
    for run in Batch(preset("paper"), follower).fly(scenarios):
        found = {**numbers_of(run), "smoothness": run.smoothness, "saturation": run.saturation}
        rows.append(dict.fromkeys(found, math.inf) if run.failed else found)
    return rows


def summary(name: str, mine: list[Any], rivals: dict[str, list[Any]]) -> dict[str, Any]:
    """One row of the table."""
    row: dict[str, Any] = {"follower": name, "cells": len(mine)}
    for key in WANTED:
        beaten = (own[key] < other[key] - ROUNDED for own, other in zip(mine, rivals["adaptive"], strict=True))
        row[f"beats adaptive in {key}"] = sum(beaten)
    row["peak, median"] = statistics.median(own["peak"] for own in mine)
    row["failed"] = sum(math.isinf(own["rmse"]) for own in mine)
    row["settling, median"] = statistics.median(own["settling"] for own in mine)
    for key in COMMANDS:
        row[f"{key}, median"] = statistics.median(own[key] for own in mine)
        row[f"{key}, largest"] = max(own[key] for own in mine)
        for rival in TOLD:
            less = (own[key] <= told[key] + ROUNDED for own, told in zip(mine, rivals[rival], strict=True))
            row[f"no more {key} than {rival}"] = sum(less)
    return row


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", type=Path, nargs="*")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    config, found = preset("paper"), []
    cells = feasible(config)
    paths = options.policies or [shipped_policy(name) for name in SHIPPED]
    policies = [load_policy(path, config) for path in paths]
    for disturbed in (False, True):
        rivals = {name: fly(make_baseline(name, config), cells, disturbed) for name in CLASSICAL}
        flown = {**rivals, **{policy.name: fly(policy, cells, disturbed) for policy in policies}}
        where = "noise and 40 ms" if disturbed else "undisturbed"
        for name, mine in flown.items():
            row = {"where": where, **summary(name, mine, rivals)}
            found.append({key: None if value == math.inf else value for key, value in row.items()})
            shown = (f"{key} {value:.4g}" for key, value in row.items() if key not in ("where", "follower"))
            print(f"{where}, {name}: " + "; ".join(shown), flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
