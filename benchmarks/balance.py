"""Level by level against every other follower: is one policy the best, or nearly, wherever it may fly?

`python benchmarks/balance.py POLICY.npz ... [--json FILE]`

levels.json has 80 levels of difficulty with three flights each, frozen: later suites of the evaluation do not move
them. The policy, every classical follower but the oracle, and the policies that come with mjxball for this plant fly
all of them. Of medians over the three flights, a failed flight being infinitely bad, it is counted in how many levels
the policy's

- peak, the root of the squared largest errors of the three axes after 20 s, is at most the smallest of the others plus
  1 mm
- rmse is at most the smallest of the others plus 2 %
- settling time is the smallest, or as small as another's.

Followers that are trained or tuned for another purpose are not left out, nor are levels in which everybody is bad.

Further policies, as other seeds of the same training, are compared with the same others, not with each other.

Then the 30 of the 70 cells of cells.py that the follower cannot trim alone if it believes 0.2 kg, undisturbed and with
noise and 40 ms: of every one that any of the others holds below 5 cm, the policy's peak is to be at most the smallest
plus 3 mm. The others are listed with everybody's. Here a peak is the largest of the three axes, as in cells.py.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
from mjxball import config as configs
from mjxball.baselines import LAWS, make_baseline
from mjxball.config import Config, preset
from mjxball.control.followers import Follower
from mjxball.evaluate.benchmark import Score, by_variant, run_benchmark
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.variants import Suite, Variant
from mjxball.policy.file import shipped_policy
from mjxball.reading import parse_json
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario

LEVELS = Path(__file__).parent / "levels.json"
FLIGHTS = 3
RIVALS = ("transport", "robust", "paper")
METRICS = ("peak", "rmse", "settling_time")
HELD, NEAR = 0.05, 0.003  # peak of a cell that somebody holds, and by how much more the policy may have [m]


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
            row["level"],
            flights[0],
            changes,
            flights=tuple(flights),
            waveforms=tupled(row.get("waveforms", [])),
        )
        suites.setdefault(row["suite"], []).append(level)
    return [Suite(name, "frozen", "level", tuple(levels)) for name, levels in suites.items()]


def median(score: Score, name: str) -> float:
    """Over the flights."""
    return score.summary(name).median


def reached(mine: dict[str, float], best: dict[str, float]) -> list[str]:
    """Which of the metrics are as good as wanted; nothing infinite is."""
    bars = {"peak": best["peak"] + 1e-3, "rmse": 1.02 * best["rmse"], "settling_time": best["settling_time"]}
    return [name for name in METRICS if math.isfinite(mine[name]) and mine[name] <= bars[name]]


def beyond_trim(config: Config, policies: list[Follower], rivals: list[Follower]) -> dict[str, list[dict[str, Any]]]:
    """Of each policy: everybody's peaks [m] in the cells of an unknown mass that the follower cannot trim alone."""
    every = [c for c in cells.feasible(config) if c[1] > cells.reach_of(config, c[2], False)]
    rows: dict[str, list[dict[str, Any]]] = {policy.name: [] for policy in policies}
    for disturbed in (False, True):
        common = {"believed_mass": cells.BELIEVED}
        flown = {one.name: cells.fly(one, every, common, disturbed, FLIGHTS) for one in (*policies, *rivals)}
        for policy, (number, cell) in itertools.product(policies, enumerate(every)):
            theirs = {rival.name: flown[rival.name][number]["peak"] for rival in rivals}
            mine, least = flown[policy.name][number]["peak"], min(theirs.values())
            row = {"cell": cell, "disturbed": disturbed, "held": least < HELD, "reached": mine <= least + NEAR}
            rows[policy.name].append(row | {"peaks": {policy.name: mine} | theirs})
    return rows


