"""Every cell of CG speed x amplitude x object mass: does a policy beat the best classical follower there?

A cell is flown from the origin to (1, 1, 1) m for 45 s from several CG phases, with the mass known to the hover thrust
or believed to be 0.2 kg (then adaptive adapts its mass), undisturbed and with noise at level 1 and 40 ms of delay.
Wanted, of medians over the phases; who fails in any of them loses the cell:

- peak: the largest |e| of any axis after 20 s at most the adaptive follower's in the same flights plus 3 mm
- overshoot: at most the adaptive follower's in the same flights
- settling: 2 %, at most LQG's plus 10 % or 0.1 s
- rmse: at most LQG's plus 10 % or 5 mm

LQG (`--reference lqg`, or `lqg-slow` with the better filter) always knows the plant. Delay makes `lqg` limit-cycle, so
that settling and rmse are held against undisturbed flights everywhere. Cells in which one drone's pitch torque,
2 (5.5 - T / 4) L, does not hold the object's weight at the CG's largest offset with 15 % left are infeasible, for every
follower. Where the mass is unknown that of the follower must also hold what it lifts alone (`trim_limit`): those cells
are counted apart as well.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from batch import fly_compiled
from bounds import BOUNDS, Bound, limits
from harness import Row, arguments, say, shown, write
from mjxball.baselines import make_baseline
from mjxball.config import Config, preset
from mjxball.control.constants import trim_limit
from mjxball.control.followers import Follower
from mjxball.evaluate.policies import load_policy
from mjxball.running import run_command
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario

SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)
AMPLITUDES = (0.05, 0.10, 0.17)
MASSES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
Cell = tuple[float, float, float]  # CG speed [rad/s], amplitude [m], mass [kg]
EVERY: list[Cell] = [(w, a, m) for w in SPEEDS for a in AMPLITUDES for m in MASSES]
MARGIN, BELIEVED = 0.15, 0.2
WANTED = {"peak": BOUNDS["peak"], "overshoot": Bound(), "settling": BOUNDS["settling"], "rmse": Bound(0.005, 0.1)}
EFFORT = ("rotors_at_limit", "rotor_power")  # see docs/metrics.md


def numbers_of(metrics: Any) -> dict[str, float]:
    """What a cell is evaluated by; infinite for a flight that never settled."""
    settling = math.inf if metrics.settling_time is None else metrics.settling_time
    return {"peak": metrics.axis_peak, "overshoot": metrics.overshoot, "settling": settling, "rmse": metrics.rmse}


def scenarios_of(cells: list[Any], common: dict[str, Any], disturbed: bool, seeds: int) -> list[Scenario]:
    """All cells at the first CG phase, then at the next."""
    scenarios = []
    for seed in range(seeds):
        disturbance = Disturbance(noise=1.0, delay=0.04, seed=seed) if disturbed else Disturbance()
        phase = 2 * math.pi * seed / seeds
        scenarios += [
            Scenario(omega=w, amplitude=a, mass=m, phase=phase, disturbance=disturbance, **common) for w, a, m in cells
        ]
    return scenarios


def medians(flown: list[Any], cells: int) -> list[Row]:
    """Over the seeds for every one of the cells, all infinite where any of its flights failed."""
    found = []
    for i in range(cells):
        runs = flown[i::cells]
        middle = {name: statistics.median(numbers_of(run)[name] for run in runs) for name in WANTED}
        failed = sum(run.failed for run in runs)
        effort = {name: statistics.median(getattr(run, name) for run in runs) for name in EFFORT if not failed}
        found.append({**(dict.fromkeys(WANTED, math.inf) if failed else middle), **effort, "failed": failed})
    return found


def fly_cells(follower: Follower, cells: list[Any], common: dict[str, Any], disturbed: bool, seeds: int) -> list[Any]:
    """`medians` of a follower's flights."""
    return medians(fly_compiled(preset("paper"), follower, scenarios_of(cells, common, disturbed, seeds)), len(cells))


def reach_of(config: Config, mass: float, known: bool) -> float:
    """CG offset that can be trimmed [m]."""
    return trim_limit(config.plant, mass, MARGIN, mass if known else BELIEVED)


def feasible(config: Config) -> list[Cell]:
    """Of `EVERY` cell those that can be trimmed, mass known."""
    return [cell for cell in EVERY if cell[1] <= reach_of(config, cell[2], True)]


