"""A drone of a team of five or six stops in flight, any one, the leader too.

Flights are those of the team track of mjxball-bench for a draw that it does not report; besides, the rotors of a random
drone stop at a random time. What nobody could hold is left out: the CG's farthest point must be trimmed with the
benchmark's margin by the drones left, in every direction, with the leader at hover thrust where it flies. A row has,
for one follower and condition, the flights that stay in the air to the end, those of them whose |e_o| stays below
`PEAK` after the loss, the median and the 90 % quantile of the largest |e_o| after it, and of that in the last third;
of the flights that stay in the air the median power over that at the start, the mean time with a rotor at its limit and
the median change of commands (as mjxball-bench has them); then the same flights without a loss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from harness import Row, arguments, follower_of, say, write
from mjxball import running
from mjxball.bench import CONDITIONS
from mjxball.bench.tracks import DIRECTIONS, MARGIN, TRACKS
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics, fly_and_measure
from mjxball.plant.trim import largest_amplitude
from mjxball.sim.scenario import Scenario

DRAW, SIZES, FLIGHTS = 31, (5, 6), 60  # of each size in each condition
TIME = (5.0, 15.0)  # within which the drone stops [s]
PEAK = 0.3  # [m]


class Part(NamedTuple):
    """The flights on one plant in one condition."""

    config: Config
    flights: list[Scenario]
    tried: int  # candidates, those left out included


def sampled(condition: str, draw: int, count: int) -> list[Part]:
    """`count` flights of each size."""
    parts = []
    for own in TRACKS["team"].flights(draw):
        config, size = own.config, own.config.plant.count
        if size not in SIZES:
            continue
        random, flights, tried = np.random.default_rng([draw, size, CONDITIONS.index(condition)]), [], 0
        while len(flights) < count:
            scenario, tried = own.sample(random, condition), tried + 1
            if scenario is None:
                continue
            lost, reach = int(random.integers(size)), scenario.amplitude * math.hypot(1, scenario.path.width)
            left = min(largest_amplitude(config, scenario.mass, MARGIN, way, lost=(lost,)) for way in DIRECTIONS)
            if reach <= left:
                flights.append(replace(scenario, lost=((lost, float(random.uniform(*TIME))),)))
        parts.append(Part(config, flights, tried))
    return parts


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("followers", nargs="+", metavar="FOLLOWER", help="a policy file or a baseline")
    parser.add_argument("--draw", type=int, default=DRAW)
    parser.add_argument("--flights", type=int, default=FLIGHTS, help="of each size in each condition")
    options = parser.parse_args(given)
    rows: list[Row] = []
    for condition in CONDITIONS:
        parts = sampled(condition, options.draw, options.flights)
        kept = sum(len(part.flights) for part in parts) / sum(part.tried for part in parts)
        for name in options.followers:
            rows.append(
                {"follower": name.rpartition("/")[2].removesuffix(".npz"), "condition": condition, "kept": kept}
            )
            rows[-1] |= flown(name, parts)
            say(rows[-1])
    write(options.json, {"rows": rows})
    return 0


def flown(name: str, parts: Sequence[Part]) -> Row:
    """What follower `name` does in all flights."""
    lost: list[np.ndarray] = []
    whole: list[np.ndarray] = []
    led: list[bool] = []
    all_metrics: list[Metrics] = []
    for part in parts:
        follower = follower_of(name, part.config)
        found, metrics = errors(part.config, follower, part.flights)
        lost, all_metrics = lost + found, all_metrics + metrics
        whole += errors(part.config, follower, [replace(one, lost=()) for one in part.flights])[0]
        led += [one.lost[0][0] == part.config.plant.leader for one in part.flights]
    peak = np.array([error.max() for error in lost])
    late = latest(lost)
    flies = np.isfinite(peak)
    sound = [one for one, up in zip(all_metrics, flies, strict=True) if up]
    return {
        "flights": len(peak),
        "in_air": int(flies.sum()),
        "without_leader": f"{int(flies[np.array(led)].sum())}/{sum(led)}",
        "below_peak": int((peak <= PEAK).sum()),
        "peak": float(np.median(peak)),
        "peak_90": float(np.quantile(peak, 0.9, method="higher")),
        "late": float(np.median(late)),
        "late_90": float(np.quantile(late, 0.9, method="higher")),
        "rotor_power": float(np.median([one.rotor_power for one in sound])) if sound else None,
        "rotor_limit_share": float(np.mean([one.rotor_limit_share for one in sound])) if sound else None,
        "command_change": float(np.median([one.smoothness for one in sound])) if sound else None,
        "whole_in_air": int(sum(np.isfinite(error.max()) for error in whole)),
        "whole_late_90": float(np.quantile(latest(whole), 0.9, method="higher")),
    }


def latest(flights: Sequence[np.ndarray]) -> np.ndarray:
    """The largest |e_o| in the last third of each flight [m]."""
    return np.array([error[-len(error) // 3 :].max() for error in flights])


def errors(config: Config, follower: Follower, flights: Sequence[Scenario]) -> tuple[list[np.ndarray], list[Metrics]]:
    """|e_o| [m] of each flight from the loss on, or from the earliest, infinite once it has crashed; its metrics."""
    record, metrics = fly_and_measure(config, [(follower, flights)], "newton-euler")
    far = np.linalg.norm(record.error, axis=-1)
    crashed = np.logical_or.accumulate(record.diverged | (far > config.scenario.termination_distance), axis=0)
    far = np.where(crashed, np.inf, far)
    begins = [one.lost[0][1] if one.lost else TIME[0] for one in flights]
    return [far[record.time >= begin, number] for number, begin in enumerate(begins)], metrics


if __name__ == "__main__":
    raise SystemExit(running.run_command(main))
