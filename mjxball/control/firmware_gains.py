"""A Crazyflie's gains by the names of its firmware's parameters: what a gain file holds and a flight uploads."""

from __future__ import annotations

import dataclasses
import math
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
PAIR = ("leader", "follower")

Gains = dict[str, float]  # parameter name -> value
PairGains = tuple[Gains, Gains]  # leader, follower


def gains_of(autopilot: Autopilot) -> Gains:
    """The firmware parameters that make the leader's cascade that of `autopilot`."""
    return {name: getattr(autopilot, field)[place] for name, (field, place) in PARAMETERS.items()}


def pair_gains(autopilot: Autopilot) -> PairGains:
    """Those of leader and follower, whose ki are the leader's times `autopilot.follower_integrals`."""
    leader = gains_of(autopilot)
    share = autopilot.follower_integrals
    return leader, {name: value * share if name.endswith("_ki") else value for name, value in leader.items()}


def read_pair_gains(data: Any) -> PairGains:
    """Gains from JSON: `{"leader": {name: value}, "follower": {name: value}}`, or `{name: value}` for both.

    Raises ValueError if `data` is neither.
    """
    if isinstance(data, dict) and data.keys() == set(PAIR):
        return _sound(data[PAIR[0]]), _sound(data[PAIR[1]])
    return _sound(data), _sound(data)


def to_json(gains: PairGains) -> dict[str, Gains]:
    """What `read_pair_gains` reads."""
    return dict(zip(PAIR, gains, strict=True))


def _sound(data: Any) -> Gains:
    good = isinstance(data, dict) and all(
        name.count(".") == 1 and type(value) in (int, float) and math.isfinite(value) for name, value in data.items()
    )
    if not good:
        raise ValueError("parameter names with finite numbers")
    return {name: float(value) for name, value in data.items()}


def with_gains(autopilot: Autopilot, gains: Gains) -> Autopilot:
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
