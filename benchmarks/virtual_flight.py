"""Flights of the runner on the twin in virtual time, for the benchmarks: no sockets, no clock."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from mjxball.fly.app.host import Library, compile_pair
from mjxball.fly.card import Controller, goal_of, times_of
from mjxball.fly.limits import FlightSettings, Limits
from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import Surroundings, drone_kind
from mjxball.fly.twin.virtual import MemoryLog, VirtualTwin
from mjxball.policy import Policy, load_file

SETTLE = 1.0  # [s] that estimators get before a flight, as the check before a real one gives them
Row = dict[str, Any]


def settings_of(policy: Policy, seconds: float) -> FlightSettings:
    """What the command line would make of `policy`'s card."""
    config = Controller(policy).config
    goal, stand = goal_of(config), config.plant.stand != "free"
    bounds = Limits().on_stand(goal[2]) if stand else Limits()
    return FlightSettings(seconds, goal, stand=stand, limits=bounds, times=times_of(config))


@functools.cache
def cores_of(path: Path, weights: str) -> tuple[Library, Library]:
    """The apps of the policy in `path`, `weights` float32 or int8."""
    return compile_pair(load_file(path), path.stem, weights == "int8")


def world_of(
    path: Path, seconds: float, curve: str = "linear", record: bool = True, onboard: str = "", **around: Any
) -> VirtualTwin:
    """A flight of the policy in `path` that is about to begin, its laws `onboard` (float32, int8) or on the laptop."""
    policy = Policy.load(path)
    drone = drone_kind("2.1", curve)
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
