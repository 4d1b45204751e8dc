"""All that is asked of `balance`, of many policies at once: levels of difficulty, cells, commands, hovers, flights.

`python benchmarks/seeds.py POLICY.npz ... [--flights N] [--json FILE]`, `python benchmarks/seeds.py --others`

The policies differ in their networks' numbers alone, as the seeds of one training do: they fly side by side in one
compiled program, ten of them in three minutes on two cores. Of each:

- levels: levels.json has 80 levels of difficulty with three flights each, frozen. Of medians over the flights, a failed
  one being infinitely bad, it is counted in how many the peak (the root of the squared largest errors of the axes after
  20 s) is at most the smallest of the others' + 1 mm, RMSE + 2 %, settling time the smallest. Others are all that fly
  this plant, those included that are tuned for another purpose; results/balance.json has the best of them
- cells: how many of the 70 and the 40 of cells.py it meets (known mass, disturbed, unknown, disturbed), and of those
  beyond trim that some other holds below 5 cm, where its peak is at most 3 mm above the smallest
- commands: rms change from step to step with noise and delay, median and largest of the 70 cells [rad]
- hovers: those of stability.py that are stable with 60 ms of delay, mass known and unknown; how far the worst swings
- flights: random ones as of stability.py, mass known and unknown: failed, median, 99 % quantile, largest peak [m]

`--others` flies the others again: every classical follower but the oracle, and shipped policies. It writes
results/balance.json.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import cells
import stability
from batch import fly_compiled
from bounds import Bound, limits
from harness import RESULTS, Row, arguments, say, spread, write
from mjxball import config as configs
from mjxball.arrays import Array
from mjxball.baselines import CONTROLLERS, make_baseline
from mjxball.bench.scores import by_variant, fly_suites
from mjxball.bench.suites import Suite, Variant
from mjxball.config import Config, preset
from mjxball.control.network import Network
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.policies import load_policy
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxball.policy.inference import NetworkController
from mjxball.reading import parse_json
from mjxball.running import run_command
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario

LEVELS, OTHERS = Path(__file__).parent / "levels.json", RESULTS / "balance.json"
RIVALS = ("transport", "robust", "paper")  # shipped for this plant
FLIGHTS, PHASES = 3, 3  # of a level, of a cell
METRICS = {"peak": Bound(1e-3), "rmse": Bound(relative=0.02), "settling_time": Bound()}
HELD, NEAR = 0.05, 0.003  # peak of a cell that somebody holds, and by how much more a policy may have [m]
DELAY = 3  # control steps, 60 ms
CONDITIONS = ((True, False), (True, True), (False, False), (False, True))  # (mass known, disturbed)


def tupled(value: Any) -> Any:
    """Lists of JSON as tuples."""
    return tuple(map(tupled, value)) if isinstance(value, list) else value


@dataclass(frozen=True)
class Level(Variant):
    """One frozen level, whose flights are listed."""

    flights: tuple[Scenario, ...] = ()
    waveforms: tuple[Any, ...] = ()

    def config(self, base: Config, seed: int) -> Config:
        """See `Variant.config`."""
        base = super().config(base, seed)
        if not self.waveforms:
            return base
        times, offsets = self.waveforms[seed]
        return dataclasses.replace(base, motion=configs.Motion(kind="waveform", times=times, offsets=offsets))

    def seeded(self, seed: int) -> Scenario:
        """See `Variant.seeded`."""
        return self.flights[seed]


def read_levels() -> list[Suite]:
    """The suites of levels.json."""
    suites: dict[str, list[Level]] = {}
    for row in parse_json(LEVELS.read_text()):
        flights = []
        for flight in row["flights"]:
            numbers = {name: tupled(value) for name, value in flight.items() if name != "disturbance"}
            disturbance = {name: tupled(value) for name, value in flight.get("disturbance", {}).items()}
            flights.append(Scenario(**numbers, disturbance=Disturbance(**disturbance)))
        changes = {name: tupled(value) for name, value in row.get("changes", {}).items()}
        level = Level(
            row["level"], flights[0], changes, flights=tuple(flights), waveforms=tupled(row.get("waveforms", []))
        )
        suites.setdefault(row["suite"], []).append(level)
    return [Suite(name, "frozen", "level", tuple(levels)) for name, levels in suites.items()]


class Stacked:
    """Policies of one controller; the first of n equal parts of a batch belongs to the first of them, and so on."""

    name = "stacked"
    needs_privileged = False

    def __init__(self, policies: Sequence[Policy]):
        self._controller = NetworkController(policies[0])._controller
        networks = [NetworkController(policy)._network for policy in policies]
        self.networks = jax.tree.map(lambda *parts: np.stack(parts), *networks)

    def start(self, observation: Array) -> Array:
        """Memory at the first `observation` (n k, 18)."""
        return self._controller.start(observation)

    def step(self, memory: Array, observation: Array, privileged: Any) -> tuple[Array, Array]:
        """(memory, command (n k, 3)) at `observation` (n k, 18)."""
        networks = jax.tree.map(lambda part: jnp.asarray(part, observation.dtype), self.networks)
        seen = self._controller.network_input(observation, memory)
        parts = seen.reshape(len(networks.mean), -1, seen.shape[-1])
        action = jax.vmap(Network.__call__)(networks, parts)
        action = action.reshape(-1, action.shape[-1])
        return self._controller.next(memory, observation, action), self._controller.command(action, observation)


class Single(Stacked):
    """One of them, whose network may be traced."""

    def __init__(self, every: Stacked, network: Any):
        self._controller = every._controller
        self.networks = jax.tree.map(lambda part: part[None], network)

    def step(self, memory: Array, observation: Array, privileged: Any) -> tuple[Array, Array]:
        """(memory, command (3,)) at `observation` (18,)."""
        memory, command = super().step(memory[None], observation[None], privileged)
        return memory[0], command[0]


def fly_policies(config: Config, policies: list[Policy], scenarios: Sequence[Scenario]) -> list[list[Metrics]]:
    """Metrics of every policy in every scenario."""
    count = len(scenarios)
    flown = fly_compiled(config, policies[0], list(scenarios) * len(policies), controller=Stacked(policies))
    return [flown[first : first + count] for first in range(0, len(flown), count)]


def metric(flown: Metrics, name: str) -> float:
    """Infinite where a flight failed or never settled; without float32's last digits, since levels may be shared."""
    value = getattr(flown, name)
    return math.inf if flown.failed or value is None or math.isnan(value) else round(value, 6)


