"""The command map: (roll, pitch, vertical acceleration) of a control law -> setpoint of one drone. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from mjxball.control import crazyflie
from mjxball.fly.packets import THRUST_CEILING, THRUST_FLOOR, Setpoint, setpoint

Array = Any


@dataclass(frozen=True)
class ForceCurve:
    """Force of one motor from p = thrust units / 65535: `quadratic` p^2 + `linear` p [N] (crazyflie.md)."""

    quadratic: float = 0.0  # [N]
    linear: float = 0.12  # [N] Crazyflie 2.1+ with firmware 2026.04 or later

    def force(self, thrust: float) -> float:
        """Force of the four motors of one drone [N] at `thrust` units."""
        return 4 * float(crazyflie.motor_force((self.quadratic, self.linear), thrust))

    def thrust(self, force: float) -> float:
        """Thrust units at which four motors give `force` [N]; not bounded above, 0 for none."""
        return float(crazyflie.motor_command((self.quadratic, self.linear), np.float64(force / 4)))


LINEAR = ForceCurve()
OLDER = ForceCurve(0.0915, 0.0677)  # firmware before 2026.04


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
    tilt_slew: float = math.radians(200)  # [rad/s]
    thrust_slew: float = 120_000.0  # [thrust units/s]
    yaw_gain: float = 0.0  # yaw rate command per yaw error [1/s]; the firmware integrates the yaw rate itself

    @property
    def hover_thrust(self) -> float:
        """Thrust units at level hover."""
        return self.hover if self.law == "paper" else self.curve.thrust(self.carried_mass * self.gravity)


class Mapped(NamedTuple):
    """A setpoint and whether a bound shaped its thrust."""

    setpoint: Setpoint
    saturated: bool


def raw_thrust(command: Array, constants: CommandMap) -> float:
    """Thrust units before any bound for `command` = (roll, pitch [rad], vertical acceleration [m/s2])."""
    roll, pitch, vertical = (float(value) for value in command)
    if constants.law == "paper":
        return constants.hover + constants.per_acceleration * vertical
    level = math.cos(roll) * math.cos(pitch)
    return constants.curve.thrust(constants.carried_mass * (constants.gravity + vertical) / level)


def to_setpoint(command: Array, yaw: float, last: Setpoint, period: float, constants: CommandMap) -> Mapped:
    """The bounded, slew-limited setpoint of `command` (3,), `period` [s] after `last` was sent.

    `yaw` is the drone's own [rad]. Raises packets.PacketError if a number is not finite.
    """
    roll, pitch, vertical = (float(value) for value in command)
    if not all(map(math.isfinite, (roll, pitch, vertical))):
        return Mapped(setpoint(roll, pitch, 0.0, vertical), True)  # raises
    limit = constants.tilt_limit
    roll, pitch = (min(max(value, -limit), limit) for value in (roll, pitch))
    wanted = raw_thrust((roll, pitch, vertical), constants)
    thrust = min(max(wanted, THRUST_FLOOR), THRUST_CEILING)
    slowed = slewed(setpoint(roll, pitch, -constants.yaw_gain * yaw, thrust), last, period, constants)
    return Mapped(slowed, thrust != wanted)


def slewed(value: Setpoint, last: Setpoint, period: float, constants: CommandMap) -> Setpoint:
    """`value`, but no further from `last` than the slew limits allow in `period` [s]."""
    turn, lift = math.degrees(constants.tilt_slew) * period, constants.thrust_slew * period
    roll, pitch = (
        min(max(new, old - turn), old + turn) for new, old in ((value.roll, last.roll), (value.pitch, last.pitch))
    )
    thrust = min(max(value.thrust, last.thrust - lift), last.thrust + lift)
    return Setpoint(roll, pitch, value.yaw_rate, round(thrust))
