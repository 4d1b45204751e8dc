"""Flights of the runner on the twin in virtual time, for the benchmarks: no sockets, no clock."""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from mjxball.fly.app.host import Library, compile_pair
from mjxball.fly.card import Controller, goal_of, limits_of, times_of
from mjxball.fly.limits import FlightSettings
from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import Surroundings, drone_kind
from mjxball.fly.twin.virtual import MemoryLog, VirtualTwin
from mjxball.policy import Policy, load_file

SETTLE = 1.0  # [s] that estimators get before a flight, as the check before a real one gives them
Row = dict[str, Any]
Job = tuple[str, Callable[..., list[Row]], tuple[Any, ...]]  # part, function, arguments


def settings_of(policy: Policy, seconds: float) -> FlightSettings:
    """What the command line would make of `policy`'s card."""
    config = Controller(policy).config
    goal, stand = goal_of(config), config.plant.stand != "free"
    return FlightSettings(seconds, goal, stand=stand, limits=limits_of(config, goal), times=times_of(config))


@functools.cache
def cores_of(path: Path, weights: str) -> tuple[Library, Library]:
    """The apps of the policy in `path`, `weights` float32 or int8."""
    return compile_pair(load_file(path), path.stem, weights == "int8")


def world_of(
    path: Path, seconds: float, curve: str = "linear", record: bool = True, onboard: str = "", **around: Any
) -> VirtualTwin:
    """A flight of the policy in `path` that is about to begin, its laws `onboard` (float32, int8) or on the laptop.

    The drones are those of its card.
    """
    policy = Policy.load(path)
    drone = drone_kind(Controller(policy).config.autopilot.drone.removesuffix("-legacy") or "2.1", curve)
    surroundings = Surroundings(**around)
    return VirtualTwin(
        policy,
        settings_of(policy, seconds),
        kind=drone,
        surroundings=surroundings,
        log=MemoryLog(record),
        settle=SETTLE,
        cores=cores_of(path, onboard) if onboard else None,
    )


def code_of(world: VirtualTwin) -> int:
    """The exit code that the runner's command would have."""
    flight = world.flight
    return 0 if flight.supervisor.cause is None and flight.lifted and flight.supervisor.state is State.DONE else 1


def cause_of(world: VirtualTwin) -> str:
    """What ended the flight early, empty if nothing did."""
    cause = world.flight.supervisor.cause
    return "" if cause is None else f"{cause.event.name} {cause.detail}"


def campaign(
    script: str, options: argparse.Namespace, jobs: Iterable[Job], table: Callable[[str, list[Row]], None]
) -> int:
    """Run `jobs` in `options.jobs` processes, print each part, write `options.json` as far as it has come.

    The exit code: 1 if a motor still turned after a fault.
    """
    found: dict[str, list[Row]] = {part: [] for part in options.parts}
    jobs = list(jobs)
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for number, (part, rows) in enumerate(pool.imap_unordered(_run, jobs), 1):
            found[part] += rows
            print(f"\r{number} of {len(jobs)}", end="", file=sys.stderr, flush=True)
            if options.json:
                command = f"python benchmarks/{script}.py " + " ".join(sys.argv[1:])
                options.json.write_text(json.dumps({"command": command, **found}, indent=1) + "\n", encoding="utf-8")
    for part, rows in found.items():
        table(part, rows)
    return 0 if all(row["stopped"] for row in found.get("faults", [])) else 1


def _run(job: Job) -> tuple[str, list[Row]]:
    part, function, arguments = job
    return part, function(*arguments)
