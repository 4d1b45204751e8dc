"""The gains of `observer`, `pid` or `mpc`: a search on flights that no table reports.

`python benchmarks/observer_tuning.py [observer|pid|mpc] [--rounds N] [--sets N] [--width W] [--json FILE]`

Covariance matrix adaptation (CMA-ES, Hansen) over the logarithms of the gains. It goes on from those that the law has,
so it says whether better ones are near; how these were found stands beside the law. All flights are
flown undisturbed and with noise at level 1 and 40 ms of delay; what is made small is the sum over both.

- `observer`: 48 random feasible flights of known mass; the mean settling time, at most 30 s, and the mean peak over
  5 mm, at most 20
- `pid`, `mpc`: flights from rest of known mass and, for three in ten, of one that is believed to be 0.2 kg, 25 s each;
  besides 30 times the overshoot (of `pid` beyond 4 %) and 5 times the RMSE; 20 flights
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.baselines import Mpc, Observer, Pid
from mjxball.baselines.mpc_design import MpcTuning
from mjxball.config import Config, preset
from mjxball.control.followers import Baseline
from mjxball.evaluate.batch import Batch
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario
from stability import peak, random_scenarios

FLIGHTS, SETS, ROUNDS, SEED, WIDTH = 48, 24, 80, 1007, 0.3
CONDITIONS = (Disturbance(), Disturbance(noise=1.0, delay=0.04, seed=SEED))
TUNED: dict[str, Any] = {"observer": Observer, "pid": Pid, "mpc": Mpc}
KNOWN, UNKNOWN, SECONDS, CORES = 14, 6, 25.0, 2  # flights of `pid` and `mpc`
ALLOWED = {"pid": 0.04, "mpc": 0.0}  # overshoot that costs nothing


def from_rest(config: Config) -> list[Scenario]:
    """The flights of `pid` and `mpc`: goals 0.7 to 1.1 m away along every axis."""
    drawn = [
        *random_scenarios(config, KNOWN, False, SEED),
        *random_scenarios(config, UNKNOWN, True, SEED),
    ]
    still, random, found = Scenario(), np.random.default_rng(SEED), []
    for one in drawn:
        goal = random.uniform(0.7, 1.1, 3) * random.choice([-1.0, 1.0], 3)
        start = {name: getattr(still, name) for name in ("start_position", "start_velocity", "start_tilt")}
        found.append(dataclasses.replace(one, goal=tuple(map(float, goal)), seconds=SECONDS, **start))
    return found


def costs_of(
    law: Any, drawn: list[Scenario], sets: int, allowed: float | None
) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """(cost (S,), medians (S,) under each condition) of `law`, which flies all `drawn` with each of `sets`."""
    config = preset("paper")
    batch, total, shown = Batch(config, Baseline(law, config)), np.zeros(sets), []
    flights = [dataclasses.replace(one, disturbance=condition) for condition in CONDITIONS for one in drawn * sets]
    flown = batch.fly(flights)
    for runs in (flown[: len(flights) // 2], flown[len(flights) // 2 :]):
        settling = np.array([run.settling_time or math.inf for run in runs]).reshape(sets, -1)
        high = 1e3 * np.array([peak(run) for run in runs]).reshape(sets, -1)
        parts = np.minimum(settling, 30.0) + np.minimum(high / 5, 20.0)
        if allowed is not None:
            over = np.array([1.0 if run.failed else min(max(run.overshoot - allowed, 0.0), 1.0) for run in runs])
            rmse = np.array([3.0 if run.failed else min(run.rmse, 3.0) for run in runs])
            parts = parts + (30.0 * over + 5.0 * rmse).reshape(sets, -1)
        total += parts.mean(axis=1)
        shown.append({"settling": np.median(settling, axis=1), "peak": np.median(high, axis=1)})
    return total, shown


def costs(law: Any, sets: np.ndarray) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """`costs_of` all `sets` (S, k) of gains of `observer` or `pid`, flown at once."""
    config, allowed = preset("paper"), ALLOWED.get(law.name)
    drawn = from_rest(config) if allowed is not None else random_scenarios(config, FLIGHTS, False, SEED)
    each = np.tile(np.repeat(sets, len(drawn), axis=0), (len(CONDITIONS), 1))
    gains = type(law.gains)(*each.astype(np.float32).T)
    return costs_of(type("Tuned", (law,), {"gains": gains})(config), drawn, len(sets), allowed)


def costs_of_mpc(values: np.ndarray) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """`costs_of` `mpc` with the tuning `values` (k,)."""
    config = preset("paper")
    law = type("Tuned", (Mpc,), {"tuning": MpcTuning(*map(float, values))})(config)
    return costs_of(law, from_rest(config), 1, ALLOWED[law.name])


def minimise(
    cost: Callable[[np.ndarray], np.ndarray], start: np.ndarray, width: float, sets: int, rounds: int
) -> tuple[np.ndarray, float]:
    """(point (k,), its cost) where `cost` of points (S, k) is least, found by CMA-ES about `start` (k,)."""
    k, random = len(start), np.random.default_rng(SEED)
    weights = np.log(sets / 2 + 0.5) - np.log(np.arange(1, sets // 2 + 1))
    weights /= weights.sum()
    mu = 1 / (weights**2).sum()
    c_path, c_width = (4 + mu / k) / (k + 4 + 2 * mu / k), (mu + 2) / (k + mu + 5)
    c_one = 2 / ((k + 1.3) ** 2 + mu)
    c_mu = min(1 - c_one, 2 * (mu - 2 + 1 / mu) / ((k + 2) ** 2 + mu))
    damping = 1 + 2 * max(0.0, math.sqrt((mu - 1) / (k + 1)) - 1) + c_width
    length = math.sqrt(k) * (1 - 1 / (4 * k) + 1 / (21 * k * k))
    mean, covariance, path, width_path = start.copy(), np.eye(k), np.zeros(k), np.zeros(k)
    best, least = start, math.inf
    for number in range(rounds):
        values, axes = np.linalg.eigh(covariance)
        root = axes * np.sqrt(np.maximum(values, 1e-20))
        steps = random.standard_normal((sets, k)) @ root.T
        found = cost(mean + width * steps)
        order = np.argsort(found)
        if found[order[0]] < least:
            best, least = mean + width * steps[order[0]], float(found[order[0]])
        step = weights @ steps[order[: len(weights)]]
        mean = mean + width * step
        white = axes @ ((axes.T @ step) / np.sqrt(np.maximum(values, 1e-20)))
        width_path = (1 - c_width) * width_path + math.sqrt(c_width * (2 - c_width) * mu) * white
        path = (1 - c_path) * path + math.sqrt(c_path * (2 - c_path) * mu) * step
        chosen = steps[order[: len(weights)]]
        covariance = (1 - c_one - c_mu) * covariance + c_one * np.outer(path, path)
        covariance += c_mu * (chosen.T * weights) @ chosen
        width *= math.exp(c_width / damping * (np.linalg.norm(width_path) / length - 1))
        print(f"round {number + 1}: {least:.3f} {np.exp(best).round(3).tolist()} width {width:.3f}", flush=True)
    return best, least


def main() -> None:
    """Search, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("law", nargs="?", choices=TUNED, default="observer")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--width", type=float, default=WIDTH, help="of the first steps, in the logarithm")
    parser.add_argument("--sets", type=int, default=SETS, help="of gains in each round")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    law = TUNED[options.law]
    given = law.tuning if law is Mpc else law.gains
    start = np.log(np.array(given, float))
    if law is Mpc:
        with ProcessPoolExecutor(CORES, multiprocessing.get_context("spawn")) as pool:
            each = lambda sets: np.array([cost[0] for cost, _ in pool.map(costs_of_mpc, np.exp(sets))])  # noqa: E731
            best, least = minimise(each, start, options.width, options.sets, options.rounds)
        shown = costs_of_mpc(np.exp(best))[1]
    else:
        best, least = minimise(
            lambda sets: costs(law, np.exp(sets))[0], start, options.width, options.sets, options.rounds
        )
        shown = costs(law, np.exp([best]))[1]
    gains = dict(zip(given._fields, np.exp(best).tolist(), strict=True))
    medians = [{key: round(float(np.ravel(value)[0]), 3) for key, value in one.items()} for one in shown]
    found = {"law": options.law, "gains": gains, "cost": least, "medians": medians}
    print(json.dumps(found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
