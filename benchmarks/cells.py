"""Every cell of CG speed x amplitude x object mass: does a policy beat the best classical follower there?

`python benchmarks/cells.py POLICY.npz [--robust POLICY.npz] [--seeds N] [--json FILE]`

A cell is flown from the origin to (1, 1, 1) m for 45 s, with the mass known to the hover thrust (by POLICY) or believed
to be 0.2 kg (by the robust policy, which adaptive with mass adaptation is then compared with), clean and with noise at
level 1 and 40 ms of delay (robust as well). LQG is always told the plant, but not the delay. Wanted, of medians over
the seeds:

- peak: the largest |e| of any axis after 20 s at most the adaptive follower's plus 3 mm
- overshoot: at most the adaptive follower's
- settling: 2 %, at most LQG's plus 10 % or 0.1 s
- rmse: at most LQG's plus 10 % or 5 mm

Cells in which the follower's pitch torque, 2 (5.5 - T / 4) L, does not hold the object's weight at the CG's largest
offset, and what it must lift alone of a mass that the leader does not know, with 15 % left are infeasible, for every
follower.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from pathlib import Path
from typing import Any

from mjxball.config import Config, preset
from mjxball.control.constants import trim_reach
from mjxball.control.followers import Follower, make_baseline
from mjxball.evaluate.batch import Batch
from mjxball.evaluate.cells import load_policy
from mjxball.scenario import Scenario
from mjxball.sensing import Disturbance

SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)
AMPLITUDES = (0.05, 0.10, 0.17)
MASSES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
MARGIN, BELIEVED = 0.15, 0.2
WANTED = ("peak", "overshoot", "settling", "rmse")


def numbers_of(metrics: Any) -> dict[str, float]:
    """What a cell is judged by; infinite for a flight that failed or never settled."""
    if metrics.failed:
        return dict.fromkeys(WANTED, math.inf)
    peaks = (metrics.x_peak, metrics.y_peak, metrics.z_peak)
    settling = math.inf if metrics.settling_time is None else metrics.settling_time
    return {"peak": max(peaks), "overshoot": metrics.overshoot, "settling": settling, "rmse": metrics.rmse}


def fly(follower: Follower, cells: list[Any], common: dict[str, Any], disturbed: bool, seeds: int) -> list[Any]:
    """Medians over the seeds for every cell."""
    config = preset("paper")
    scenarios = []
    for seed in range(seeds):
        disturbance = Disturbance(noise=1.0, delay=0.04, seed=seed) if disturbed else Disturbance()
        phase = 2 * math.pi * seed / seeds
        scenarios += [
            Scenario(omega=w, amplitude=a, mass=m, phase=phase, disturbance=disturbance, **common) for w, a, m in cells
        ]
    flown = [numbers_of(metrics) for metrics in Batch(config, follower).fly(scenarios)]
    runs = [flown[k * len(cells) : (k + 1) * len(cells)] for k in range(seeds)]
    return [{name: statistics.median(run[i][name] for run in runs) for name in WANTED} for i in range(len(cells))]


def reach_of(config: Config, mass: float, known: bool) -> float:
    """CG offset that can be trimmed [m]."""
    return trim_reach(config.plant, mass, MARGIN, mass if known else BELIEVED)


def wanted(adaptive: dict[str, float], lqg: dict[str, float]) -> dict[str, float]:
    """The largest numbers with which a cell is won."""
    return {
        "peak": adaptive["peak"] + 0.003,
        "overshoot": adaptive["overshoot"],
        "settling": lqg["settling"] + max(0.1, 0.1 * lqg["settling"]),
        "rmse": lqg["rmse"] + max(0.005, 0.1 * lqg["rmse"]),
    }


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--robust", type=Path, help="policy for unknown masses, noise and delay (default: the same)")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    config = preset("paper")
    every = [(w, a, m) for w in SPEEDS for a in AMPLITUDES for m in MASSES]
    clean = load_policy(options.policy, config)
    robust = load_policy(options.robust, config) if options.robust else clean
    rows: list[dict[str, Any]] = []
    for known in (True, False):
        cells = [cell for cell in every if cell[1] <= reach_of(config, cell[2], known)]
        lost = sorted({cell[1:] for cell in every} - {cell[1:] for cell in cells})
        named = ", ".join(f"{a:g} m with {m:g} kg" for a, m in lost)
        print(f"{len(cells)} of {len(every)} cells are feasible, not at any speed: {named}")
        for disturbed in (False, True):
            policy = clean if known and not disturbed else robust
            common = {} if known else {"believed_mass": BELIEVED}
            rivals = ("adaptive" if known else "adaptive-mass", "lqg")
            told = {} if rivals[1] == "lqg" else common
            flown = {
                name: fly(make_baseline(name, config), cells, common, disturbed, options.seeds) for name in rivals[:1]
            }
            flown["lqg"] = fly(make_baseline("lqg", config), cells, told, disturbed, options.seeds)
            mine = fly(policy, cells, common, disturbed, options.seeds)
            where = f"mass {'known' if known else 'unknown'}, {'noise and 40 ms' if disturbed else 'clean'}"
            for i, cell in enumerate(cells):
                bar = wanted(flown[rivals[0]][i], flown["lqg"][i])
                rows.append(
                    {
                        "where": where,
                        "omega": cell[0],
                        "amplitude": cell[1],
                        "mass": cell[2],
                        "policy": policy.name,
                        **{name: mine[i][name] for name in WANTED},
                        rivals[0]: flown[rivals[0]][i],
                        "lqg": flown["lqg"][i],
                        "wins": [name for name in WANTED if mine[i][name] <= bar[name]],
                    }
                )
            these = rows[-len(cells) :]
            counts = ", ".join(f"{name} {sum(name in row['wins'] for row in these)}" for name in WANTED)
            whole = sum(len(row["wins"]) == len(WANTED) for row in these)
            peaks = {
                name: statistics.median(row[name]["peak"] if name != "mine" else row["peak"] for row in these)
                for name in ("mine", rivals[0], "lqg")
            }
            medians = ", ".join(f"{name} {1e3 * value:.1f}" for name, value in peaks.items())
            print(f"{where} ({policy.name}): all four in {whole} of {len(cells)}; {counts}; median peak [mm] {medians}")
            for row in these:
                missed = [name for name in WANTED if name not in row["wins"]]
                if missed:
                    shown = ", ".join(
                        f"{n} {row[n]:.4g} ({rivals[0]} {row[rivals[0]][n]:.4g}, lqg {row['lqg'][n]:.4g})"
                        for n in missed
                    )
                    print(f"    {row['omega']:g} rad/s {row['amplitude']:g} m {row['mass']:g} kg misses {shown}")
    if options.json:
        finite = json.loads(json.dumps(rows, default=str).replace("Infinity", "null"))
        options.json.write_text(json.dumps(finite, indent=1) + "\n")


if __name__ == "__main__":
    main()
