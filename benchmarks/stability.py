"""How stable a policy is: eigenvalues and delay margins about hover, and thousands of random flights.

`python benchmarks/stability.py POLICY.npz [--flights N] [--seed N] [--unknown] [--json FILE] [--picture FILE.png]`

- For a grid of CG offsets and object masses that one drone can trim: the spectral radius of leader, policy and plant
  over one control step about hover (below 1: small errors die out), the time constant that goes with it, and the
  largest delay of the follower's measurements, in whole control steps, that keeps it below 1. LQG, adaptive beside it.
- Random feasible flights: CG speed, amplitude, phase, mass, goal, start position, velocity and tilt, all uniform. None
  may fail. The ten with the largest steady-state peak are listed and drawn.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from hover_stability import delay_margins, linearised_hovers
from mjxball.baselines import make_baseline
from mjxball.config import Config, preset
from mjxball.control.constants import trim_limit
from mjxball.control.followers import Follower
from mjxball.evaluate.batch import Batch, law_of
from mjxball.evaluate.policies import load_policy
from mjxball.plotting import pyplot
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import Scenario

OFFSETS = (-0.17, -0.1, -0.05, 0.0, 0.05, 0.1, 0.17)
MASSES = (0.1, 0.2, 0.4, 0.6)
MARGIN = 0.15
LONGEST = 10  # control steps of delay that are tried


def grid(config: Config, unknown: bool) -> list[tuple[float, float, float]]:
    """(CG offset, mass, believed mass) of every hover that one drone can trim."""
    return [
        (offset, mass, 0.2 if unknown else mass)
        for mass in MASSES
        for offset in OFFSETS
        if abs(offset) <= trim_limit(config.plant, mass, MARGIN, 0.2 if unknown else mass)
    ]


def about_hover(config: Config, follower: Follower, cases: list[Any]) -> list[dict[str, Any]]:
    """One row for each case."""
    found, margins = (
        linearised_hovers(config, law_of(follower), cases),
        delay_margins(config, law_of(follower), cases, LONGEST),
    )
    period = config.timing.control_period
    return [
        {
            "follower": follower.name,
            "offset": hover.offset,
            "mass": hover.mass,
            "radius": hover.radius,
            "time_constant": -period / math.log(hover.radius) if 0 < hover.radius < 1 else None,
            "stable": hover.stable,
            "error": hover.error,
            "delay_margin": margin * period if margin >= 0 else None,
        }
        for hover, margin in zip(found, margins, strict=True)
    ]


def random_scenarios(config: Config, count: int, unknown: bool, seed: int = 0) -> list[Scenario]:
    """Feasible scenarios, uniform in everything."""
    random, scenarios = np.random.default_rng(seed), []
    for _ in range(count):
        mass = float(random.uniform(0.1, 0.35 if unknown else 0.6))
        reach = min(0.17, trim_limit(config.plant, mass, MARGIN, 0.2 if unknown else mass))
        vector = lambda size: tuple(map(float, random.uniform(-size, size, 3)))  # noqa: E731
        scenarios.append(
            Scenario(
                omega=float(random.uniform(0.0, 3.1)),
                amplitude=float(random.uniform(0.0, reach)),
                phase=float(random.uniform(0, 2 * math.pi)),
                mass=mass,
                believed_mass=0.2 if unknown else None,
                goal=vector(1.0),
                start_position=vector(0.3),
                start_velocity=vector(0.3),
                start_tilt=tuple(map(float, random.uniform(-0.15, 0.15, 2))),
            )
        )
    return scenarios


def peak(metrics: Any) -> float:
    """Largest error of any axis after 20 s [m]."""
    return math.inf if metrics.failed else max(metrics.x_peak, metrics.y_peak, metrics.z_peak)


def draw(config: Config, follower: Follower, worst: list[Scenario], path: Path) -> None:
    """The errors of the worst flights over time, one panel each."""
    flown = simulate_batch(config, [(follower, worst)], "newton-euler")
    plt = pyplot()
    figure, axes = plt.subplots(5, 2, sharex=True, figsize=(11, 13), constrained_layout=True)
    for number, (axis, scenario) in enumerate(zip(axes.flat, worst, strict=True)):
        axis.plot(flown.time, 1e3 * flown.error[:, number], linewidth=0.9, label=["x", "y", "z"])
        axis.set_ylim(-150, 150)
        axis.set_title(
            f"{scenario.mass:.2f} kg, CG ±{100 * scenario.amplitude:.1f} cm at {scenario.omega:.2f} rad/s", fontsize=9
        )
        axis.grid(alpha=0.25)
    axes[0, 0].legend(fontsize=8, ncol=3)
    for axis in axes[:, 0]:
        axis.set_ylabel("error [mm]", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--flights", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="of the random flights")
    parser.add_argument("--unknown", action="store_true", help="the hover thrust believes 0.2 kg, whatever the mass")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--picture", type=Path, metavar="FILE.png")
    options = parser.parse_args()
    config = preset("paper")
    policy = load_policy(options.policy, config)
    cases = grid(config, options.unknown)
    rows = []
    for follower in (
        policy,
        make_baseline("adaptive-mass" if options.unknown else "adaptive", config),
        make_baseline("lqg", config),
    ):
        mine = about_hover(config, follower, cases)
        rows += mine
        stable = [row for row in mine if row["stable"]]
        margins = [1e3 * row["delay_margin"] for row in mine if row["delay_margin"] is not None]
        radius, error = max(row["radius"] for row in mine), 1e3 * max(row["error"] for row in mine)
        print(
            f"{follower.name}: stable in {len(stable)} of {len(mine)} hovers, worst radius {radius:.4f}, delay "
            f"margin of the stable {min(margins, default=0):.0f} - {max(margins, default=0):.0f} ms, "
            f"largest standing error {error:.1f} mm"
        )
        for row in mine:
            if not row["stable"]:
                print(f"    not stable: CG {row['offset']:g} m, {row['mass']:g} kg, radius {row['radius']:.4f}")
    scenarios = random_scenarios(config, options.flights, options.unknown, options.seed)
    flown = Batch(config, policy).fly(scenarios)
    failed = sum(metrics.failed for metrics in flown)
    order = sorted(range(len(flown)), key=lambda k: -peak(flown[k]))[:10]
    peaks = [peak(metrics) for metrics in flown]
    middle, high, most = 1e3 * np.quantile(peaks, [0.5, 0.99, 1.0])
    print(
        f"{len(flown)} random flights of {policy.name}: {failed} failed; peak median {middle:.1f}, 99 % {high:.1f}, "
        f"largest {most:.1f} mm"
    )
    worst = [scenarios[k] for k in order]
    for k, scenario in zip(order, worst, strict=True):
        print(
            f"    {1e3 * peaks[k]:7.1f} mm: {scenario.mass:.3f} kg, CG {scenario.amplitude:.3f} m at "
            f"{scenario.omega:.2f} rad/s, goal {', '.join(f'{axis:.2f}' for axis in scenario.goal)}"
        )
    if options.picture:
        draw(config, policy, worst, options.picture)
    if options.json:
        sound = sorted(peak for peak in peaks if math.isfinite(peak))
        quantiles = {"median": middle / 1e3, "99 %": high / 1e3, "largest": most / 1e3}
        found = {"hovers": rows, "flights": len(flown), "failed": failed, "peaks [m]": quantiles}
        found["largest peaks"] = sound[-100:]
        options.json.write_text(json.dumps(found, indent=1, default=str) + "\n")


if __name__ == "__main__":
    main()
