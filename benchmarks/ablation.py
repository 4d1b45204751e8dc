"""Success in disturbed flights of a pair if some disturbances are left out, or if a classical follower knows the loops.

`python benchmarks/ablation.py FOLLOWER [FOLLOWER ...]`, policy files or names. Flights are those of a draw of
mjxball-bench, with their deadlines; what is left out has its nominal value. In the last row every follower is made anew
for each flight, with the flight's own attitude loop in place of the nominal one; a policy is not, and flies as before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from harness import Row, arguments, follower_of, say, write
from mjxball import running
from mjxball.bench.draw import Flight, Group, groups_of
from mjxball.bench.evaluation import with_seed
from mjxball.bench.flying import ENGINE
from mjxball.bench.quick import KEY
from mjxball.bench.success import reasons
from mjxball.config import Config
from mjxball.evaluate.metrics import fly_and_measure
from mjxball.sim.scenario import Scenario

TRACK, CONDITION = "pair", "disturbed"
NO_AIR = {"rotor_drag": 0.0, "wind": (0.0, 0.0, 0.0), "floor": None, "download": 0.0}
PARTS: dict[str, Callable[[Scenario], Scenario]] = {
    "nothing": lambda one: one,
    "noise": lambda one: disturbed(one, noise=0.0),
    "slow errors": lambda one: disturbed(one, estimator_drift=0.0),
    "constant errors": lambda one: disturbed(one, offset=0.0),
    "gaps, jitter": lambda one: disturbed(one, gap_rate=0.0, jitter=0.0),
    "delay, lag": lambda one: disturbed(one, delay=0.0, pose_lag=0.0),
    "all of these": lambda one: disturbed(
        one, noise=0.0, estimator_drift=0.0, offset=0.0, gap_rate=0.0, jitter=0.0, delay=0.0, pose_lag=0.0
    ),
    "off-nominal attitude loops": lambda one: replace(one, loop_scale=1.0),
    "other thrusts": lambda one: replace(one, thrust=(), thrust_fade=0.0),
    "air": lambda one: replace(disturbed(one, gust=0.0), **NO_AIR),
}
KNOWN = "nothing; loops known"


def disturbed(scenario: Scenario, **changes: float) -> Scenario:
    """`scenario` with other settings of its `Disturbance`."""
    return replace(scenario, disturbance=replace(scenario.disturbance, **changes))


def without(group: Group, part: Callable[[Scenario], Scenario]) -> Group:
    """The disturbed flights of `group` with scenarios that `part` changes."""
    flights = [one._replace(scenario=part(one.scenario)) for one in group.flights if one.condition == CONDITION]
    return Group(group.config, tuple(flights))


def with_own_loops(config: Config, flight: Flight) -> Group:
    """The same flight of a plant whose nominal attitude loops are the flight's own."""
    scale = flight.scenario.loop_scale
    loops = tuple(scale * one for one in config.attitude.natural_frequency)
    own = replace(config, attitude=replace(config.attitude, natural_frequency=loops))
    return Group(own, (flight._replace(scenario=replace(flight.scenario, loop_scale=1.0)),))


def successes(group: Group, names: Sequence[str]) -> list[float]:
    """Share of successes of each follower in the flights of `group`."""
    config, flights = group
    scenarios = [with_seed(one, KEY, 0) for one in flights]
    radii, deadlines = (np.array([getattr(one, name) for one in flights]) for name in ("radius", "deadline"))
    shares = []
    for name in names:
        _, metrics = fly_and_measure(config, [(follower_of(name, config), scenarios)], ENGINE, radii, deadlines)
        good = [not reasons(one, latest) for one, latest in zip(metrics, deadlines, strict=True)]
        shares.append(sum(good) / len(good))
    return shares


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("followers", nargs="+", metavar="FOLLOWER", help="a policy file or a baseline")
    parser.add_argument("--draw", type=int, default=5001, help="of the flights (default 5001)")
    options = parser.parse_args(given)
    names = options.followers
    (group,) = groups_of(TRACK, options.draw)
    rows: list[Row] = []

    def add(part: str, shares: Sequence[float]) -> None:
        called = [name.rpartition("/")[2].removesuffix(".npz") for name in names]
        rows.append({"left out": part, **dict(zip(called, shares, strict=True))})
        say(rows[-1])

    for part, change in PARTS.items():
        add(part, successes(without(group, change), names))
    flights = without(group, PARTS["nothing"]).flights
    classical = [name for name in names if not name.endswith(".npz")]
    each = [successes(with_own_loops(group.config, one), classical) for one in flights]
    known = dict(zip(classical, np.mean(each, axis=0), strict=True))
    add(KNOWN, [float(known.get(name, rows[0].get(name.rpartition("/")[2].removesuffix(".npz")))) for name in names])
    write(options.json, {"draw": options.draw, "flights": len(flights), "rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(running.run_command(main))
