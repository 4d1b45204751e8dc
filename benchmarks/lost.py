"""Teams that lose a follower in flight: how many flights the rotors that are left can trim, and who holds these.

    python benchmarks/lost.py policies/lost.npz policies/universal.npz --json benchmarks/results/lost.json

Random flights of `team6`: mass, elliptic CG path, goal, which follower's rotors stop and when. A flight counts where
`mjxball.plant.trim` finds 15 % margin at every point of the path with that drone lost, the leader on its hover law. It
is held if |e_o| stays within d_term and is below 5 cm in the last 10 s. Commands may ask for 12 m/s2, as much as these
trims need; `lqg-known-failures` is flown at the usual limit of 6 m/s2 as well. The same flights without a loss say
what the load alone costs.

Of `team4` no loss of one follower can be trimmed with the CG at O by rotors of any size (`benchmarks/trim.py`): the
second table has the largest margin for rotors without a limit, and how fast and how tilted each follower comes down.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import cli
from mjxball.baselines import make_baseline
from mjxball.config import Config, preset, replace, with_plant
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.batch import Batch, Course
from mjxball.evaluate.policies import load_policy
from mjxball.plant.trim import largest_margin
from mjxball.sim.scenario import CgPath, Scenario

FLIGHTS, SECONDS = 200, 40.0
MASSES, AMPLITUDES, SPEEDS, TIMES = (0.05, 0.4), (0.0, 0.3), (0.1, 3.1), (5.0, 15.0)  # [kg] for each drone, [m], ...
POINTS = 24  # of a path
CLASSICAL = ("copy", "adaptive", "adaptive-mass", "lqg", "lqg-offset-free", "lqg-known-failures")
VERTICAL_LIMIT, USUAL_LIMIT = 12.0, 6.0  # of commands [m/s2]
HELD, LAST = 0.05, 10.0  # [m] in the last seconds
COMES_DOWN = 5.0  # [s] after the loss in which team4's descent is measured
ENGINE = "newton-euler"


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = cli.make_parser("python benchmarks/lost.py", __doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz")
    parser.add_argument("--followers", nargs="*", default=CLASSICAL, metavar="NAME", help="baselines (default all)")
    parser.add_argument("--flights", type=int, default=FLIGHTS)
    parser.add_argument("--seed", type=int, default=0, help="of the flights")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.flights < 1:
        raise InputError(f"--flights must be at least 1, not {options.flights}")
    six, four = (with_plant(preset("paper"), name) for name in ("team6", "team4"))
    drawn = flights(six, options.flights, options.seed)
    margins = [margin(six, scenario) for scenario in drawn]
    least = six.scenario.trim_margin
    feasible = [scenario for scenario, left in zip(drawn, margins, strict=True) if left >= least]
    if not feasible:
        raise InputError(f"none of {len(drawn)} flights can be trimmed; draw more")
    shares = {
        "flights": len(drawn),
        "with margin": len(feasible) / len(drawn),
        "without": float(np.mean([left >= 0 for left in margins])),
    }
    print(f"team6: {len(drawn)} flights, {shares['with margin']:.1%} trimmed with a margin of {least:g}", end="")
    print(f" ({shares['without']:.1%} with none)")
    held = table(six, feasible, options.followers, options.policies)
    unlimited = dataclasses.replace(four.plant, rotor_force_max=math.inf)
    best = [largest_margin(unlimited, four.plant.object_mass, (0.0, 0.0), lost=(k,)).margin for k in (1, 2, 3)]
    shown = ", ".join(f"{left:.3f}" for left in best)
    print(f"team4: largest margin with the CG at O and rotors of any size, follower 1, 2, 3 lost: {shown}")
    down = descents(replace(four, "command.vertical_limit", VERTICAL_LIMIT), options.followers, options.policies)
    if options.json:
        found = {"margin": least, "team6": {**shares, "held": held}, "team4": {"margins": best, "descents": down}}
        options.json.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    return 0


def flights(config: Config, count: int = FLIGHTS, seed: int = 0) -> list[Scenario]:
    """Random ones."""
    random, drones = np.random.default_rng(seed), config.plant.count
    drawn = []
    for _ in range(count):
        path = CgPath(random.uniform(0, 2 * math.pi), random.uniform(0, 1), 1.0, math.pi / 2)
        goal = random.uniform(-1, 1, 3)
        drawn.append(
            Scenario(
                omega=random.uniform(*SPEEDS),
                amplitude=random.uniform(*AMPLITUDES),
                mass=drones * random.uniform(*MASSES),
                path=path,
                phase=random.uniform(0, 2 * math.pi),
                goal=(float(goal[0]), float(goal[1]), float(goal[2])),
                seconds=SECONDS,
                lost=((int(random.choice(config.plant.followers)), random.uniform(*TIMES)),),
            )
        )
    return drawn


def margin(config: Config, scenario: Scenario) -> float:
    """The least along the CG's path once the drone is lost."""
    angle, path = 2 * math.pi * np.arange(POINTS) / POINTS, scenario.path
    first = scenario.amplitude * np.sin(angle)
    second = scenario.amplitude * path.width * np.sin(path.ratio * angle + path.lead)
    c, s = math.cos(path.direction), math.sin(path.direction)
    places = np.column_stack([c * first - s * second, s * first + c * second])
    ((lost, _),) = scenario.lost
    return min(largest_margin(config.plant, scenario.mass, place, lost=(lost,)).margin for place in places)


