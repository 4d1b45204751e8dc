"""Retraining in flight on the twin: loads that the card does not know, with and without `--retrain`.

`python benchmarks/retrain.py [--loads 4:-60 6:50 ... | --random N] [--seconds 45] [--clock 2] [--steps K]
[--json FILE]`

First `--clock` rehearsals by the clock each with and without `--retrain`: deadlines of the control loop, how long it
took, how many gradient steps that was. Then in virtual time with as many steps (the median, or K; without rehearsals
all), each load (grams, millimetres from O toward the leader) twice from the same seed: the flown policy to the end, and
one that takes over 5 s after the load was identified. Figures are of the truth from there to the end.
`--random N` draws loads instead of those of the list: 3 to 8 g within 12 cm of O, of at most 420 mg m.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import numpy as np

from mjxball.cache import enable_compilation_cache
from mjxball.commands.retrain import FlightReplay, situation
from mjxball.fly import flight_log
from mjxball.fly.card import config_of
from mjxball.fly.limits import FlightSettings
from mjxball.fly.log_schema import decode
from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import AddedLoad, Surroundings
from mjxball.fly.twin.virtual import VirtualTwin
from mjxball.policy import Policy, load_file, shipped_policy
from mjxball.rig.load import LoadWatch
from mjxball.train.fine_tune import MOST_STEPS, FineTuned, FineTuner

ROOT = Path(__file__).parents[1]
POLICY = shipped_policy("flight")
COMES = 14.0  # [s] after the motors first turn: the load
CLOCK_SECONDS = 26.0  # [s] under both laws, by the clock
TAKES = 5.0  # [s] from the identification to the new policy
LOADS = ("6:-40", "4:-60", "4:60", "6:50", "3:120", "8:0", "5:-80", "7:30", "5:0", "6:-70", "7:-20", "5:90")


def read_load(text: str) -> AddedLoad:
    """`GRAMS:MILLIMETRES`."""
    mass, offset = map(float, text.split(":"))
    return AddedLoad(1e-3 * mass, 1e-3 * offset, COMES)


def random_loads(count: int) -> list[str]:
    """Loads that nothing was chosen by, always the same."""
    draw, loads = np.random.default_rng(0), []
    while len(loads) < count:
        grams, place = draw.uniform(3.0, 8.0), draw.uniform(-120.0, 120.0)
        if abs(grams * place) <= 420.0:
            loads.append(f"{grams:.1f}:{place:.0f}")
    return loads


def fly(
    load: AddedLoad, seconds: float, tuner: FineTuner | None, most: int = 0, begin: float = math.inf
) -> dict[str, Any]:
    """One flight in virtual time, fine-tuned in `most` steps; figures from `begin` [s], or from a new policy on."""
    contents = load_file(POLICY)
    world = VirtualTwin(
        Policy(contents, "flown"), FlightSettings(seconds=seconds), surroundings=Surroundings(load=load)
    )
    watch, replay, row = LoadWatch(world.config), FlightReplay(Policy(contents, "again")), {}
    new: Policy | None = None
    read, looked = 0, 0.0

    def successor() -> Policy | None:
        nonlocal new
        due, new = (new, None) if world.now >= begin else (None, new)
        return due

    world.flight.succession._successor = successor
    while world.tick():
        if "found" in row or tuner is None:
            continue
        for record in world.log.records[read:]:
            one = decode(record) if record["kind"] == "state" else record
            watch.take(one)
            replay.take(one)
        read = len(world.log.records)
        if watch.now - looked < 0.5:
            continue
        looked = watch.now
        found = watch.find()
        if found is not None:
            begin = world.now + TAKES
            made: FineTuned = tuner.fine_tune(*situation(found, watch, replay, world.config), 600.0, most)
            new = None if made.contents is None else Policy(made.contents, "fine-tuned")
            row = {
                "found": True,
                "mass": 1e3 * found.mass,
                "moment": 1e6 * found.moment,
                "identified": world.now,
                "steps": made.steps,
                "cost": [made.before, made.after],
                "taken": new is not None,
            }
    return {**row, "begin": begin, **figures(world, begin), "ended": str(world.flight.supervisor.cause or "as planned")}


def figures(world: VirtualTwin, begin: float) -> dict[str, float]:
    """Of the truth under both laws from `begin` [s]: millimetres and milliradians."""
    rows = [one for one in world.track if one.state == State.FLY.value and one.time >= begin]
    if not rows:
        return {}
    goal = world.flight.goal(world.now)  # the landing is over, so that of the flight
    error = 1e3 * (np.array([one.position for one in rows]) - goal)
    tilt = 1e3 * np.array([one.tilt for one in rows])
    rms = lambda values: float(np.sqrt((values**2).mean()))  # noqa: E731
    return {
        "rms": rms(np.linalg.norm(error, axis=1)),
        "along": rms(error[:, 1]),
        "height": rms(error[:, 2]),
        "peak": float(np.linalg.norm(error, axis=1).max()),
        "tilt": rms(tilt),
        "tilt_peak": float(tilt.max()),
    }


def rehearse(load: AddedLoad, seconds: float, retrains: bool) -> dict[str, Any]:
    """One rehearsal by the clock: what its log says of the loop, of retraining and of the flight."""
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "flight.jsonl"
        command = [sys.executable, "-m", "mjxball.fly", str(POLICY), "--rehearse", "--seconds", str(seconds)]
        command += ["--log", str(log), "--twin-load", *map(str, load), *["--retrain"] * retrains]
        around = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, env=around, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
        )
        if not log.exists():
            raise SystemExit(f"the rehearsal ended with {done.returncode}: {done.stderr}")
        records = list(flight_log.read(log))
    end = next(one for one in records if one["kind"] == "end")
    said = [one for one in records if one["kind"] == "retrain"]
    times = {one["what"]: one["t"] for one in said}
    row = {"retrain": retrains, "code": done.returncode, "said": [one["what"] for one in said]}
    row["missed"] = int(re.search(r"(\d+) missed; late", done.stdout)[1])  # type: ignore[index]
    row["p99"], row["largest"] = (
        float(re.search(rf"{name} ([\d.]+) ms", done.stdout)[1]) for name in ("p99", "largest")
    )  # type: ignore[index]
    row["late_while_fine_tuning"] = lateness(records, times)
    handed = times.get("fine-tuned", times.get("kept"))
    row["seconds"] = handed - times["identified"] if handed and "identified" in times else None
    row["steps"] = next((one["numbers"]["steps"] for one in said if one["what"] in ("fine-tuned", "kept")), None)
    return {**row, "flown": end["flown"], "ended": end["cause"] or "as planned"}


def lateness(records: list[Any], times: dict[str, float]) -> float | None:
    """Largest lateness of a tick [ms] between the identification and what came of it."""
    end = times.get("fine-tuned", times.get("kept"))
    if end is None or "identified" not in times:
        return None
    ticks = [one["late"] for one in records if one["kind"] == "tick" and times["identified"] <= one["t"] <= end]
    return 1e3 * max(ticks, default=0.0)


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loads", nargs="+", default=LOADS, metavar="G:MM")
    parser.add_argument("--random", type=int, metavar="N", help="loads drawn at random instead")
    parser.add_argument("--steps", type=int, metavar="K", help="of gradients in virtual time")
    parser.add_argument("--seconds", type=float, default=45.0, help="under both laws")
    parser.add_argument("--clock", type=int, default=2, metavar="N", help="rehearsals by the clock of each kind")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    enable_compilation_cache()
    contents = load_file(POLICY)
    tuner = FineTuner(config_of(contents.card), contents)
    tuner.compile()
    clock = []
    for _ in range(options.clock):
        for retrains in (False, True):
            clock.append(rehearse(read_load(options.loads[0]), CLOCK_SECONDS, retrains))
            print(json.dumps(clock[-1]), flush=True)
    counts = [row["steps"] for row in clock if row["steps"] is not None]
    most = options.steps or (round(statistics.median(counts)) if counts else MOST_STEPS)
    rows = []
    print(f"virtual time, {most} gradient steps")
    print("load g:mm   found g, mg m (true)      cost            retrain   rms  along height   peak   tilt  ended")
    for text in random_loads(options.random) if options.random else options.loads:
        load = read_load(text)
        new = fly(load, options.seconds, tuner, most)
        old = fly(load, options.seconds, None, begin=new["begin"])
        moment = 1e6 * load.mass * load.offset
        rows.append({"load": text, "true_moment": moment, "with": new, "without": old})
        for name, row in (("without", old), ("with" if new.get("taken") else "kept", new)):
            known = f"{row['mass']:.2f} {row['moment']:+5.0f} ({moment:+5.0f})" if "found" in row else ""
            cost = "{:.3f} to {:.3f}".format(*row["cost"]) if "found" in row else ""
            numbers = "".join(f"{row.get(key, math.nan):7.1f}" for key in ("rms", "along", "height", "peak", "tilt"))
            print(f"{text:10s}  {known:22s}  {cost:16s}  {name:8s}{numbers}  {row['ended']}", flush=True)
    if options.json:
        found = {
            "cores": os.cpu_count(),
            "load_average": os.getloadavg()[0],
            "steps": most,
            "virtual": rows,
            "clock": clock,
        }
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
