"""Which loads the teams can trim: shares of CG positions x masses, with all drones and with one follower lost.

CG positions are spread evenly over the carrier's disc, masses are those of `MASSES` times the number of drones. A load
is trimmed if `mjxball.plant.trim` finds 15 % margin; a lost follower's rotors stand still. The leader lifts its share
of the load as its hover law asks, which is PD at the goal; or its rotors help like the followers'. Limits are
those of the rotors alone, or of the commands too. The second table gives the rotors of `team4` any size.

    python benchmarks/trim.py --json benchmarks/results/trim.json
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from mjxball.config import Config, Plant, preset, with_plant
from mjxball.plant.trim import largest_margin

TEAMS = ("team3", "team4", "team6")
MASSES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # of the load, for each drone [kg]
RINGS, ANGLES = 5, 12
ROTORS = (8.0, 12.0, 20.0, math.inf)  # largest force of one rotor [N]


def positions(plant: Plant) -> np.ndarray:
    """CG positions (n, 2) [m]: rings of equal area over the carrier's disc, and O."""
    radii = plant.object_size[0] / 2 * np.sqrt((np.arange(RINGS) + 0.5) / RINGS)
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    rings = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.vstack([[(0.0, 0.0)], rings.reshape(-1, 2)])


def margins(rig: Plant | Config, lost: tuple[int, ...], leader_helps: bool) -> np.ndarray:
    """Largest margin of every mass and CG position (masses, positions); the first position is O."""
    plant = rig if isinstance(rig, Plant) else rig.plant
    return np.array(
        [
            [largest_margin(rig, mass * plant.count, cg, None, lost, leader_helps).margin for cg in positions(plant)]
            for mass in MASSES
        ]
    )


def losses(rig: Plant | Config, leader_helps: bool) -> np.ndarray:
    """`margins` with each follower lost in turn (followers, masses, positions)."""
    plant = rig if isinstance(rig, Plant) else rig.plant
    return np.array([margins(rig, (number,), leader_helps) for number in plant.followers])


def shares(found: np.ndarray, margin: float) -> dict[str, float]:
    """Shares of loads with `margin`, and the largest margin of one."""
    return {"with margin": float((found >= margin).mean()), "without": float((found >= 0).mean())}


def measure(name: str, rig: Plant | Config, leader_helps: bool, margin: float) -> dict[str, object]:
    """One row of the first table."""
    each = losses(rig, leader_helps)
    return {
        "plant": name,
        "limits": "rotors" if isinstance(rig, Plant) else "commands",
        "leader": "helps" if leader_helps else "hover law",
        "loads": each[0].size,
        "all drones": shares(margins(rig, (), leader_helps), margin),
        "one follower lost": shares(each, margin),
        "any one lost": shares(each.min(axis=0), margin),
    }


def resized(plant: Plant, largest: float, margin: float) -> dict[str, object]:
    """One row of the second table: the leader flies its hover law, one follower is lost."""
    each = losses(replace(plant, rotor_force_max=largest), False)
    return {
        "rotor_force_max": "any" if math.isinf(largest) else largest,
        "one follower lost": shares(each, margin),
        "any one lost": shares(each.min(axis=0), margin),
        "largest margin that any one leaves": float(each.min(axis=0).max()),
        "largest margin of CG at O": float(each[..., 0].max()),
    }


def main() -> None:
    """Print both tables and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    started, paper = time.process_time(), preset("paper")
    teams, margin = {name: with_plant(paper, name) for name in TEAMS}, paper.scenario.trim_margin
    kinds = ("all drones", "one follower lost", "any one lost")
    rows, sizes = [], []
    print(f"shares of loads that can be trimmed with a margin of {margin:g} (in brackets: with none)")
    print(f"{'plant':>6} {'leader':>10} {'limits':>9}" + "".join(f"{kind:>20}" for kind in kinds))
    for helps in (False, True):
        for name, rig in ((name, rig) for name, team in teams.items() for rig in (team.plant, team)):
            row = measure(name, rig, helps, margin)
            rows.append(row)
            figures = "".join(f"{row[kind]['with margin']:>12.1%} ({row[kind]['without']:5.1%})" for kind in kinds)
            print(f"{name:>6} {row['leader']:>10} {row['limits']:>9}{figures}", flush=True)
    print("team4, one follower lost, leader on its hover law")
    print(f"{'rotors':>8}{'one lost':>20}{'any one lost':>20}{'largest margin':>16}{'CG at O':>10}")
    for largest in ROTORS:
        row = resized(teams["team4"].plant, largest, margin)
        sizes.append(row)
        figures = "".join(f"{row[kind]['with margin']:>12.1%} ({row[kind]['without']:5.1%})" for kind in kinds[1:])
        best = f"{row['largest margin that any one leaves']:16.3f}{row['largest margin of CG at O']:10.3f}"
        print(f"{row['rotor_force_max']:>8}{figures}{best}", flush=True)
    print(f"{time.process_time() - started:.0f} CPU s")
    if options.json:
        found = {"margin": margin, "masses": MASSES, "rows": rows, "team4, rotors": sizes}
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
