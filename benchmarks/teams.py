"""Followers of teams: the load on paths in the plane on rings of 2 to 6 drones.

N x path (circle, Lissajous) x CG speed x amplitude x mass, 30 s from the origin to (1, 1, 1), undisturbed. A
case counts where `mjxball.plant.trim` finds 15 % margin in every direction and the followers' tilt commands reach it.
The bar: peak in the plane at most that of `adaptive` + 3 mm, settling at most that of `lqg` + 10 %. 5 drones are in no
training. With their effort (`effort_of`).
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from batch import fly_compiled
from bounds import Bound, limits
from harness import Row, arguments, say, write
from mjxball import running
from mjxball.baselines import make_baseline
from mjxball.config import Config, preset
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.policies import load_policy
from mjxball.plant import plant_parameters
from mjxball.plant.teams import ring_config
from mjxball.plant.trim import largest_amplitude
from mjxball.sim.scenario import CIRCLE, CgPath, Scenario

SIZES, SPEEDS, AMPLITUDES, MASSES = (2, 3, 4, 5, 6), (0.31, 1.0, 2.0, 3.1), (0.15, 0.3, 0.6), (0.5, 1.0, 1.5)
EIGHT = CgPath(direction=0.7, width=0.5, ratio=2.0, lead=0.3)
REACH = {CIRCLE: 1.0, EIGHT: math.hypot(1.0, EIGHT.width)}  # farthest CG over the amplitude
REFERENCES = ("adaptive", "lqg")  # of the peak, of settling
WANTED = {"plane_peak": Bound(0.003), "settling_time": Bound(relative=0.1), "settling_time_10": Bound(relative=0.1)}
ENGINE = "newton-euler"


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz")
    parser.add_argument("--followers", nargs="+", default=["copy"], metavar="NAME", help="baselines (default copy)")
    parser.add_argument("--sizes", nargs="+", type=int, choices=SIZES, default=SIZES, help="numbers of drones")
    options = parser.parse_args(given)
    write(options.json, {"rows": teams(options.policies, options.followers, options.sizes)})
    return 0


def teams(paths: Sequence[Path], named: Sequence[str], sizes: Sequence[int]) -> list[Row]:
    """Medians and worst cases for every number of drones and every follower, and shares of cases at the bar."""
    rows, base = [], preset("team")
    for count in sizes:
        config = ring_config(base, count)
        radius, nominal = config.plant.object_size[0] / 2, config.plant.object_mass
        cells = [
            Scenario(omega=omega, amplitude=share * radius, mass=factor * nominal, path=path, seconds=30)
            for factor, share, omega, path in itertools.product(MASSES, AMPLITUDES, SPEEDS, (CIRCLE, EIGHT))
        ]
        farthest = {mass: _trimmed(config, mass) for mass in {cell.mass for cell in cells}}
        held = [cell for cell in cells if cell.amplitude * REACH[cell.path] <= farthest[cell.mass]]
        references = {name: fly_compiled(config, make_baseline(name, config), held) for name in REFERENCES}
        for follower in _followers(config, paths, named):
            found = references.get(follower.name) or fly_compiled(config, follower, held)
            rows.append({"drones": count, "follower": follower.name, "cases": len(held), **_row(found, references)})
            say(rows[-1])
    return rows


def _row(found: Sequence[Metrics], references: dict[str, list[Metrics]]) -> Row:
    """Of one follower: failures, medians, and the shares of cases at the bar, by 2 and by 10 % settling times."""

    def of(name: str, runs: Sequence[Metrics] = found) -> np.ndarray:
        values = [None if run.failed else getattr(run, name) for run in runs]
        return np.array([math.inf if value is None else value for value in values])

    best = {name: of(name, references["adaptive" if name == "plane_peak" else "lqg"]) for name in WANTED}
    small, soon, soon_10 = (of(name) <= most for name, most in limits(best, WANTED).items())
    row = {
        "failed": sum(run.failed for run in found),
        "plane_peak_median": float(np.median(of("plane_peak"))),
        "plane_peak_worst": float(of("plane_peak").max()),
        "settling_median": float(np.median(of("settling_time"))),
        "settling_10_median": float(np.median(of("settling_time_10"))),
        "rmse_median": float(np.median(of("rmse"))),
        "small_peak": float(small.mean()),
        **effort_of(found),
    }
    for label, early in (("", soon), ("_10", soon_10)):
        row |= {f"soon{label}": float(early.mean()), f"both{label}": float((small & early).mean())}
    return row


def effort_of(found: Sequence[Metrics]) -> dict[str, float | None]:
    """Of the flights that did not fail: share of the time with a rotor at its limit, power over hover's, spread [rad].

    The spread is the median of rms differences between the followers' tilts and their mean; None of a pair. All are
    None where every flight failed.
    """
    effort: dict[str, float | None] = {}
    for name, middle in (("rotors_at_limit", np.mean), ("rotor_power", np.median), ("command_spread", np.median)):
        values = [getattr(run, name) for run in found if not run.failed and getattr(run, name) is not None]
        effort[name] = float(middle(values)) if values else None
    return effort


def _followers(config: Config, paths: Sequence[Path], named: Sequence[str]) -> list[Follower]:
    return [*(make_baseline(name, config) for name in named), *(load_policy(path, config) for path in paths)]


def _trimmed(config: Config, mass: float) -> float:
    """CG offset [m] that can be trimmed in every direction, and that the followers' tilt commands reach.

    About the axis through a pair's drones the assembly is light, and its attitude gains with it.
    """
    angles = np.linspace(0, math.pi, 12, endpoint=False)
    margin, plant = config.scenario.trim_margin, config.plant
    gain = min(plant_parameters(plant, config.attitude).gains.kp[:2])
    reach = (1 - margin) * len(plant.followers) * gain * config.command.tilt_limit / (plant.gravity * mass)
    return min(reach, *(largest_amplitude(config.plant, mass, margin, (math.cos(a), math.sin(a))) for a in angles))


if __name__ == "__main__":
    sys.exit(running.run_command(main))