def flying(config: Config, names: Sequence[str], policies: Sequence[Path]) -> list[tuple[Config, Follower]]:
    """Classical followers and policies, each with the configuration that it flies with."""
    made: list[tuple[Config, Follower]] = [(config, make_baseline(name, config)) for name in names]
    for path in policies:
        try:
            made.append((config, load_policy(path, config)))
        except InputError as error:
            print(f"not flown here: {error}")
    return made


def table(
    config: Config, feasible: list[Scenario], names: Sequence[str], policies: Sequence[Path]
) -> list[dict[str, Any]]:
    """What every follower holds, with the loss and without."""
    whole = [dataclasses.replace(scenario, lost=()) for scenario in feasible]
    strong, usual = (replace(config, "command.vertical_limit", limit) for limit in (VERTICAL_LIMIT, USUAL_LIMIT))
    known = [name for name in names if name == "lqg-known-failures"]
    rows = []
    print(f"{'follower':>16}{'limit':>8}{'failed':>10}{'held':>10}{'no loss':>10}{'peak m':>10}{'tilt deg':>10}")
    for setup, follower in [*flying(strong, names, policies), *flying(usual, known, ())]:
        lost, free = (flown(setup, follower, scenarios) for scenarios in (feasible, whole))
        row = {
            "follower": follower.name,
            "vertical_limit": setup.command.vertical_limit,
            "failed": float(np.mean(lost["failed"])),
            "held": float(np.mean(lost["held"])),
            "held without a loss": float(np.mean(free["held"])),
            "median peak of those held": _median(lost["peak"][lost["held"]]),
            "median tilt of those held": _median(lost["tilt"][lost["held"]]),
        }
        rows.append(row)
        peak, tilt = row["median peak of those held"], row["median tilt of those held"]
        shown = "".join("         -" if value is None else f"{value:10.3g}" for value in (peak, tilt))
        shares = "".join(f"{row[key]:10.1%}" for key in ("failed", "held", "held without a loss"))
        print(f"{follower.name:>16}{setup.command.vertical_limit:8g}{shares}{shown}")
        sys.stdout.flush()
    return rows


def flown(config: Config, follower: Follower, scenarios: list[Scenario]) -> dict[str, np.ndarray]:
    """Of every flight: whether it failed and was held, largest |e_o| [m] and tilt [deg] from the loss on."""
    flight = Batch(config, follower, ENGINE).course(scenarios)
    distance = np.linalg.norm(flight.error, axis=-1)
    lost = np.array([scenario.lost[0][1] if scenario.lost else 0.0 for scenario in scenarios])
    after = flight.time[:, None] >= lost
    failed = flight.diverged | ~(distance.max(axis=0) <= config.scenario.termination_distance)
    end = distance[flight.time >= SECONDS - LAST].max(axis=0)
    peak, most = (np.where(after, value, 0.0).max(axis=0) for value in (distance, _tilt(flight)))
    return {"failed": failed, "held": ~failed & (end < HELD), "peak": peak, "tilt": most}


def descents(config: Config, names: Sequence[str], policies: Sequence[Path]) -> list[dict[str, Any]]:
    """How fast and how tilted four drones are within `COMES_DOWN` of the loss of each follower."""
    mass, when = config.plant.object_mass, 5.0
    scenarios = [
        Scenario(amplitude=0.0, mass=mass, goal=(0.0, 0.0, 0.0), seconds=when + COMES_DOWN, lost=((number, when),))
        for number in config.plant.followers
    ]
    rows = []
    for setup, follower in flying(config, names, policies):
        flight = Batch(setup, follower, ENGINE).course(scenarios)
        speed, tilt = np.maximum(-flight.velocity[..., 2], 0.0).max(axis=0), _tilt(flight).max(axis=0)
        rows.append({"follower": follower.name, "descent": speed.tolist(), "tilt": tilt.tolist()})
        shown = "  ".join(f"{v:.2g} m/s {t:.3g} deg" for v, t in zip(speed, tilt, strict=True))
        print(f"{follower.name:>16}  {shown}")
    return rows


def _tilt(flight: Course) -> np.ndarray:
    """Angle between body z and the vertical [deg]."""
    return np.degrees(np.arccos(np.cos(flight.euler[..., 0]) * np.cos(flight.euler[..., 1])))


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
