"""What drones are sent: from a law's command to thrust units, and level flight where no law is in command.

Firmware with battery compensation (2025.12.1 and later by default) makes the force proportional to the thrust command:
`linear`. Firmware without it takes the command as the motors' PWM: `older`. No parameter says which, but the PWM does
that the firmware makes of a small thrust: `preflight.SpinCheck` looks at it. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.control import crazyflie, leader, motors
from mjxball.control.crazyflie import Gains
from mjxfly.limits import Times
from mjxfly.packets import THRUST_CEILING, THRUST_FLOOR, PacketError, Setpoint, setpoint

CurveName = Literal["linear", "older"]
CURVE_NAMES: tuple[CurveName, ...] = ("linear", "older")
SPIN_THRUST = 16000  # [thrust units] a third of hover: the motors turn, the pair does not lift
GRAVITY = 9.81
BRAKE_TILT = math.radians(8)  # of a descent that brakes sideways
BLIND_SPEED = 0.5  # [m/s] at which a blind descent sinks
BLIND_LIMIT = 2.5  # [s] that it lasts at most
MOST_TRIM = 1.15  # of what should hover, in any thrust that is taken for the one that does
BRISK, GENTLE = 3.0, 0.7  # [m/s2] downward at most: where both drones hear, and where one may not
UNEVEN = 1.5  # [m/s2] likewise of the one that hears, measured: the stick bears the moment of so much less thrust
STAND_BY = 0.4  # [s] before the firmware stops a drone by which the pair is to stand
NEAR_GROUND = 0.04  # [m]
HELD_SPEEDS = (0.2, 1.2)  # [m/s] least and most of a descent that has to end in time


@dataclass(frozen=True)
class ForceCurve:
    """Force of one motor from p = thrust units / 65535: `quadratic` p^2 + `linear` p [N] (crazyflie.md)."""

    quadratic: float = 0.0  # [N]
    linear: float = 0.12  # [N] Crazyflie 2.1+ with battery compensation

    def force(self, thrust: float) -> float:
        """Force of the four motors of one drone [N] at `thrust` units."""
        return 4 * float(crazyflie.motor_force((self.quadratic, self.linear), thrust))

    def thrust(self, force: float) -> float:
        """Thrust units at which four motors give `force` [N]; not bounded above, 0 for none."""
        return float(crazyflie.motor_command((self.quadratic, self.linear), np.float64(force / 4)))


LINEAR = ForceCurve()
OLDER = ForceCurve(*motors.OLDER)  # firmware without battery compensation, 2.1 motors


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
    gravity: float = GRAVITY  # [m/s2]
    curve: ForceCurve = LINEAR
    tilt_limit: float = math.radians(15)  # of every commanded roll and pitch [rad]

    @property
    def hover_thrust(self) -> float:
        """Thrust units at level hover."""
        return self.hover if self.law == "paper" else self.curve.thrust(self.carried_mass * self.gravity)

    def scaled(self, share: float) -> CommandMap:
        """The map of a drone that hovers at `share` of the force that this one takes it to need."""
        hover, mass = share * self.hover, share * self.carried_mass
        return replace(self, hover=hover, per_acceleration=share * self.per_acceleration, carried_mass=mass)


class Variant(NamedTuple):
    """How one drone is flown if its firmware has a certain force curve."""

    map: CommandMap
    gains: Gains


Variants = Mapping[CurveName, Variant]  # of one drone, by the curve of its firmware


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


def to_setpoint(command: Array, constants: CommandMap) -> Mapped:
    """The bounded setpoint of `command` (3,), without yaw. Raises packets.PacketError if a number is not finite."""
    roll, pitch, vertical = (float(value) for value in command)
    if not all(map(math.isfinite, (roll, pitch, vertical))):
        raise PacketError("a command is not finite")
    limit = constants.tilt_limit
    roll, pitch = (min(max(value, -limit), limit) for value in (roll, pitch))
    wanted = raw_thrust((roll, pitch, vertical), constants)
    thrust = min(max(wanted, THRUST_FLOOR), THRUST_CEILING)
    return Mapped(setpoint(roll, pitch, 0.0, thrust), thrust != wanted)


def level(thrust: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Setpoint:
    """`tilt` (roll, pitch) [rad], level if not given, at `thrust`, within bounds."""
    bounded = min(max(thrust, THRUST_FLOOR), THRUST_CEILING) if math.isfinite(thrust) else THRUST_FLOOR
    return setpoint(*tilt, 0.0, bounded)


def ramp(elapsed: float, times: Times, constants: CommandMap) -> Setpoint:
    """Level, thrust rising in a straight line to hover."""
    share = min(elapsed / times.ramp, 1.0)
    return level(THRUST_FLOOR + share * (constants.hover_thrust - THRUST_FLOOR))


def sinking_share(climb: float, times: Times) -> float:
    """Share of the thrust that hovers by which a drone of vertical speed `climb` [m/s] comes to sink as wanted."""
    return 1 + min(max(-0.4 * (climb + times.descend_speed), -0.3), 0.1)


def timed_share(height: float, climb: float, left: float) -> float:
    """Share of the trim by which a pair `height` [m] up, of vertical speed `climb` [m/s], stands in time.

    In `left` seconds a drone that hears nothing, and holds its last thrust until then, is stopped by its firmware. What
    is measured steers the descent, so that it is the same whether one drone obeys or both. Near the ground nothing is
    braked: a pair that bounces may be in the air when it is stopped.
    """
    least, most = HELD_SPEEDS
    wanted = -min(max(height / max(left - STAND_BY, 0.2), least), most)
    faster = min(max(4 * (wanted - climb), -UNEVEN), UNEVEN) if height > NEAR_GROUND else -UNEVEN
    return 1 + faster / GRAVITY


def brake(velocity: np.ndarray) -> tuple[float, float]:
    """(roll, pitch) [rad] that brake a horizontal `velocity` (3,) [m/s] with a time constant of 0.7 s."""
    wanted = leader.command(-velocity / 0.7, 0.0, GRAVITY, BRAKE_TILT, 1.0)
    roll, pitch = float(wanted[0]), float(wanted[1])
    return (roll, pitch) if math.isfinite(roll) and math.isfinite(pitch) else (0.0, 0.0)


def smoothed(trim: float, thrust: float, period: float, hover: float) -> float:
    """Running average over a second of the thrust that hovers, no further than 15 % from what the rig should need.

    A climb that has just begun must not pass for hovering: the bound keeps what is flown blind near the truth.
    """
    moved = trim - math.expm1(-period) * (thrust - trim)
    return min(max(moved, 0.85 * hover), MOST_TRIM * hover)


class LastKnownState(NamedTuple):
    """What is known of the pair at the moment when nothing more will be heard of it."""

    trims: tuple[int, int]  # thrust that hovers, leader and follower [thrust units]
    height: float  # of O above where it stood [m]
    climb: float  # its vertical speed [m/s]
    lift: float  # its vertical acceleration under the setpoints that were sent last [m/s2]


def blind_shares(seen: LastKnownState, unheard: float, period: float, hardest: float = BRISK) -> list[float]:
    """Shares of the trim for a descent that is flown blind, one per `period` [s], all below 1.

    The first `unheard` seconds went by under the last setpoints. From there the pair's height is computed, not
    measured: sink at `BLIND_SPEED`, gained with at most `hardest` [m/s2], until it must stand, and 0.1 s more.
    """
    height, climb, lift = (value if math.isfinite(value) else 0.0 for value in seen[1:])
    lift = min(max(lift, -3.0), 3.0)
    height += climb * unheard + 0.5 * lift * unheard**2
    climb += lift * unheard
    shares: list[float] = []
    while height > 0 and len(shares) * period < BLIND_LIMIT:
        wanted = min(max(3 * (-BLIND_SPEED - climb), -hardest), -0.15)
        shares.append(1 + wanted / GRAVITY)
        climb += wanted * period
        height += climb * period
    return shares + [1 - hardest / GRAVITY] * round(0.1 / period)
