"""All seeds of every number: what balance.py, cells.py, rivals.py and stability.py ask, of many policies at once.

`python benchmarks/seeds.py POLICY.npz ... [--flights N] [--json FILE]`

The policies differ in their networks' numbers alone, as the seeds of one training do: they fly side by side in one
compiled program, ten of them in three minutes on two cores. Of each:

- levels: in how many of the 80 levels of balance.py its peak, RMSE and settling time are as good as wanted, against
  the numbers of the others in results/balance.json; failed flights
- cells: how many of the 70 and the 40 of cells.py it meets (known mass, disturbed, unknown, disturbed), and of those
  beyond trim that somebody holds, where its peak is near the smallest (undisturbed, disturbed)
- commands: rms change from step to step with noise and delay, median and largest of the 70 cells [rad]
- hovers: those of stability.py that are stable with 60 ms of delay, mass known and unknown; how far the worst swings
- flights: random ones as of stability.py, mass known and unknown: failed, median, 99 % quantile, largest peak [m]
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import balance
import cells
import stability
from hover_stability import linearised
from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.config import Config, preset
from mjxball.control.network import Network
from mjxball.evaluate.batch import Batch
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.policies import load_policy
from mjxball.policy import Policy
from mjxball.policy.policy import NetworkLaw
from mjxball.reading import parse_json
from mjxball.sim.scenario import Scenario

Array = Any
RECORDED = Path(__file__).parent / "results" / "balance.json"
DELAY = 3  # control steps, 60 ms
PHASES = 3
CONDITIONS = ((True, False), (True, True), (False, False), (False, True))  # (mass known, disturbed)


class Stacked:
    """Policies of one law; the first of n equal parts of a batch belongs to the first of them, and so on."""

    name = "stacked"
    needs_privileged = False

    def __init__(self, policies: Sequence[Policy]):
        self._law = NetworkLaw(policies[0])._law
        networks = [NetworkLaw(policy)._network for policy in policies]
        self.networks = jax.tree.map(lambda *parts: np.stack(parts), *networks)

    def start(self, observation: Array) -> Array:
        """Memory at the first `observation` (n k, 18)."""
        return self._law.start(observation)

    def step(self, memory: Array, observation: Array, privileged: Any) -> tuple[Array, Array]:
        """(memory, command (n k, 3)) at `observation` (n k, 18)."""
        networks = jax.tree.map(lambda part: jnp.asarray(part, observation.dtype), self.networks)
        seen = self._law.network_input(observation, memory)
        parts = seen.reshape(len(networks.mean), -1, seen.shape[-1])
        scaled = jax.vmap(Network.__call__)(networks, parts)
        scaled = scaled.reshape(-1, scaled.shape[-1])
        command = self._law.command(scaled, observation, memory)
        return self._law.next(memory, observation, scaled, command), command


class Single(Stacked):
    """One of them, whose network may be traced."""

    def __init__(self, every: Stacked, network: Any):
        self._law = every._law
        self.networks = jax.tree.map(lambda part: part[None], network)

    def step(self, memory: Array, observation: Array, privileged: Any) -> tuple[Array, Array]:
        """(memory, command (3,)) at `observation` (18,)."""
        memory, command = super().step(memory[None], observation[None], privileged)
        return memory[0], command[0]


def fly(config: Config, policies: list[Policy], scenarios: Sequence[Scenario]) -> list[list[Metrics]]:
    """Metrics of every policy in every scenario."""
    batch, count = Batch(config, policies[0]), len(scenarios)
    batch._law = Stacked(policies)
    flown = batch.fly(list(scenarios) * len(policies))
    return [flown[first : first + count] for first in range(0, len(flown), count)]


def metric(flown: Metrics, name: str) -> float:
    """Infinite where a flight failed or never settled; without float32's last digits, since levels may be shared."""
    value = getattr(flown, name)
    return math.inf if flown.failed or value is None or math.isnan(value) else round(value, 6)


def of_levels(config: Config, policies: list[Policy]) -> list[dict[str, Any]]:
    """Of every policy: what is reached in the levels, and the medians in each."""
    groups: dict[str, tuple[Config, list[Any], list[Scenario]]] = {}
    for suite in balance.read_levels():
        for level in suite.variants:
            for seed in range(balance.FLIGHTS):
                own, scenario = level.config(config, seed), level.seeded(seed)
                key = f"{configs.config_hash(own)} {scenario.seconds}"
                _, names, scenarios = groups.setdefault(key, (own, [], []))
                names.append((suite.name, level.label))
                scenarios.append(scenario)
    metrics: list[dict[Any, list[Metrics]]] = [{} for _ in policies]
    for own, names, scenarios in groups.values():
        for found, flown in zip(metrics, fly(own, policies, scenarios), strict=True):
            for name, one in zip(names, flown, strict=True):
                found.setdefault(name, []).append(one)
    recorded, rows = parse_json(RECORDED.read_text()), []
    for found in metrics:
        counts, levels = dict.fromkeys(balance.METRICS, 0), []
        for row in recorded["levels"]:
            flown = found[row["suite"], row["level"]]
            others = [numbers for name, numbers in row["followers"].items() if name != recorded["policy"]]
            best = {name: min(math.inf if n[name] is None else n[name] for n in others) for name in counts}
            mine = {name: statistics.median(metric(one, name) for one in flown) for name in counts}
            for name in balance.reached(mine, best):
                counts[name] += 1
            levels.append({"suite": row["suite"], "level": row["level"]} | mine)
        failed = sum(one.failed for flown in found.values() for one in flown)
        rows.append({"reached": counts, "failed": failed, "levels": levels})
    return rows


