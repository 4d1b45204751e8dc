"""A Crazyflie's gains by the names of its firmware's parameters: what a gain file holds and a flight uploads."""

from __future__ import annotations

import dataclasses
from typing import Any

from mjxball.config import Autopilot

# "pid_attitude.roll_kp" -> (field of `Autopilot`, place in it)
PARAMETERS: dict[str, tuple[str, int]] = {
    f"{group}.{axis}_{gain}": (f"{axis}{suffix}", place)
    for group, suffix in (("pid_attitude", ""), ("pid_rate", "_rate"))
    for axis in ("roll", "pitch", "yaw")
    for place, gain in enumerate(("kp", "ki", "kd"))
}
STOCK = Autopilot()  # as delivered


def gains_of(autopilot: Autopilot) -> dict[str, float]:
    """The firmware parameters that make a drone's cascade that of `autopilot`."""
    return {name: getattr(autopilot, field)[place] for name, (field, place) in PARAMETERS.items()}


def with_gains(autopilot: Autopilot, gains: dict[str, float]) -> Autopilot:
    """`autopilot` with `gains`, whose names must be those of `PARAMETERS`."""
    changed: dict[str, Any] = {}
    for name, value in gains.items():
        field, place = PARAMETERS[name]
        values = list(changed.get(field, getattr(autopilot, field)))
        values[place] = float(value)
        changed[field] = tuple(values)
    return dataclasses.replace(autopilot, **changed)


def with_stock_gains(autopilot: Autopilot) -> Autopilot:
    """`autopilot` with the gains that a firmware starts with."""
    return with_gains(autopilot, gains_of(STOCK))
