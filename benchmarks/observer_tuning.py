"""The gains of `observer`: a random search that narrows, on flights that no table reports.

`python benchmarks/observer_tuning.py [--json FILE]`

48 random feasible flights of known mass, undisturbed and with noise at level 1 and 40 ms of delay. What is made small
is the sum over both of the mean settling time, at most 30 s, and the mean peak over 5 mm, at most 20.
Each round draws 96 sets of gains about the best twelve of the rounds before, even in the logarithm.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from pathlib import Path

import numpy as np

from mjxball.baselines.observer import Observer, ObserverGains
from mjxball.config import preset
from mjxball.control.followers import Baseline
from mjxball.evaluate.batch import Batch
from mjxball.sim.disturbances import Disturbance
from stability import peak, random_scenarios

FLIGHTS, SETS, BEST, ROUNDS, SEED = 48, 96, 12, 9, 1007
CONDITIONS = (Disturbance(), Disturbance(noise=1.0, delay=0.04, seed=SEED))
START = (0.645, 0.479, 0.145, 2.63, 2.71, 13.7, 5.5)  # a shorter search's, which began with round numbers


def costs(sets: np.ndarray) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """(cost (S,), medians (S,) under each condition) of all `sets` (S, 7) of gains."""
    config = preset("paper")
    gains = ObserverGains(*np.repeat(sets, FLIGHTS, axis=0).astype(np.float32).T)
    law = type("Tuned", (Observer,), {"gains": gains})(config)
    total, shown, drawn = np.zeros(len(sets)), [], random_scenarios(config, FLIGHTS, False, SEED)
    batch = Batch(config, Baseline(law, config))
    for condition in CONDITIONS:
        flown = batch.fly([dataclasses.replace(one, disturbance=condition) for one in drawn] * len(sets))
        settling = np.array([run.settling_time or math.inf for run in flown]).reshape(len(sets), FLIGHTS)
        high = 1e3 * np.array([peak(run) for run in flown]).reshape(len(sets), FLIGHTS)
        total += np.minimum(settling, 30.0).mean(axis=1) + np.minimum(high / 5, 20.0).mean(axis=1)
        shown.append({"settling": np.median(settling, axis=1), "peak": np.median(high, axis=1)})
    return total, shown


def main() -> None:
    """Search, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    random, centre = np.random.default_rng(SEED), np.log(START)
    width, kept = np.full(len(centre), 0.8), np.zeros((0, len(centre) + 1))
    for number in range(ROUNDS):
        sets = centre + width * random.standard_normal((SETS, len(centre)))
        kept = np.concatenate([kept, np.column_stack([costs(np.exp(sets))[0], sets])])
        kept = kept[np.argsort(kept[:, 0])][:BEST]
        centre, width = kept[:, 1:].mean(axis=0), np.maximum(kept[:, 1:].std(axis=0), 0.03)
        print(f"round {number + 1}: {kept[0, 0]:.3f} {np.exp(kept[0, 1:]).round(3).tolist()}", flush=True)
    gains = dict(zip(ObserverGains._fields, np.exp(kept[0, 1:]).tolist(), strict=True))
    medians = [{key: round(float(value[0]), 3) for key, value in one.items()} for one in costs(np.exp(kept[:1, 1:]))[1]]
    found = {"gains": gains, "cost": kept[0, 0], "medians": medians}
    print(json.dumps(found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