def of_levels(config: Config, policies: list[Policy]) -> list[Row]:
    """Of every policy: what is reached in the levels, and the medians in each."""
    groups: dict[str, tuple[Config, list[Any], list[Scenario]]] = {}
    for suite in read_levels():
        for level in suite.variants:
            for seed in range(FLIGHTS):
                own, scenario = level.config(config, seed), level.seeded(seed)
                key = f"{configs.config_hash(own)} {scenario.seconds}"
                _, names, scenarios = groups.setdefault(key, (own, [], []))
                names.append((suite.name, level.label))
                scenarios.append(scenario)
    metrics: list[dict[Any, list[Metrics]]] = [{} for _ in policies]
    for own, names, scenarios in groups.values():
        for found, flown in zip(metrics, fly_policies(own, policies, scenarios), strict=True):
            for name, one in zip(names, flown, strict=True):
                found.setdefault(name, []).append(one)
    recorded, rows = parse_json(OTHERS.read_text())["levels"], []
    for found in metrics:
        counts, levels = dict.fromkeys(METRICS, 0), []
        for row in recorded:
            flown = found[row["suite"], row["level"]]
            mine = {name: statistics.median(metric(one, name) for one in flown) for name in METRICS}
            for name in reached(mine, {name: math.inf if row[name] is None else row[name] for name in METRICS}):
                counts[name] += 1
            levels.append({"suite": row["suite"], "level": row["level"]} | mine)
        failed = sum(one.failed for flown in found.values() for one in flown)
        rows.append({"reached": counts, "failed": failed, "levels": levels})
    return rows


def reached(mine: dict[str, float], best: dict[str, float]) -> list[str]:
    """Which of the metrics are as good as wanted; nothing infinite is."""
    return [name for name, most in limits(best, METRICS).items() if math.isfinite(mine[name]) and mine[name] <= most]


def fly_others(config: Config) -> dict[str, list[Row]]:
    """Of every level and every cell beyond trim the smallest numbers of the others, and whose they are."""
    rivals = [make_baseline(name, config) for name in CONTROLLERS if name != "oracle"]
    rivals += [load_policy(shipped_policy(name), config) for name in RIVALS]
    levels, beyond = [], []
    scores = fly_suites(config, rivals, read_levels(), FLIGHTS, "newton-euler", print)
    for (suite, label), flown in by_variant(scores).items():
        row: Row = {"suite": suite, "level": label}
        for name in METRICS:
            row[name], row[f"{name} of"] = min((score.summary(name).median, score.follower) for score in flown)
        levels.append(row)
    every = [cell for cell in cells.feasible(config) if cell[1] > cells.reach_of(config, cell[2], False)]
    for disturbed in (False, True):
        common = {"believed_mass": cells.BELIEVED}
        found = {rival.name: cells.fly_cells(rival, every, common, disturbed, FLIGHTS) for rival in rivals}
        for number, cell in enumerate(every):
            peak, name = min((rows[number]["peak"], name) for name, rows in found.items())
            beyond.append({"cell": cell, "disturbed": disturbed, "peak": peak, "peak of": name})
    return {"levels": levels, "beyond trim": beyond}


