"""The pair with its laws on the drones beside the same pair flown from the laptop: radio delay, weights, faults.

`python benchmarks/onboard_flights.py [--parts delay faults] [--policy FILE] [--seeds 3] [--trials 2] [--jobs 1]
[--json FILE]`

The twin in virtual time, as in `fly_firmware.py`; on board it runs the apps' own C, compiled by gcc.

- delay: 20 s at 0.4 m for radio delays each way, laws on the laptop, on board, on board with weights of 8 bits.
- faults: every fault of `fly_faults_virtual.py` on board, a dead laptop and a lost heartbeat among them.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import fly_faults_virtual
from fly_firmware import hover
from mjxball.policy.file import shipped_policy
from virtual_flight import Job, Row, campaign

DELAYS = (0.0, 0.01, 0.02, 0.04)  # [s] each way
WHERE = {"laptop": "", "on board": "float32", "on board, int8": "int8"}


def delayed(path: Path, where: str, delay: float, seed: int) -> list[Row]:
    """One hover."""
    (row,) = hover(path, where, {"delay": delay, "onboard": WHERE[where]}, seed)
    return [{**row, "delay": delay}]


def jobs_of(options: argparse.Namespace) -> Iterator[Job]:
    """(part, function, arguments) of everything that is asked for."""
    for delay in DELAYS if "delay" in options.parts else ():
        for where in WHERE:
            yield from (("delay", delayed, (options.policy, where, delay, seed)) for seed in range(options.seeds))
    for kind in fly_faults_virtual.FAULTS if "faults" in options.parts else ():
        for drone in range(2):
            for number in range(options.trials):
                yield "faults", fly_faults_virtual.fault, (options.policy, kind, drone, number, "float32")


def table(part: str, rows: list[Row]) -> None:
    """Print a part."""
    if part == "faults":
        fly_faults_virtual.table(rows)
        return
    print(f"{'delay ms':>8} {'laws':16} {'RMSE mm':>8} {'tilt deg':>8}  worst of the seeds")
    for delay in DELAYS:
        for where in WHERE:
            own = [row for row in rows if (row["delay"], row["case"]) == (delay, where)]
            worst = [max(row.get(key, math.inf) for row in own) for key in ("rmse", "tilt")]
            print(f"{1e3 * delay:8.0f} {where:16} {worst[0]:8.1f} {worst[1]:8.1f}")


def main() -> int:
    """Run what is asked for; returns 1 if a motor still turned."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=["delay", "faults"])
    parser.add_argument("--policy", type=Path, default=shipped_policy("flight"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--trials", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return campaign("onboard_flights", options, jobs_of(options), table)


if __name__ == "__main__":
    sys.exit(main())