def of_cells(config: Config, policies: list[Policy]) -> list[dict[str, Any]]:
    """Of every policy: the cells that it meets, those beyond trim, changes of its commands."""
    every, recorded = cells.feasible(config), parse_json(RECORDED.read_text())
    calm = cells.fly(make_baseline("lqg", config), every, {}, False, PHASES)
    beyond = {(tuple(row["cell"]), row["disturbed"]): row for row in recorded["beyond trim"]}
    rows: list[dict[str, Any]] = [{"cells": [], "beyond trim": [], "commands": []} for _ in policies]
    for known, disturbed in CONDITIONS:
        common = {} if known else {"believed_mass": cells.BELIEVED}
        rival = make_baseline("adaptive" if known else "adaptive-mass", config)
        theirs = cells.fly(rival, every, common, disturbed, PHASES)
        scenarios = cells.scenarios_of(every, common, disturbed, PHASES)
        for row, flown in zip(rows, fly(config, policies, scenarios), strict=True):
            won, held, near = 0, 0, 0
            for number, (cell, own) in enumerate(zip(every, cells.medians(flown, len(every)), strict=True)):
                if known or cell[1] <= cells.reach_of(config, cell[2], False):
                    won += len(cells.wins_of(own, cells.wanted(theirs[number], calm[number]))) == len(cells.WANTED)
                elif (other := beyond[tuple(cell), disturbed])["held"]:
                    peaks = [peak for name, peak in other["peaks"].items() if name != recorded["policy"]]
                    least = min(peak for peak in peaks if peak is not None)
                    held, near = held + 1, near + (own["peak"] <= least + balance.NEAR)
            row["cells"].append(won)
            if not known:
                row["beyond trim"].append([near, held])
            elif disturbed:
                changes = [metric(one, "smoothness") for one in flown[: len(every)]]
                row["commands"] = [statistics.median(changes), max(changes)]
    return rows


def of_hovers(config: Config, policies: list[Policy]) -> list[dict[str, Any]]:
    """Of every policy: stable hovers with 60 ms of delay, all of them, largest swing [m]; mass known and unknown."""
    rows: list[dict[str, Any]] = [{"hovers": []} for _ in policies]
    every = Stacked(policies)
    for unknown in (False, True):
        cases = stability.grid(config, unknown)
        networks = jax.tree.map(np.float64, every.networks)
        for row, hovers in zip(
            rows, linearised(config, lambda n: Single(every, n), networks, cases, DELAY), strict=True
        ):
            swing = max(hover.swing for hover in hovers)
            row["hovers"].append([sum(hover.stable for hover in hovers), len(cases), swing])
    return rows


def of_flights(config: Config, policies: list[Policy], count: int) -> list[dict[str, Any]]:
    """Of every policy: failures and peaks of random flights, mass known and unknown."""
    rows: list[dict[str, Any]] = [{"flights": []} for _ in policies]
    for unknown in (False, True):
        scenarios = stability.random_scenarios(config, count, unknown, 1)
        for row, flown in zip(rows, fly(config, policies, scenarios), strict=True):
            middle, high, most = map(float, np.quantile([stability.peak(one) for one in flown], [0.5, 0.99, 1.0]))
            failed = sum(one.failed for one in flown)
            row["flights"].append({"failed": failed, "median": middle, "99 %": high, "largest": most})
    return rows


def spread(values: Sequence[float]) -> str:
    """Least - median - most."""
    return " - ".join(f"{value:.4g}" for value in (min(values), statistics.median(values), max(values)))


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", type=Path, nargs="+")
    parser.add_argument("--flights", type=int, default=3000)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    config = preset("paper")
    policies = [load_policy(path, config) for path in options.policies]
    rows: list[dict[str, Any]] = [{"policy": "/".join(path.parts[-2:])} for path in options.policies]
    parts = [of_hovers(config, policies), of_levels(config, policies), of_cells(config, policies)]
    for part in (*parts, of_flights(config, policies, options.flights)):
        rows = [row | found for row, found in zip(rows, part, strict=True)]
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items() if name != "levels"))
    for name in balance.METRICS:
        print(f"{name} reached in levels: {spread([row['reached'][name] for row in rows])}")
    for number, (known, disturbed) in enumerate(CONDITIONS):
        where = f"mass {'known' if known else 'unknown'}, {'noise and 40 ms' if disturbed else 'undisturbed'}"
        print(f"cells, {where}: {spread([row['cells'][number] for row in rows])}")
    for number, where in enumerate(("undisturbed", "noise and 40 ms")):
        print(f"beyond trim, {where}: {spread([row['beyond trim'][number][0] for row in rows])}")
    print(f"largest change of commands: {spread([row['commands'][1] for row in rows])} rad")
    for number, where in enumerate(("known", "unknown")):
        print(f"hovers with 60 ms, mass {where}: {spread([row['hovers'][number][0] for row in rows])}")
        flights = [row["flights"][number] for row in rows]
        print(f"flights, mass {where}: {sum(one['failed'] for one in flights)} failed", end="; ")
        print("; ".join(f"{name} {spread([1e3 * one[name] for one in flights])} mm" for name in list(flights[0])[1:]))
    if options.json:
        finite = json.loads(
            json.dumps(rows), parse_constant=lambda _: None, parse_float=lambda x: float(f"{float(x):.4g}")
        )
        options.json.write_text("[" + ",\n".join(json.dumps(row) for row in finite) + "]\n")


if __name__ == "__main__":
    main()
