"""The tuning of the references of mjxball-bench: a search on flights that no table reports.

`python benchmarks/tuning.py CONTROLLER [--track TRACK ...] [--condition both|calm|world] [--sets N] [--rounds N]
[--flights N] [--width W] [--log FILE]`

CMA-ES (Hansen) over the logarithms of a controller's tuning; it starts from that which the controller has. All sets of
a round fly all flights as one compiled program, on the CPU or on a GPU; `mpc` solves its programs on the CPU, set by
set. What is made small is the mean over flights of the time after which |e_o| stays within a bound, over that of
`oracle` and at most four, plus the share of flights without success: later than 1.25 times `oracle`, or a rotor at its
limit for more than 5 % of the time. Bounds are those of the benchmark, whose draw 4711 flies here and in no table. Of
an oracle it is the mean of that time in seconds, for these bounds and for three tenths of them. Every set is written to
the log, one line of JSON each: its tuning, its cost, and the cost's parts.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import functools
import json
import math
import multiprocessing
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
from mjxball.bench.draw import groups_of, with_perfect_sensors
from mjxball.bench.tracks import TRACKS
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
LATER, LIMITED = 1.25, 0.05  # of a success: time over that of `oracle`, share of time with a rotor at its limit
ORACLES = ("oracle", "crazyflie-oracle")  # of ideal attitude loops, of Crazyflies
WORST = 4.0  # times that of `oracle` a flight counts at most
SETS, ROUNDS, WIDTH, FLIGHTS = 24, 40, 0.25, 24


class Part(NamedTuple):
    """n flights on one plant."""

    config: Config
    scenarios: Sequence[Scenario]
    bounds: np.ndarray  # (n,) [m]
    conditions: np.ndarray  # (n,) the name of each flight's

    @property
    def strict(self) -> Part:
        """Those with smaller bounds, for the search of an oracle."""
        return self.undisturbed._replace(bounds=STRICT * self.bounds)

    @property
    def undisturbed(self) -> Part:
        """The same flights as `oracle` flies them."""
        return self._replace(scenarios=[with_perfect_sensors(one) for one in self.scenarios])


class Measured(NamedTuple):
    """What S sets did in n flights, (S, n) each."""

    time: np.ndarray  # after which |e_o| stays within the bound, infinite if it does not [s]
    limited: np.ndarray  # share of time with any rotor at its limit
    peak: np.ndarray  # largest |e_o| in the last third [m]


def flights_of(tracks: Sequence[str], condition: str, count: int, plants: int | None = None) -> list[Part]:
    """The flights of a search: `count` in each condition on each plant of `tracks`, those that `oracle` succeeds in.

    `plants`: this many of each track, evenly spaced; None: all.
    """
    parts = []
    for track in tracks:
        groups = groups_of(track, DRAW)
        for group in groups if plants is None else groups[:: max(len(groups) // plants, 1)]:
            chosen = [
                one
                for name in CONDITIONS
                if condition in (name, "both")
                for one in [flight for flight in group.flights if flight.condition == name][:count]
            ]
            scenarios = [
                dataclasses.replace(
                    one.scenario,
                    seconds=SECONDS,
                    disturbance=dataclasses.replace(one.scenario.disturbance, seed=number),
                )
                for number, one in enumerate(chosen)
            ]
            bounds, names = np.array([one.radius for one in chosen]), np.array([one.condition for one in chosen])
            parts.append(Part(group.config, scenarios, bounds, names))
    return parts


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
        oracle.Oracle.tuning, lambda config, tuning: oracle.gains(config, tuning, (1.0,))[0], _with("gains", "oracle")
    ),
    "mpc": Tuned(mpc.Mpc.tuning, None, mpc.Mpc),
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
                carry, row = control_step(loop, controller, privileged, load, carry, now, np.float32(0.0))
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


def fly_all(name: str, part: Part, tunings: Sequence[Any], flown: Flown | None, pool: Executor) -> Measured:
    """What all `tunings` do in the flights of `part`; `flown` is None where there is no compiled program."""
    if flown is None:
        each = pool.map(functools.partial(_simulate, name, part), tunings)
        return Measured(*(np.stack(column) for column in zip(*each, strict=True)))
    found = list(pool.map(functools.partial(_design, name, part.config), tunings))
    return flown(jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf, np.float32) for leaf in leaves]), *found))


def _design(name: str, config: Config, tuning: Any) -> Any:
    arrays = TUNED[name].arrays
    assert arrays is not None
    return arrays(config, tuning)


def _simulate(name: str, part: Part, tuning: Any) -> Measured:
    """(n,) each: the flights of one tuning, in NumPy."""
    config = part.config
    follower = Baseline(TUNED[name].make(config, tuning), config)
    flight = simulate_batch(config, [(follower, part.scenarios)], "newton-euler")
    far = np.where(flight.diverged, np.inf, np.linalg.norm(flight.error, axis=-1))
    most = rotor_limits(config.plant, part.scenarios)[..., None]
    near = near_limit(AT_LIMIT_WITHIN, flight.rotor_force, most).max(axis=(-2, -1))
    outside, rows = ~(far <= part.bounds), np.arange(1, len(far) + 1)[:, None]
    last = (outside * rows).max(axis=0)
    seconds = np.where(last == len(far), np.inf, np.maximum(last, 1) * config.timing.control_period)
    return Measured(seconds, near.mean(axis=0), far[2 * len(far) // 3 :].max(axis=0))


class Search:
    """The cost of sets of one controller on all parts, and its log."""

    def __init__(self, name: str, parts: Sequence[Part], log: Path | None, pool: Executor):
        self.tuned, self._name, self._log, self._pool = TUNED[name], name, log, pool
        self._threads = ThreadPoolExecutor(2 * len(parts))  # which compile and fly all plants at once
        both = [kind for part in parts for kind in (part.undisturbed, part.strict)]
        self._parts = both if name in ORACLES else list(parts)
        compiled = self.tuned.arrays is not None
        self._flown = [Flown(name, part) if compiled else None for part in self._parts]
        self._known = [None] * len(both) if name in ORACLES else list(self._threads.map(known, parts))
        self._begun = time.perf_counter()

    def __call__(self, sets: np.ndarray) -> np.ndarray:
        """(S,) costs of `sets` (S, k), values of what is `searched`."""
        tunings = [tuned(self.tuned.start, values) for values in sets]
        flown = self._threads.map(
            lambda part, fly: fly_all(self._name, part, tunings, fly, self._pool), self._parts, self._flown
        )
        numbers = [numbers_of(*both) for both in zip(flown, self._known, strict=True)]
        of_flights = {name: np.concatenate([one[name] for one in numbers], axis=1) for name in numbers[0]}
        conditions = np.concatenate([part.conditions for part in self._parts])
        parts = {
            name: {key: values[:, conditions == name] for key, values in of_flights.items()}
            for name in dict.fromkeys(conditions)
        }
        for number, tuning in enumerate(tunings):
            record = {name: summary({k: v[number] for k, v in own.items()}) for name, own in parts.items()}
            cost = round(float(of_flights["cost"][number].mean()), 4)
            self._write({"cost": cost, "tuning": tuning._asdict(), **record})
        return np.asarray(of_flights["cost"].mean(axis=1))

    def _write(self, record: dict[str, Any]) -> None:
        if self._log:
            seconds = round(time.perf_counter() - self._begun, 1)
            with self._log.open("a") as file:
                file.write(json.dumps({"controller": self._name, "seconds": seconds, **record}) + "\n")


def known(part: Part) -> Measured:
    """The flights of `oracle`."""
    name = ORACLES[part.config.autopilot.kind == "crazyflie"]
    with ThreadPoolExecutor(1) as alone:
        return fly_all(name, part.undisturbed, [TUNED[name].start], Flown(name, part.undisturbed), alone)


def numbers_of(measured: Measured, known: Measured | None) -> dict[str, np.ndarray]:
    """(S, n) each: cost, time [s], success (0, 1), share of time at limits and peak [m] of every flight."""
    late, limited = np.minimum(measured.time, SECONDS), measured.limited > LIMITED
    if known is None:
        succeeds, ratio = np.isfinite(measured.time) & ~limited, late
    else:
        succeeds = (measured.time <= LATER * known.time) & ~limited
        ratio = np.minimum(late / np.minimum(known.time, SECONDS), WORST)
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
    parser.add_argument("--cores", type=int, default=1, help="processes that compute designs, and that fly `mpc`")
    parser.add_argument("--log", type=Path, metavar="FILE", help="JSON lines, added to")
    options = parser.parse_args()
    enable_compilation_cache()
    with (
        ProcessPoolExecutor(options.cores, multiprocessing.get_context("spawn"))
        if options.cores > 1
        else ThreadPoolExecutor(1) as pool
    ):
        parts = flights_of(options.track, options.condition, options.flights, options.plants)
        search = Search(options.controller, parts, options.log, pool)
        start = np.log([getattr(search.tuned.start, name) for name in searched(search.tuned.start)])
        best, least = minimise(lambda sets: search(np.exp(sets)), start, options.width, options.sets, options.rounds)
    found = tuned(search.tuned.start, np.exp(best))
    print(f"{least:.4f}", {name: float(f"{value:.4g}") for name, value in found._asdict().items()})


if __name__ == "__main__":
    main()