def show_cells(rows: list[dict[str, Any]], policy: str) -> None:
    """Print what `beyond_trim` found."""
    for disturbed in (False, True):
        held = [row for row in rows if row["held"] and row["disturbed"] == disturbed]
        where = "noise and 40 ms" if disturbed else "undisturbed"
        print(f"beyond trim, {where}: reached in {sum(row['reached'] for row in held)} of {len(held)} that others hold")
        own = sum(row["peaks"][policy] < HELD for row in rows if row["disturbed"] == disturbed)
        print(f"  {policy} holds {own} of {sum(row['disturbed'] == disturbed for row in rows)}")
        for row in rows:
            if row["disturbed"] == disturbed and not (row["held"] and row["reached"]):
                shown = ", ".join(f"{name} {1e3 * peak:.0f}" for name, peak in row["peaks"].items())
                print(f"  {row['cell']} [mm]: {shown}")


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", type=Path, nargs="+")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    config = preset("paper")
    policies = [load_policy(path, config) for path in options.policies]
    own = {policy.name for policy in policies}
    rivals = [make_baseline(name, config) for name in LAWS if name != "oracle"]
    rivals += [load_policy(shipped_policy(name), config) for name in RIVALS]
    rivals = [rival for rival in rivals if rival.name not in own]
    scores = run_benchmark(config, [*policies, *rivals], read_levels(), FLIGHTS, "newton-euler", print)
    others = beyond_trim(config, policies, rivals)
    found = []
    for policy in policies:
        flown = [score for score in scores if score.follower not in own - {policy.name}]
        found.append(compared(flown, policy, rivals) | {"beyond trim": others[policy.name]})
        show_cells(others[policy.name], policy.name)
    if len(found) > 1:
        for name in METRICS:
            counts = sorted(one["reached"][name] for one in found)
            print(f"{name}: reached in {counts[0]} - {statistics.median(counts):g} - {counts[-1]} of the levels")
    if options.json:
        finite = lambda tree: json.loads(json.dumps(tree), parse_constant=lambda _: None)  # noqa: E731
        options.json.write_text(json.dumps(finite(found if len(found) > 1 else found[0]), indent=1) + "\n")


def compared(scores: list[Score], policy: Follower, rivals: list[Follower]) -> dict[str, Any]:
    """Of one policy and the rivals: counts of the levels in which each bar is reached, and every number; printed."""
    rows, firsts = [], {name: dict.fromkeys([policy.name, *(r.name for r in rivals)], 0) for name in METRICS}
    for (suite, level), flown in by_variant(scores).items():
        medians = {score.follower: {name: median(score, name) for name in METRICS} for score in flown}
        mine = medians[policy.name]
        best = {name: min(medians[rival.name][name] for rival in rivals) for name in METRICS}
        holder = {name: min(rivals, key=lambda rival: medians[rival.name][name]).name for name in METRICS}
        for name in METRICS:
            least = min(mine[name], best[name])
            for follower, numbers in medians.items():
                firsts[name][follower] += numbers[name] == least and math.isfinite(least)
        found, failures = reached(mine, best), next(s.failures for s in flown if s.follower == policy.name)
        rows.append({"suite": suite, "level": level, "reached": found, "followers": medians, "failed": failures})
        missed = [f"{name} {mine[name]:.4g} ({holder[name]} {best[name]:.4g})" for name in METRICS if name not in found]
        if missed:
            print(f"{suite}, {level}: {', '.join(missed)}")
    counts = {name: sum(name in row["reached"] for row in rows) for name in METRICS}
    failed = sum(row["failed"] for row in rows)
    print(f"{policy.name}, of {len(rows)} levels: " + ", ".join(f"{name} {n}" for name, n in counts.items()), end="")
    print(f"; {failed} of its {FLIGHTS * len(rows)} flights failed")
    for name, wins in firsts.items():
        print(f"smallest {name}: " + ", ".join(f"{who} {n}" for who, n in wins.items() if n))
    return {"policy": policy.name, "reached": counts, "failed": failed, "smallest": firsts, "levels": rows}


if __name__ == "__main__":
    main()