def wanted(adaptive: dict[str, float], lqg: dict[str, float]) -> dict[str, float]:
    """The largest numbers with which a cell is won."""
    return limits({**lqg, "peak": adaptive["peak"], "overshoot": adaptive["overshoot"]}, WANTED)


def wins_of(mine: dict[str, float], bar: dict[str, float]) -> list[str]:
    """Which of the four a cell's numbers reach; nothing infinite does."""
    return [name for name in WANTED if math.isfinite(mine[name]) and mine[name] <= bar[name]]


def condition(known: bool, disturbed: bool) -> str:
    """One of the four in words."""
    return f"mass {'known' if known else 'unknown'}, {'noise and 40 ms' if disturbed else 'undisturbed'}"


def show(where: str, name: str, rows: list[Row]) -> Row:
    """Print and return how often each of the four is reached in `rows`."""
    flown = [row for row in rows if not row["failed"]]
    found = {"where": where, "policy": name, "cells": len(rows)}
    found["all four"] = sum(len(row["wins"]) == len(WANTED) for row in rows)
    found |= {key: sum(key in row["wins"] for row in rows) for key in WANTED}
    found["failed"] = sum(row["failed"] for row in rows)
    peaks = {who: statistics.median(row["peaks"][who] for row in rows) for who in rows[0]["peaks"]}
    effort = {key: statistics.median(row[key] for row in flown) if flown else None for key in EFFORT}
    say(found | {f"peak of {who} [mm]": 1e3 * peak for who, peak in peaks.items()} | effort)
    return found | {"median peaks": peaks, "median effort": effort}


def evaluate(
    config: Config, policies: list[Follower], reference: str, cells: list[Cell], seeds: int
) -> tuple[list[Row], list[str]]:
    """(summaries, what is missed) of all policies in all four conditions."""
    calm, summaries, missed = fly_cells(make_baseline(reference, config), cells, {}, False, seeds), [], []
    for known, disturbed in ((True, False), (True, True), (False, False), (False, True)):
        rival = "adaptive" if known else "adaptive-mass"
        common = {} if known else {"believed_mass": BELIEVED}
        where = condition(known, disturbed)
        other = fly_cells(make_baseline(rival, config), cells, common, disturbed, seeds)
        for policy in policies:
            rows = []
            mine = fly_cells(policy, cells, common, disturbed, seeds)
            for cell, own, theirs, best in zip(cells, mine, other, calm, strict=True):
                bar = wanted(theirs, best)
                peaks = {"policy": own["peak"], rival: theirs["peak"], f"{reference}, undisturbed": best["peak"]}
                rows.append({"cell": cell, **own, "bar": bar, "peaks": peaks, "wins": wins_of(own, bar)})
            summaries.append(show(where, policy.name, rows))
            if not known:
                own = [row for row in rows if row["cell"][1] <= reach_of(config, row["cell"][2], False)]
                summaries.append(show(f"{where}, trimmed by the follower alone", policy.name, own))
            missed += [line for row in rows if (line := shortfall(where, policy.name, row))]
    return summaries, missed


def follower_of(name: str, config: Config) -> Follower:
    """Of a policy file, or a classical one."""
    return load_policy(Path(name), config) if name.endswith(".npz") else make_baseline(name, config)


def shortfall(where: str, name: str, row: Row) -> str:
    """What a cell misses, in words."""
    names = [key for key in WANTED if key not in row["wins"]]
    missed = ", ".join(f"{key} {shown(row[key])} (wanted {shown(row['bar'][key])})" for key in names)
    return f"{where}, {name}: {row['cell']} misses {missed}" if names else ""


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("policies", nargs="*", metavar="FOLLOWER", help="a policy file, or a classical one's name")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="CG phases")
    parser.add_argument("--reference", choices=("lqg", "lqg-slow"), default="lqg", help="LQG of settling and rmse")
    options = parser.parse_args(given)
    config = preset("paper")
    cells = feasible(config)
    lost = ", ".join(f"{a:g} m with {m:g} kg" for a, m in sorted({c[1:] for c in EVERY} - {c[1:] for c in cells}))
    print(f"{len(cells)} of {len(EVERY)} cells are feasible, not at any speed: {lost}")
    policies = [follower_of(name, config) for name in options.policies]
    summaries, missed = evaluate(config, policies, options.reference, cells, options.seeds)
    if len(policies) <= 2:
        print("\n".join(missed))
    write(options.json, {"cells": len(cells), "summaries": summaries})
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
