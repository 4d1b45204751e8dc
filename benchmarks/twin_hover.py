"""Hover of two Crazyflies on the software twin: learned and classical followers in the same conditions.

`python -m mjxfly FOLLOWER --rehearse` in virtual time (`virtual_twin.py`): take-off, 20 s at 0.4 m, landing. The load
moves by 1 cm at 0.9 rad/s, in the middle of the preset's range. Errors of O are those from 5 s after both controllers
took over; sideways is its largest horizontal distance from the start before that. Of every number the worst of the
seeds is kept.
"""

from __future__ import annotations

import math
import multiprocessing
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from harness import Row, arguments, say, table, write
from mjxball.control.crazyflie import FULL
from mjxball.export import in_team
from mjxball.policy import Policy, PolicyFile, policy_path
from mjxball.policy.file import load_file, save_file
from mjxball.running import run_command
from mjxfly.app.host import compile_pair
from mjxfly.classical import NAMES as CLASSICAL
from mjxfly.classical import ClassicalFollower
from mjxfly.controller import FlightController
from mjxfly.limits import FlightSettings
from mjxfly.policy_setup import drone_of, goal_of, load_follower
from mjxfly.twin.conditions import Surroundings, drone_kind
from virtual_twin import VirtualTwin

SECONDS, SETTLED = 20.0, 5.0
SETTLE = 1.0  # at rest before take-off, in which the estimators converge with poses at 20 Hz too [s]
CASES = {
    "as delivered": Surroundings(),
    "10 ms each way": Surroundings(delay=0.01),
    "noise x 3": Surroundings(noise=3.0),
    "pose at 20 Hz": Surroundings(pose_hz=20.0),
    "thrust -5/+5 %": Surroundings(gains=(0.95, 1.05)),
    "thrust -8/+8 %": Surroundings(gains=(0.92, 1.08)),
    "thrust -5/-5 %": Surroundings(gains=(0.95, 0.95)),
}
LONGER = {f"{1e3 * delay:.0f} ms each way": Surroundings(delay=delay) for delay in (0.02, 0.04)}  # only if asked for
DRONES = {  # plant of each of the twin's drones
    "2.1": "crazyflie",
    "thrust-upgrade": "crazyflie-thrust-upgrade",
    "brushless": "crazyflie-brushless",
}
FOLLOWERS = ("flight", "universal", *CLASSICAL)
WORST = ("rms", "largest", "sideways", "tilt", "limit", "change", "touchdown")


def flown(case: str, follower: str, plant: str, seed: int, onboard: str = "") -> Row:
    """One flight; `onboard`: weights (float32, int8) of controllers on the drones."""
    one = of_pair(follower, plant)
    config = FlightController(one).config
    world = VirtualTwin(
        one,
        settings := FlightSettings(seconds=SECONDS, goal=goal_of(config)),
        kind=drone_kind(drone_of(config)),
        surroundings=replace((CASES | LONGER)[case], seed=seed),
        settle=SETTLE,
        cores=compile_pair(pair_file(follower, plant), "follower", onboard == "int8") if onboard else None,
    )
    end = world.run()
    flying = [moment for moment in world.track if moment.state == "fly"]
    if not flying:
        return {"end": "not flown", **dict.fromkeys(WORST, math.inf)}
    begun = flying[0].time
    late = [moment for moment in flying if moment.time > begun + SETTLED]
    goal = np.array(goal_of(config)) + np.array([0.0, 0.0, world.rest])
    errors = np.array([np.linalg.norm(moment.position - goal) for moment in late])
    early = np.array([moment.position[:2] for moment in world.track if moment.time <= begun + SETTLED])
    ticks = [record for record in world.log.records if record["kind"] == "tick" and record["state"] == "fly"]
    sent = [] if onboard else [record["sent"][1].roll for record in ticks if record["t"] > begun + SETTLED]
    pwm = np.array([moment.pwm for moment in late])
    return {
        "end": end if len(flying) * settings.period > SECONDS - 1 else "not all flown",
        "rms": float(np.sqrt((errors**2).mean())),  # [m]
        "largest": float(errors.max()),  # [m]
        "sideways": float(np.hypot(*early.T).max()),  # [m]
        "tilt": float(max(moment.tilt for moment in late)),  # [rad]
        "limit": float((pwm >= FULL).mean(axis=0).max()),  # share of the time of the motor that is longest at one
        # Of the follower's roll from step to step [rad]; the drones do not record it.
        "change": float(np.sqrt((np.diff(np.radians(sent)) ** 2).mean())) if sent else math.nan,
        "touchdown": world.touchdown_speed(),  # [m/s]
    }


def of_pair(follower: str, plant: str) -> Policy | ClassicalFollower:
    """The follower, for the pair of `plant`."""
    path = policy_path(follower)
    if follower in CLASSICAL:
        return load_follower(path, Path(plant))
    with tempfile.TemporaryDirectory() as folder:
        exported = Path(folder) / path.name
        save_file(exported, pair_file(follower, plant))
        return load_follower(exported)


def pair_file(follower: str, plant: str) -> PolicyFile:
    """The policy, for the pair of `plant`."""
    path = policy_path(follower)
    return in_team(load_file(path), path.stem, Path(plant))


def main(given: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = arguments(__file__, __doc__ or "")
    parser.add_argument("--drones", nargs="+", choices=DRONES, default=list(DRONES), help="kinds (all)")
    parser.add_argument("--followers", nargs="+", default=FOLLOWERS, help="policies and classical ones (all shipped)")
    parser.add_argument(
        "--cases",
        nargs="+",
        choices=tuple(CASES | LONGER),
        default=list(CASES),
        help="conditions (all but the longest delays)",
    )
    parser.add_argument("--onboard", choices=("float32", "int8"), default="", help="controllers' weights on the drones")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="flights of each (2)")
    options = parser.parse_args(given)
    cases = [
        (drone, case, follower, DRONES[drone])
        for drone in options.drones
        for case in options.cases
        for follower in options.followers
    ]
    rows: list[Row] = []
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        flights = {
            (*one, seed): pool.submit(flown, *one[1:], seed, options.onboard)
            for one in cases
            for seed in range(options.seeds)
        }
        for one in cases:
            found = [flights[*one, seed].result() for seed in range(options.seeds)]
            ends = ", ".join(sorted({flight["end"] for flight in found}))
            worst = {name: max(flight[name] for flight in found) for name in WORST}
            rows.append({**dict(zip(("drone", "case", "follower"), one, strict=False)), "end": ends, **worst})
            say(rows[-1])
    table(rows)
    write(options.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
