"""Flights of ten minutes: each policy on its own plants, its load at rest and moving, beside the same of one minute.

A row is steady if the flight does not fail, no peak later than 20 s is more than 1.5 times that of the shortest flight
and 5 mm, and a rotor is at its limit in less than a fifth of the time. A policy for any rig flies a pair and rings of
three, four and six; one for teams rings of every number of drones between its smallest and its largest. Numbers are
those of docs/metrics.md, computed in float32; ideal sensors. Means over a flight stand beside those over its last 20 s.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from batch import fly_compiled
from harness import Row, arguments, say, write
from mjxball import cli, running
from mjxball import config as configs
from mjxball.config import Config
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.policies import flies_any_rig, load_policy, native_config, team_sizes
from mjxball.evaluate.scenarios import standard_scenarios
from mjxball.plant.teams import ring_config
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policies
from mjxball.sim.scenario import Scenario

MINUTE, TEN = 60.0, 600.0  # [s]
SPEEDS = (0.31, 1.0)  # of the CG [rad/s]
GROWTH, SLACK, LIMITED = 1.5, 0.005, 0.2  # of a steady flight: of its peaks, [m], share of the time
PEAKS = ("x_peak", "y_peak", "z_peak")
MEANS = {"rotors_at_limit": 1, "rotor_power": 1, "command_spread": 2}  # with the power of what is averaged
LAST = 20.0  # [s] of a flight, its end
RIGS = ("pair", "team3", "team4", "team6")  # plants of a policy for any rig


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz", help="default: every shipped one")
    parser.add_argument("--seconds", nargs="+", type=float, default=[MINUTE, TEN], metavar="S")
    options = parser.parse_args(given)
    rows: list[Row] = []
    for path in options.policies or shipped_policies():
        for label, setup in own_plants(path):
            rows += flown(path, label, setup, sorted(options.seconds))
    write(options.json, {"rows": rows})
    return 0


def own_plants(path: Path) -> Iterator[tuple[str, Config]]:
    """(label, configuration) of every plant that a policy file is for."""
    policy = Policy.load(path)
    if flies_any_rig(policy):
        for name in RIGS:
            yield name, cli.plant_setup(Path(name))
        return
    own = native_config(path) or configs.preset("paper")
    sizes = team_sizes(policy)
    for size in range(min(sizes, default=0), max(sizes, default=-1) + 1):
        yield f"ring of {size}", ring_config(own, size)
    if not sizes:
        yield own.preset, own


def own_scenarios(setup: Config, seconds: float) -> list[Scenario]:
    """The plant's reference load at rest, and moving at each of `SPEEDS`; a rolling ball from its start."""
    reference = dataclasses.replace(standard_scenarios(setup)[0], seconds=seconds)
    if setup.motion.kind == "rolling" or not reference.amplitude:
        return [reference]
    return [
        dataclasses.replace(reference, amplitude=0.0),
        *(dataclasses.replace(reference, omega=speed) for speed in SPEEDS),
    ]


def flown(path: Path, label: str, setup: Config, horizons: Sequence[float]) -> list[Row]:
    """One row for each scenario and horizon [s], the shortest first."""
    policy, rows = load_policy(path, setup), list[Row]()
    first: list[Metrics] = []
    for seconds in horizons:
        scenarios, lengths = own_scenarios(setup, seconds), (seconds, seconds - LAST)
        found, shorter = (fly_compiled(setup, policy, own_scenarios(setup, length)) for length in lengths)
        first = first or found
        period = setup.timing.control_period
        rows_of_flight = round(seconds / period) + 1, round(LAST / period)
        for scenario, metrics, before, start in zip(scenarios, found, shorter, first, strict=True):
            numbers = {name: getattr(metrics, name) for name in (*PEAKS, *MEANS, "failed")}
            numbers |= at_end(metrics, before, *rows_of_flight)
            motion = f"{scenario.omega:g} rad/s" if scenario.amplitude else "ball" if scenario.ball_start else "rest"
            row = {"policy": path.stem, "plant": label, "drones": setup.plant.count, "motion": motion}
            rows.append({**row, "seconds": seconds, **numbers, "steady": is_steady(metrics, start)})
            say(rows[-1])
    return rows


def at_end(metrics: Metrics, before: Metrics, rows: int, last: int) -> dict[str, float | None]:
    """Means over the `last` of a flight's `rows`, from its own and those of the rows `before` them."""
    found: dict[str, float | None] = {}
    for name, power in MEANS.items():
        whole, begun = getattr(metrics, name), getattr(before, name)
        known = whole is not None and begun is not None
        mean = (rows * whole**power - (rows - last) * begun**power) / last if known else None
        found[f"{name}_at_end"] = None if mean is None else math.copysign(abs(mean) ** (1 / power), mean)
    return found


def is_steady(metrics: Metrics, start: Metrics) -> bool:
    """Whether a flight holds what its first minute `start` held."""
    limited = metrics.rotors_at_limit
    if metrics.failed or limited is None or limited >= LIMITED:
        return False
    pairs = [(getattr(metrics, name), getattr(start, name)) for name in PEAKS]
    return all(None not in (late, early) and late <= GROWTH * early + SLACK for late, early in pairs)


if __name__ == "__main__":
    raise SystemExit(running.run_command(main))
