"""The gains of `observer`, `pid` or `mpc`: a search on flights that no table reports.

`python benchmarks/observer_tuning.py [observer|pid|mpc|mpc-team] [--rounds N] [--sets N] [--width W] [--json FILE]`

Covariance matrix adaptation (CMA-ES, Hansen) over the logarithms of the gains. It goes on from those that the
controller has, so it says whether better ones are near; how these were found stands beside the controller. All flights
are flown undisturbed and with noise at level 1 and 40 ms of delay; what is made small is the sum over both.

- `observer`: 48 random feasible flights of known mass; the mean settling time, at most 30 s, and the mean peak over
  5 mm, at most 20
- `pid`, `mpc`: flights from rest of known mass and, for three in ten, of one that is believed to be 0.2 kg, 25 s each;
  besides 30 times the overshoot (of `pid` beyond 4 %) and 5 times the RMSE; 20 flights
- `mpc-team`: likewise on rings of 3 to 6 whose loads move in the plane, four flights each, the mass unknown in one
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from batch import fly_compiled
from mjxball.baselines import Mpc, Observer, Pid
from mjxball.config import Config, cg_limit, preset, with_plant
from mjxball.control.followers import Baseline
from mjxball.evaluate.metrics import Metrics, fly_and_measure
from mjxball.plant.teams import ring_config
from mjxball.plant.trim import largest_amplitude
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import CgPath, Scenario
from stability import MARGIN, random_scenarios

FLIGHTS, SETS, ROUNDS, SEED, WIDTH = 48, 24, 80, 1007, 0.3
CONDITIONS = (Disturbance(), Disturbance(noise=1.0, delay=0.04, seed=SEED))
TUNED: dict[str, Any] = {"observer": Observer, "pid": Pid, "mpc": Mpc, "mpc-team": Mpc}
TEAMS, TEAM_FLIGHTS = (3, 4, 5, 6), 4
KNOWN, UNKNOWN, SECONDS, CORES = 14, 6, 25.0, 2  # flights of `pid` and `mpc`
ALLOWED = {"pid": 0.04, "mpc": 0.0}  # overshoot that costs nothing


def from_rest(config: Config) -> list[Scenario]:
    """The flights of `pid` and `mpc`: goals 0.7 to 1.1 m away along every axis."""
    sampled = [
        *random_scenarios(config, KNOWN, False, SEED),
        *random_scenarios(config, UNKNOWN, True, SEED),
    ]
    still, random, found = Scenario(), np.random.default_rng(SEED), []
    for one in sampled:
        start = {name: getattr(still, name) for name in ("start_position", "start_velocity", "start_tilt")}
        found.append(dataclasses.replace(one, goal=far_goal(random), seconds=SECONDS, **start))
    return found


def far_goal(random: np.random.Generator) -> tuple[float, float, float]:
    """0.7 to 1.1 m away along every axis."""
    x, y, z = map(float, random.uniform(0.7, 1.1, 3) * random.choice([-1.0, 1.0], 3))
    return x, y, z


def of_teams() -> list[tuple[Config, list[Scenario]]]:
    """The flights of `mpc-team`, feasible with 15 % of the rotors left."""
    random, found = np.random.default_rng(SEED), []
    ways = [(math.cos(angle), math.sin(angle)) for angle in np.pi * np.arange(8) / 8]
    for size in TEAMS:
        config, flights = ring_config(with_plant(preset("paper"), "team6"), size), list[Scenario]()
        while len(flights) < TEAM_FLIGHTS:
            mass = config.plant.object_mass * float(random.uniform(0.5, 1.5))
            width, turn, lead, phase = map(float, random.uniform(0, (1.0, *[2 * math.pi] * 3)))
            reach = min(largest_amplitude(config, mass, MARGIN, way) for way in ways)
            scenario = Scenario(
                omega=float(random.uniform(0.0, 3.1)),
                amplitude=float(random.uniform()) * min(reach, cg_limit(config.plant)) / math.hypot(1, width),
                phase=phase,
                path=CgPath(turn, width, float(random.choice([1.0, 1.5, 2.0])), lead),
                mass=mass,
                believed_mass=None if flights else config.plant.object_mass,
                goal=far_goal(random),
                seconds=SECONDS,
            )
            if reach > 0:
                flights.append(scenario)
        found.append((config, flights))
    return found


def cost_of(runs: Sequence[Metrics], allowed: float | None) -> np.ndarray:
    """(n,) what each flight costs; overshoot and RMSE count where some overshoot is `allowed`."""
    settling = np.array([run.settling_time or math.inf for run in runs])
    parts = np.minimum(settling, 30.0) + np.minimum(1e3 * np.array([run.axis_peak for run in runs]) / 5, 20.0)
    if allowed is None:
        return parts
    over = np.array([1.0 if run.failed else min(max(run.overshoot - allowed, 0.0), 1.0) for run in runs])
    return parts + 30.0 * over + 5.0 * np.array([3.0 if run.failed else min(run.rmse, 3.0) for run in runs])


def medians(runs: Sequence[Metrics], sets: int) -> dict[str, np.ndarray]:
    """Medians (S,) of the settling time [s] and of the peak [mm]."""
    numbers = {
        "settling": [run.settling_time or math.inf for run in runs],
        "peak": [1e3 * run.axis_peak for run in runs],
    }
    return {name: np.median(np.reshape(values, (sets, -1)), axis=1) for name, values in numbers.items()}


def costs_of(
    controller: Any, sampled: list[Scenario], sets: int, allowed: float | None
) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """(cost (S,), medians (S,) under each condition) of `controller`, which flies all `sampled` with each of `sets`."""
    config = preset("paper")
    total, shown = np.zeros(sets), []
    flights = [dataclasses.replace(one, disturbance=condition) for condition in CONDITIONS for one in sampled * sets]
    flown = fly_compiled(config, Baseline(controller, config), flights)
    for runs in (flown[: len(flights) // 2], flown[len(flights) // 2 :]):
        total += cost_of(runs, allowed).reshape(sets, -1).mean(axis=1)
        shown.append(medians(runs, sets))
    return total, shown


def searched(gains: Any) -> list[str]:
    """Names of those `gains` that have a logarithm: what is 0 or infinite is switched off, and stays so."""
    return [name for name, value in gains._asdict().items() if 0.0 < value < math.inf]


def tuned(given: Any, values: np.ndarray) -> Any:
    """`given` with `values` (k,) of what is `searched`."""
    return given._replace(**dict(zip(searched(given), map(float, values), strict=True)))


def costs_of_team(sets: np.ndarray) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """`costs_of` `mpc` with the tunings `sets` (S, k), on teams."""
    runs: tuple[list[list[Metrics]], ...] = tuple([[] for _ in sets] for _ in CONDITIONS)
    for config, sampled in of_teams():
        flights = [dataclasses.replace(one, disturbance=condition) for condition in CONDITIONS for one in sampled]
        controllers = [
            type("Tuned", (Mpc,), {"team_tuning": tuned(Mpc.team_tuning, values)})(config) for values in sets
        ]
        _, measured = fly_and_measure(
            config, [(Baseline(controller, config), flights) for controller in controllers], "newton-euler"
        )
        found = iter(measured)
        for number in range(len(sets)):
            for of_condition in runs:
                of_condition[number] += itertools.islice(found, TEAM_FLIGHTS)
    total = sum(np.array([cost_of(one, ALLOWED["mpc"]).mean() for one in of_condition]) for of_condition in runs)
    return np.asarray(total), [medians([*itertools.chain(*one)], len(sets)) for one in runs]


def costs(controller: Any, sets: np.ndarray) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """`costs_of` all `sets` (S, k) of gains of `observer` or `pid`, flown at once."""
    config, allowed = preset("paper"), ALLOWED.get(controller.name)
    sampled = from_rest(config) if allowed is not None else random_scenarios(config, FLIGHTS, False, SEED)
    each = np.tile(np.repeat(sets, len(sampled), axis=0), (len(CONDITIONS), 1))
    gains = type(controller.gains)(*each.astype(np.float32).T)
    return costs_of(type("Tuned", (controller,), {"gains": gains})(config), sampled, len(sets), allowed)


def costs_of_mpc(values: np.ndarray) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """`costs_of` `mpc` with the tuning `values` (k,)."""
    config = preset("paper")
    controller = type("Tuned", (Mpc,), {"tuning": tuned(Mpc.tuning, values)})(config)
    return costs_of(controller, from_rest(config), 1, ALLOWED[controller.name])


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
    parser.add_argument("controller", nargs="?", choices=TUNED, default="observer")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--width", type=float, default=WIDTH, help="of the first steps, in the logarithm")
    parser.add_argument("--sets", type=int, default=SETS, help="of gains in each round")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    controller = TUNED[options.controller]
    team = options.controller == "mpc-team"
    given = controller.team_tuning if team else controller.tuning if controller is Mpc else controller.gains
    start = np.log([getattr(given, name) for name in searched(given)])
    if team:
        best, least = minimise(
            lambda sets: costs_of_team(np.exp(sets))[0], start, options.width, options.sets, options.rounds
        )
        shown = costs_of_team(np.exp([best]))[1]
    elif controller is Mpc:
        with ProcessPoolExecutor(CORES, multiprocessing.get_context("spawn")) as pool:
            each = lambda sets: np.array([cost[0] for cost, _ in pool.map(costs_of_mpc, np.exp(sets))])  # noqa: E731
            best, least = minimise(each, start, options.width, options.sets, options.rounds)
        shown = costs_of_mpc(np.exp(best))[1]
    else:
        best, least = minimise(
            lambda sets: costs(controller, np.exp(sets))[0], start, options.width, options.sets, options.rounds
        )
        shown = costs(controller, np.exp([best]))[1]
    gains = dict(zip(searched(given), np.exp(best).tolist(), strict=True))
    rounded = [{key: round(float(np.ravel(value)[0]), 3) for key, value in one.items()} for one in shown]
    found = {"controller": options.controller, "gains": gains, "cost": least, "medians": rounded}
    print(json.dumps(found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
