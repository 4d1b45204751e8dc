"""The command map: (roll, pitch, vertical acceleration) of a control law -> setpoint of one drone. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from mjxball.fly.packets import THRUST_CEILING, THRUST_FLOOR, Setpoint, setpoint
from mjxball.fly.thrust import LINEAR, ForceCurve

Array = Any


@dataclass(frozen=True)
class CommandMap:
    """How a drone's command becomes thrust units, and the bounds of every setpoint.

    `paper`: thrust = thr_hov + k_pz az (the paper's experiment). `calibrated`: the force curve at the carried
    mass, T = m (g + az) / (cos roll cos pitch), as in simulation.
    """

    law: Literal["paper", "calibrated"] = "calibrated"
    hover: float = 46000.0  # thr_hov [thrust units], of the paper; calibrate it for every rig
    per_acceleration: float = 1000.0  # k_pz [thrust units per m/s2], of the paper
    carried_mass: float = 0.035  # the drone and its share of the object [kg]
    gravity: float = 9.81  # [m/s2]
    curve: ForceCurve = LINEAR
    tilt_limit: float = math.radians(15)  # of every commanded roll and pitch [rad]
    yaw_gain: float = 0.0  # yaw rate command per yaw error [1/s]; the firmware integrates the yaw rate itself

    @property
    def hover_thrust(self) -> float:
        """Thrust units at level hover."""
        return self.hover if self.law == "paper" else self.curve.thrust(self.carried_mass * self.gravity)


class Mapped(NamedTuple):
    """A setpoint, and whether its thrust was cut at a bound."""

    setpoint: Setpoint
    saturated: bool


def raw_thrust(command: Array, constants: CommandMap) -> float:
    """Thrust units before any bound for `command` = (roll, pitch [rad], vertical acceleration [m/s2])."""
    roll, pitch, vertical = (float(value) for value in command)
    if constants.law == "paper":
        return constants.hover + constants.per_acceleration * vertical
    level = math.cos(roll) * math.cos(pitch)
    return constants.curve.thrust(constants.carried_mass * (constants.gravity + vertical) / level)


def to_setpoint(command: Array, yaw: float, constants: CommandMap) -> Mapped:
    """The bounded setpoint of `command` (3,); `yaw` is the drone's own [rad].

    Raises packets.PacketError if a number is not finite.
    """
    roll, pitch, vertical = (float(value) for value in command)
    if not all(map(math.isfinite, (roll, pitch, vertical))):
        return Mapped(setpoint(roll, pitch, 0.0, vertical), True)  # raises
    limit = constants.tilt_limit
    roll, pitch = (min(max(value, -limit), limit) for value in (roll, pitch))
    wanted = raw_thrust((roll, pitch, vertical), constants)
    thrust = min(max(wanted, THRUST_FLOOR), THRUST_CEILING)
    return Mapped(setpoint(roll, pitch, -constants.yaw_gain * yaw, thrust), thrust != wanted)
