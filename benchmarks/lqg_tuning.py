"""LQG with other weights and filters: which is the best classical follower that is told the plant?

`python benchmarks/lqg_tuning.py [--json FILE]`    (two minutes on one core)

Each tuning flies the 70 feasible cells of `benchmarks/cells.py`, mass known, phase 0, undisturbed and with noise at
level 1 and 40 ms of delay. Medians over the cells, and in how many a flight fails or never settles.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from pathlib import Path
from typing import Any

from cells import feasible
from mjxball.baselines.lqg import Lqg
from mjxball.baselines.lqg_design import SLOW, Tuning
from mjxball.config import preset
from mjxball.control.followers import Baseline
from rivals import fly

SHOWN = ("settling", "peak", "overshoot", "rmse", "smoothness")
TUNINGS = (
    Tuning(),
    SLOW,
    # Weights of position and velocity, and how much tilt they may ask for, with the default filter.
    *(Tuning(position, velocity) for position, velocity in ((0.15, 1.0), (0.15, 0.6), (0.12, 0.4))),
    *(Tuning(0.15, 0.6, tilt_limit=reach) for reach in (0.2, 0.3, 0.4)),
    *(Tuning(0.25, 1.0, tilt_limit=reach) for reach in (0.2, 0.4)),
    *(Tuning(0.1, 0.6, tilt_limit=reach) for reach in (0.25, 0.5)),
    # Slower filters.
    *(Tuning(torque_walk=walk) for walk in (1.0, 0.1, 0.03, 0.01, 0.003, 0.001)),
    *(Tuning(0.15, 0.6, walk) for walk in (1.0, 0.01)),
    *(Tuning(0.12, 0.5, 0.01, reach) for reach in (0.2, 0.25)),
    *(Tuning(0.4, 1.0, walk, 0.2) for walk in (0.003, 0.001, 0.0001)),
    Tuning(0.15, 0.6, 0.003),
    *(Tuning(0.15, 0.6, 0.003, reach) for reach in (0.35, 0.4)),
    Tuning(0.15, 0.7, 0.003, 0.35),
    *(Tuning(0.2, 0.8, 0.003, reach) for reach in (0.3, 0.4)),
    *(Tuning(0.25, 1.0, 0.003, reach) for reach in (0.3, 0.35, 0.4)),
)


def evaluated(tuning: Tuning, disturbed: bool, cells: list[Any]) -> dict[str, Any]:
    """What all cells together say of one tuning."""
    config = preset("paper")
    law = type("TunedLqg", (Lqg,), {"tuning": tuning})(config)
    flown = fly(Baseline(law, config), cells, disturbed)
    row: dict[str, Any] = {key: statistics.median(cell[key] for cell in flown) for key in SHOWN}
    row["unsettled"] = sum(math.isinf(cell["settling"]) for cell in flown)
    row["failed"] = sum(math.isinf(cell["rmse"]) for cell in flown)
    return row


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    config, found = preset("paper"), []
    cells = feasible(config)
    for tuning in TUNINGS:
        for disturbed in (False, True):
            row = evaluated(tuning, disturbed, cells)
            found.append(
                {
                    **tuning._asdict(),
                    "disturbed": disturbed,
                    **{key: None if value == math.inf else value for key, value in row.items()},
                }
            )
            weights = " ".join(f"{value:g}" for value in tuning)
            shown = "  ".join(f"{key} {value:.4g}" for key, value in row.items())
            print(f"{weights:22} {'noise, 40 ms' if disturbed else 'undisturbed':12}  {shown}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
