"""The tuning of the references of mjxball-bench: a search on flights that no table reports.

`python benchmarks/tuning.py CONTROLLER [--track TRACK ...] [--condition both|calm|disturbed] [--sets N] [--rounds N]
[--flights N] [--plants N] [--width W] [--cores N] [--log FILE]`

CMA-ES (Hansen) over the logarithms of a controller's tuning; it starts from that which the controller has for both
conditions. All sets of a round fly all flights of a plant as one compiled program, on the CPU or on a GPU; `mpc` solves
its programs on the CPU, the sets shared out among processes. What is made small is the mean over flights of the time
after which |e_o| stays within a bound, over that of `oracle` and at most four, plus the share of flights without
success: later than the benchmark's deadline, or a rotor at its limit for more than 5 % of the time. Bounds and
deadlines are those of the benchmark, whose draw 4711 flies here and in no table. Of an oracle it is the mean of that
time in seconds, for these bounds and for three tenths of them. The log has a line of JSON for the best set of a round:
its tuning, its cost, and the cost's parts. Those kept in `benchmarks/results/` have every fifth line and the best.

Shipped tunings, besides `--condition`:

    lqg, pid, observer          --track pair --flights 72 --sets 48 --rounds 80 (pid, observer: 40)
    lqg-team                    --track team rigs --plants 5 --flights 12 --sets 48 --rounds 25
    crazyflie-lqg               --track crazyflie --flights 48 --sets 48 --rounds 40 (for both conditions: 80)
    mpc                         --track pair --flights 12 --sets 32 --rounds 32
    mpc-team                    --track team --plants 2 --flights 4 --sets 26 --rounds 19
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import functools
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from cma import minimise
from mjxball.baselines import crazyflie_lqg, crazyflie_oracle, lqg, make_controller, mpc, oracle
from mjxball.baselines.observer import Observer
from mjxball.baselines.pid import Pid
from mjxball.bench import CONDITIONS
from mjxball.bench.draw import sample_group, with_perfect_sensors
from mjxball.bench.success import MAX_ROTOR_SHARE
from mjxball.bench.tracks import TRACKS, PlantFlights
from mjxball.config import Config
from mjxball.control.followers import Baseline, Controller
from mjxball.evaluate.metrics import rotor_limits
from mjxball.evaluate.running_metrics import AT_LIMIT_WITHIN, near_limit
from mjxball.physics import newton_euler
from mjxball.physics.step import jax_repeat, make_plant_step
from mjxball.scalar_form import scalar_form
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.rollout import Carry, Inputs, control_step, make_privileged_info, scenario_arrays, simulate_batch
from mjxball.sim.scenario import Scenario
from mjxball.xla import enable_compilation_cache

DRAW, SECONDS = 4711, 15.0  # of flights that no table reports
STRICT = 0.3  # share of the bounds within which an oracle is asked to stay, too
ORACLES = ("oracle", "crazyflie-oracle")  # of ideal attitude loops, of Crazyflies
WORST = 4.0  # times that of `oracle` a flight counts at most
SETS, ROUNDS, WIDTH, FLIGHTS = 24, 40, 0.25, 24
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
IN_WORKERS = {"JAX_PLATFORMS": "cpu"} | dict.fromkeys(THREADS, "1")  # environment of the processes of `--cores`


class Part(NamedTuple):
    """n flights on one plant."""

    config: Config
    scenarios: Sequence[Scenario]
    bounds: np.ndarray  # (n,) [m]
    conditions: np.ndarray  # (n,) the name of each flight's
    known: np.ndarray  # (n,) after which |e_o| stays within the bound with `oracle` [s]
    deadlines: np.ndarray  # (n,) [s]

    def of_oracle(self, share: float) -> Part:
        """The same flights as an oracle flies them, with this share of the bounds."""
        perfect = [with_perfect_sensors(one) for one in self.scenarios]
        return self._replace(scenarios=perfect, bounds=share * self.bounds)


class Measured(NamedTuple):
    """What S sets did in n flights, (S, n) each."""

    time: np.ndarray  # after which |e_o| stays within the bound, infinite if it does not [s]
    limited: np.ndarray  # share of time with any rotor at its limit
    peak: np.ndarray  # largest |e_o| in the last third [m]


def flights_of(tracks: Sequence[str], condition: str, count: int, plants: int | None, pool: Executor) -> list[Part]:
    """The flights of a search: `count` in each condition on each plant of `tracks`, those that `oracle` succeeds in.

    `plants`: this many of each track, evenly spaced; None: all.
    """
    chosen = []
    for track in tracks:
        numbers = range(len(_plants(track)))
        chosen += [(track, number) for number in numbers[:: max(len(numbers) // plants, 1) if plants else 1]]
    return list(pool.map(functools.partial(_part, condition, count), *zip(*chosen, strict=True)))


@functools.cache
def _plants(track: str) -> list[PlantFlights]:
    return TRACKS[track].flights(DRAW)


def _part(condition: str, count: int, track: str, number: int) -> Part:
    """The flights of a search on plant `number` of a track."""
    group = sample_group(track, DRAW, number, dataclasses.replace(_plants(track)[number], count=count))
    chosen = [one for one in group.flights if condition in (one.condition, "both")]
    scenarios = [
        dataclasses.replace(
            one.scenario, seconds=SECONDS, disturbance=dataclasses.replace(one.scenario.disturbance, seed=seed)
        )
        for seed, one in enumerate(chosen)
    ]
    columns = zip(*((one.radius, one.condition, one.oracle_arrival, one.deadline) for one in chosen), strict=True)
    radii, conditions, arrivals, deadlines = map(np.array, columns)
    return Part(group.config, scenarios, radii, conditions, arrivals + group.config.timing.control_period, deadlines)


class Tuned(NamedTuple):
    """How a controller takes many tunings at once."""

    start: Any  # the tuning that it has, a tuple of numbers by name
    arrays: Callable[[Config, Any], Any] | None  # what a tuning becomes, a tree of arrays; None: no compiled program
    make: Callable[[Config, Any], Controller]  # the controller of such a tree of traced arrays, or of a tuning


def _with(attribute: str, name: str) -> Callable[[Config, Any], Controller]:
    """A controller called `name` whose `attribute` is replaced by traced arrays."""

    def make(config: Config, arrays: Any) -> Controller:
        controller = copy.copy(make_controller(name, config))
        setattr(controller, attribute, arrays)
        return controller

    return make


def _crazyflie_gains(config: Config, costs: Any) -> Any:
    return crazyflie_oracle.CrazyflieOracle(config, costs).gains


TUNED: dict[str, Tuned] = {
    "crazyflie-lqg": Tuned(crazyflie_lqg.CrazyflieLqg.tuning, crazyflie_lqg.design, _with("design", "lqg")),
    "crazyflie-oracle": Tuned(crazyflie_oracle.CrazyflieOracle.tuning, _crazyflie_gains, _with("gains", "oracle")),
    "lqg": Tuned(lqg.Lqg.tuning, lqg.design, _with("design", "lqg")),
    "lqg-team": Tuned(lqg.Lqg.team_tuning, lqg.design, _with("design", "lqg")),
    "oracle": Tuned(
        oracle.Oracle.tuning, lambda config, tuning: oracle.gains(config, tuning)[0], _with("gains", "oracle")
    ),
    "mpc": Tuned(mpc.Mpc.tuning, None, mpc.Mpc),
    "mpc-team": Tuned(mpc.Mpc.team_tuning, None, mpc.Mpc),
    "pid": Tuned(Pid.gains, lambda config, gains: gains, _with("gains", "pid")),
    "observer": Tuned(Observer.gains, lambda config, gains: gains, _with("gains", "observer")),
}


class Flown:
    """A compiled program that flies the flights of one part with any number of sets."""

    def __init__(self, name: str, part: Part):
        self._tuned, self._part = TUNED[name], part
        flown = scenario_arrays(part.config, part.scenarios)
        config = part.config
        step = make_plant_step(config, newton_euler.make_engine(config.plant, config.attitude), jax_repeat)
        whole = (scalar_form if config.autopilot.kind == "ideal" else jax.vmap)(step)
        loop = ClosedLoop(config, whole, flown.sensors, jitters=flown.inputs.late is not None)
        privileged, most = make_privileged_info(config), rotor_limits(config.plant, part.scenarios)
        total = len(flown.inputs.time)

        def fly(arrays: Any, load: Any, start: Any, inputs: Inputs, first: Any, most: Any) -> Any:
            controller = self._tuned.make(config, arrays)
            state, observation = loop.start(start, inputs.at(0).goal, load, first, flown.settings)
            zero = jnp.zeros_like(start.time)

            def advance(carried: Any, now: Inputs) -> tuple[Any, None]:
                carry, (last, limited, peak), number = carried
                carry, row = control_step(loop, controller, privileged, load, carry, now)
                far = jnp.sqrt(((row.target - row.position) ** 2).sum(axis=-1))
                inside = (far <= jnp.asarray(part.bounds, jnp.float32)) & ~row.diverged
                near = near_limit(AT_LIMIT_WITHIN, row.rotor_force, most[..., None]).max(axis=(-2, -1))
                last = jnp.where(inside, last, number + 1.0)
                late = jnp.where(number >= 2 * total // 3, jnp.where(row.diverged, jnp.inf, far), 0.0)
                return (carry, (last, limited + near / total, jnp.maximum(peak, late)), number + 1.0), None

            carried = Carry(state, observation, controller.start(observation)), (zero, zero, zero), jnp.float32(0.0)
            return jax.lax.scan(advance, carried, inputs)[0][1]

        given = (flown.load, flown.start, flown.inputs, flown.first, most)
        self._given = jax.tree.map(
            lambda leaf: np.asarray(leaf, np.float32 if leaf.dtype == np.float64 else None), given
        )
        self._fly = jax.jit(jax.vmap(fly, in_axes=(0, *[None] * len(given))))
        self._total, self._period = total, config.timing.control_period

    def __call__(self, arrays: Any) -> Measured:
        """`arrays` with a leading axis of sets."""
        last, limited, peak = (np.asarray(part, float) for part in self._fly(arrays, *self._given))
        seconds = np.where(last >= self._total, np.inf, last * self._period)
        return Measured(np.maximum(seconds, self._period), limited, peak)


def fly_all(name: str, part: Part, tunings: Sequence[Any], flown: Flown | None, pool: Executor, cores: int) -> Measured:
    """What all `tunings` do in the flights of `part`; `flown` is None where there is no compiled program."""
    if flown is None:
        several = math.ceil(len(tunings) / cores)  # in one process, which steps their plants together
        chunks = [tunings[first : first + several] for first in range(0, len(tunings), several)]
        each = pool.map(functools.partial(_simulate, name, part), chunks)
        return Measured(*(np.concatenate(column) for column in zip(*each, strict=True)))
    found = list(pool.map(functools.partial(_design, name, part.config), tunings))
    return flown(jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf, np.float32) for leaf in leaves]), *found))


def _design(name: str, config: Config, tuning: Any) -> Any:
    arrays = TUNED[name].arrays
    assert arrays is not None
    return arrays(config, tuning)


def _simulate(name: str, part: Part, tunings: Sequence[Any]) -> Measured:
    """What `tunings` do in the flights of `part`, in NumPy."""
    config, make = part.config, TUNED[name].make
    flights = [(Baseline(make(config, tuning), config), part.scenarios) for tuning in tunings]
    flight = simulate_batch(config, flights, "newton-euler")
    far = np.where(flight.diverged, np.inf, np.linalg.norm(flight.error, axis=-1))
    most = np.tile(rotor_limits(config.plant, part.scenarios), (len(tunings), 1))[..., None]
    near = near_limit(AT_LIMIT_WITHIN, flight.rotor_force, most).max(axis=(-2, -1))
    outside, rows = ~(far <= np.tile(part.bounds, len(tunings))), np.arange(1, len(far) + 1)[:, None]
    last = (outside * rows).max(axis=0)
    seconds = np.where(last == len(far), np.inf, np.maximum(last, 1) * config.timing.control_period)
    found = seconds, near.mean(axis=0), far[2 * len(far) // 3 :].max(axis=0)
    return Measured(*(values.reshape(len(tunings), -1) for values in found))


class Search:
    """The cost of sets of one controller on all parts, and its log."""

    def __init__(self, name: str, parts: Sequence[Part], log: Path | None, pool: Executor, cores: int):
        self.tuned, self._name, self._log, self._pool, self._cores = TUNED[name], name, log, pool, cores
        self._absolute = name in ORACLES
        self._parts = [part.of_oracle(share) for part in parts for share in (1.0, STRICT)] if self._absolute else parts
        self._threads = ThreadPoolExecutor(len(self._parts))  # which compile and fly all plants at once
        self._flown = [Flown(name, part) if self.tuned.arrays else None for part in self._parts]
        self._sets, self._begun = 0, time.perf_counter()

    def __call__(self, sets: np.ndarray) -> np.ndarray:
        """(S,) costs of `sets` (S, k), values of what is `searched`."""
        tunings = [tuned(self.tuned.start, values) for values in sets]
        flown = self._threads.map(
            lambda part, fly: fly_all(self._name, part, tunings, fly, self._pool, self._cores), self._parts, self._flown
        )
        numbers = [numbers_of(one, part, self._absolute) for one, part in zip(flown, self._parts, strict=True)]
        of_flights = {name: np.concatenate([one[name] for one in numbers], axis=1) for name in numbers[0]}
        conditions = np.concatenate([part.conditions for part in self._parts])
        parts = {
            name: {key: values[:, conditions == name] for key, values in of_flights.items()}
            for name in dict.fromkeys(conditions)
        }
        costs = np.asarray(of_flights["cost"].mean(axis=1))
        self._sets, best = self._sets + len(sets), int(costs.argmin())
        tuning = {name: float(f"{value:.4g}") for name, value in tunings[best]._asdict().items()}
        found = {name: summary({k: v[best] for k, v in own.items()}) for name, own in parts.items()}
        self._write({"cost": round(float(costs[best]), 4), "tuning": tuning, **found, "sets": self._sets})
        return costs

    def _write(self, record: dict[str, Any]) -> None:
        if self._log:
            seconds = round(time.perf_counter() - self._begun, 1)
            with self._log.open("a") as file:
                file.write(json.dumps({"controller": self._name, "seconds": seconds, **record}) + "\n")


def numbers_of(measured: Measured, part: Part, absolute: bool) -> dict[str, np.ndarray]:
    """(S, n) each: cost, time [s], success (0, 1), share of time at limits and peak [m] of every flight.

    Costs are of the time in seconds if `absolute`, else of that over the oracle's.
    """
    late, limited = np.minimum(measured.time, SECONDS), measured.limited > MAX_ROTOR_SHARE
    if absolute:
        succeeds, ratio = np.isfinite(measured.time) & ~limited, late
    else:
        succeeds = (measured.time <= part.deadlines) & ~limited
        ratio = np.minimum(late / np.minimum(part.known, SECONDS), WORST)
    return {
        "cost": ratio + 1.0 - succeeds,
        "time": late,
        "succeeded": succeeds.astype(float),
        "limited": measured.limited,
        "peak": measured.peak,
    }


def summary(numbers: dict[str, np.ndarray]) -> dict[str, float]:
    """One line of numbers (n,) of flights: means, the median time, the 90 % peak."""
    found = {name: numbers[name].mean() for name in ("cost", "succeeded", "limited")}
    found |= {"median": np.median(numbers["time"]), "peak_90": np.quantile(numbers["peak"], 0.9)}
    return {name: round(float(value), 4) for name, value in found.items()}


def searched(tuning: Any) -> list[str]:
    """Names of those parameters that have a logarithm: what is 0 or infinite is switched off, and stays so."""
    return [name for name, value in tuning._asdict().items() if 0.0 < value < math.inf]


def tuned(given: Any, values: np.ndarray) -> Any:
    """`given` with `values` (k,) of what is `searched`."""
    return given._replace(**dict(zip(searched(given), map(float, values), strict=True)))


def main() -> None:
    """Search, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("controller", choices=TUNED)
    parser.add_argument("--track", nargs="+", default=["pair"], choices=TRACKS, help="whose plants and loads fly")
    parser.add_argument("--condition", choices=(*CONDITIONS, "both"), default="both")
    parser.add_argument("--flights", type=int, default=FLIGHTS, help="of each plant")
    parser.add_argument("--plants", type=int, help="of the track; all if not given")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--sets", type=int, default=SETS, help="in each round")
    parser.add_argument("--width", type=float, default=WIDTH, help="of the first steps, in the logarithm")
    parser.add_argument(
        "--cores", type=int, default=1, help="processes: they sample flights, compute designs, fly `mpc`"
    )
    parser.add_argument("--log", type=Path, metavar="FILE", help="JSON lines, added to")
    options = parser.parse_args()
    enable_compilation_cache()
    jax.devices()  # this process keeps its own, whatever the environment says from here on
    os.environ |= IN_WORKERS
    with (
        ProcessPoolExecutor(options.cores, multiprocessing.get_context("spawn"))
        if options.cores > 1
        else ThreadPoolExecutor(1) as pool
    ):
        parts = flights_of(options.track, options.condition, options.flights, options.plants, pool)
        search = Search(options.controller, parts, options.log, pool, options.cores)
        start = np.log([getattr(search.tuned.start, name) for name in searched(search.tuned.start)])
        best, least = minimise(lambda sets: search(np.exp(sets)), start, options.width, options.sets, options.rounds)
    found = tuned(search.tuned.start, np.exp(best))
    print(f"{least:.4f}", {name: float(f"{value:.4g}") for name, value in found._asdict().items()})


if __name__ == "__main__":
    main()
