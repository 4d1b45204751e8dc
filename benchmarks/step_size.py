"""How far a flight moves when the physics step grows: the copy follower for 20 s against a reference of 0.2 ms.

`python benchmarks/step_size.py [--json FILE]` prints millimetres for every step and CG speed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from mjxball import config
from mjxball.baselines import make_baseline
from mjxball.sim.rollout import Trajectory, simulate_batch
from mjxball.sim.scenario import Scenario

OMEGAS = (0.31, 0.62, 1.0, 2.0, 3.1)  # [rad/s]
REFERENCE_STEPS = 100  # physics steps in a control period of 20 ms: 0.2 ms
PHYSICS_STEPS = (20, 10, 8, 5, 4)  # 1, 2, 2.5, 4, 5 ms
SECONDS = 20.0


def fly(physics_steps: int) -> Trajectory:
    """Flights (time, omega) of the copy follower on the `paper` plant with the closed-form engine."""
    setup = config.replace(config.preset("paper"), "timing.physics_steps", physics_steps)
    scenarios = [Scenario(omega=omega, seconds=SECONDS) for omega in OMEGAS]
    return simulate_batch(setup, [(make_baseline("copy", setup), scenarios)], "newton-euler")


def measure() -> list[dict[str, float]]:
    """One row per step size and CG speed: the largest distance of O from the reference flight [m]."""
    reference = fly(REFERENCE_STEPS).position
    rows = []
    for count in PHYSICS_STEPS:
        distance = np.linalg.norm(fly(count).position - reference, axis=-1).max(axis=0)
        step = config.preset("paper").timing.control_period / count
        for omega, value in zip(OMEGAS, distance, strict=True):
            rows.append({"physics_step": step, "omega": omega, "position_difference": float(value)})
    return rows


def table(rows: list[dict[str, float]]) -> str:
    """Millimetres, one line per step."""
    lines = ["step ms  " + "".join(f"{f'{omega:g} rad/s':>12}" for omega in OMEGAS) + f"{'largest':>12}"]
    for step in dict.fromkeys(row["physics_step"] for row in rows):
        values = [1e3 * row["position_difference"] for row in rows if row["physics_step"] == step]
        lines.append(f"{1e3 * step:7.1f}  " + "".join(f"{value:12.3f}" for value in [*values, max(values)]))
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    options = parser.parse_args()
    rows = measure()
    print("largest distance [mm] of O from the 0.2 ms flight, copy follower, 20 s")
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps({"reference_step": 0.0002, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