def of_cells(config: Config, policies: list[Policy]) -> list[Row]:
    """Of every policy: the cells that it meets, those beyond trim, changes of its commands."""
    every, others = cells.feasible(config), parse_json(OTHERS.read_text())["beyond trim"]
    calm = cells.fly_cells(make_baseline("lqg", config), every, {}, False, PHASES)
    beyond = {(tuple(row["cell"]), row["disturbed"]): row["peak"] for row in others}
    rows: list[Row] = [{"cells": [], "beyond trim": [], "commands": []} for _ in policies]
    for known, disturbed in CONDITIONS:
        common = {} if known else {"believed_mass": cells.BELIEVED}
        rival = make_baseline("adaptive" if known else "adaptive-mass", config)
        theirs = cells.fly_cells(rival, every, common, disturbed, PHASES)
        scenarios = cells.scenarios_of(every, common, disturbed, PHASES)
        for row, flown in zip(rows, fly_policies(config, policies, scenarios), strict=True):
            won, held, near = 0, 0, 0
            for number, (cell, own) in enumerate(zip(every, cells.medians(flown, len(every)), strict=True)):
                if known or cell[1] <= cells.reach_of(config, cell[2], False):
                    won += len(cells.wins_of(own, cells.wanted(theirs[number], calm[number]))) == len(cells.WANTED)
                elif (least := beyond[tuple(cell), disturbed]) is not None and least < HELD:
                    held, near = held + 1, near + (own["peak"] <= least + NEAR)
            row["cells"].append(won)
            if not known:
                row["beyond trim"].append([near, held])
            elif disturbed:
                changes = [metric(one, "smoothness") for one in flown[: len(every)]]
                row["commands"] = [statistics.median(changes), max(changes)]
    return rows


def of_hovers(config: Config, policies: list[Policy]) -> list[Row]:
    """Of every policy: stable hovers with 60 ms of delay, all of them, largest swing [m]; mass known and unknown."""
    rows: list[Row] = [{"hovers": []} for _ in policies]
    every = Stacked(policies)
    for unknown in (False, True):
        cases = stability.grid(config, unknown)
        networks = jax.tree.map(np.float64, every.networks)
        found = stability.linearised(config, lambda n: Single(every, n), networks, cases, DELAY)
        for row, hovers in zip(rows, found, strict=True):
            swing = max(hover.swing for hover in hovers)
            row["hovers"].append([sum(hover.stable for hover in hovers), len(cases), swing])
    return rows


def of_flights(config: Config, policies: list[Policy], count: int) -> list[Row]:
    """Of every policy: failures and peaks of random flights, mass known and unknown."""
    rows: list[Row] = [{"flights": []} for _ in policies]
    for unknown in (False, True):
        scenarios = stability.random_scenarios(config, count, unknown, 1)
        for row, flown in zip(rows, fly_policies(config, policies, scenarios), strict=True):
            middle, high, most = map(float, np.quantile([stability.peak(one) for one in flown], [0.5, 0.99, 1.0]))
            failed = sum(one.failed for one in flown)
            row["flights"].append({"failed": failed, "median": middle, "99 %": high, "largest": most})
    return rows


def report(rows: list[Row]) -> None:
    """Print every policy's row, then least - median - most of each number."""
    for row in rows:
        say({name: value for name, value in row.items() if name != "levels"})
    for name in METRICS:
        print(f"{name} reached in levels: {spread(row['reached'][name] for row in rows)}")
    for number, (known, disturbed) in enumerate(CONDITIONS):
        print(f"cells, {cells.condition(known, disturbed)}: {spread(row['cells'][number] for row in rows)}")
    for number, where in enumerate(("undisturbed", "noise and 40 ms")):
        print(f"beyond trim, {where}: {spread(row['beyond trim'][number][0] for row in rows)}")
    print(f"largest change of commands: {spread(row['commands'][1] for row in rows)} rad")
    for number, where in enumerate(("known", "unknown")):
        print(f"hovers with 60 ms, mass {where}: {spread(row['hovers'][number][0] for row in rows)}")
        flights = [row["flights"][number] for row in rows]
        print(f"flights, mass {where}: {sum(one['failed'] for one in flights)} failed", end="; ")
        print("; ".join(f"{name} {spread(1e3 * one[name] for one in flights)} mm" for name in list(flights[0])[1:]))


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("policies", type=Path, nargs="*", metavar="POLICY.npz")
    parser.add_argument("--flights", type=int, default=3000, metavar="N", help="random ones, of each kind of mass")
    parser.add_argument("--others", action="store_true", help="fly the others instead, into results/balance.json")
    options = parser.parse_args(given)
    config = preset("paper")
    if options.others:
        write(OTHERS, fly_others(config))
        return 0
    if not options.policies:
        raise InputError("say which policy files to fly, or --others")
    policies = [load_policy(path, config) for path in options.policies]
    rows: list[Row] = [{"policy": "/".join(path.parts[-2:])} for path in options.policies]
    parts = [of_hovers(config, policies), of_levels(config, policies), of_cells(config, policies)]
    for part in (*parts, of_flights(config, policies, options.flights)):
        rows = [row | found for row, found in zip(rows, part, strict=True)]
    report(rows)
    write(options.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
