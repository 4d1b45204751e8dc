"""Setpoints: from a controller's command to thrust units, and level flight while no controller is in command. Pure.

Firmware with battery compensation (2025.12.1 and later by default) makes the force proportional to the thrust command:
curve `linear`. Firmware without it uses the command as the motors' PWM: curve `older`. No parameter tells which;
`preflight.SpinCheck` recognises it by the PWM at a small thrust.
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
MOST_TRIM = 1.15  # largest trim over nominal hover thrust
BRISK, GENTLE = 3.0, 0.7  # [m/s2] largest downward acceleration: if both drones hear, and if one may not
UNEVEN = 1.5  # [m/s2] the same with a measured height: the stick bears the moment of the uneven thrust
STAND_BY = 0.4  # [s] before the firmware stops a drone by which the pair should have landed
NEAR_GROUND = 0.04  # [m]
HELD_SPEEDS = (0.2, 1.2)  # [m/s] bounds of the speed of a descent with a deadline


@dataclass(frozen=True)
class ForceCurve:
    """Force of one motor from p = thrust units / 65535: `quadratic` p^2 + `linear` p [N] (docs/hardware.md)."""

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
    """Map from a drone's command to thrust units, and bounds of every setpoint.

    `paper`: thrust = thr_hov + k_pz az (the paper's experiment). `calibrated`: the force curve at the carried
    mass, T = m (g + az) / (cos roll cos pitch), as in simulation.
    """

    thrust_model: Literal["paper", "calibrated"] = "calibrated"
    hover: float = 46000.0  # thr_hov [thrust units], of the paper; calibrate it for each rig
    per_acceleration: float = 1000.0  # k_pz [thrust units per m/s2], of the paper
    carried_mass: float = 0.035  # the drone and its share of the object [kg]
    gravity: float = GRAVITY  # [m/s2]
    curve: ForceCurve = LINEAR
    tilt_limit: float = math.radians(15)  # of every commanded roll and pitch [rad]

    @property
    def hover_thrust(self) -> float:
        """Thrust units at level hover."""
        return self.hover if self.thrust_model == "paper" else self.curve.thrust(self.carried_mass * self.gravity)

    def scaled(self, share: float) -> CommandMap:
        """The map of a drone whose hover force is `share` times that of this map."""
        hover, mass = share * self.hover, share * self.carried_mass
        return replace(self, hover=hover, per_acceleration=share * self.per_acceleration, carried_mass=mass)


class Variant(NamedTuple):
    """Command map and gains of one drone for one force curve of its firmware."""

    map: CommandMap
    gains: Gains


Variants = Mapping[CurveName, Variant]  # of one drone, by the curve of its firmware


class BoundedSetpoint(NamedTuple):
    """A setpoint, and whether its thrust was clipped."""

    setpoint: Setpoint
    saturated: bool


def raw_thrust(command: Array, constants: CommandMap) -> float:
    """Thrust units before any bound for `command` = (roll, pitch [rad], vertical acceleration [m/s2])."""
    roll, pitch, vertical = (float(value) for value in command)
    if constants.thrust_model == "paper":
        return constants.hover + constants.per_acceleration * vertical
    level = math.cos(roll) * math.cos(pitch)
    return constants.curve.thrust(constants.carried_mass * (constants.gravity + vertical) / level)


def to_setpoint(command: Array, constants: CommandMap) -> BoundedSetpoint:
    """The bounded setpoint of `command` (3,), yaw rate 0. Raises packets.PacketError if a value is not finite."""
    roll, pitch, vertical = (float(value) for value in command)
    if not all(map(math.isfinite, (roll, pitch, vertical))):
        raise PacketError("a command is not finite")
    limit = constants.tilt_limit
    roll, pitch = (min(max(value, -limit), limit) for value in (roll, pitch))
    wanted = raw_thrust((roll, pitch, vertical), constants)
    thrust = min(max(wanted, THRUST_FLOOR), THRUST_CEILING)
    return BoundedSetpoint(setpoint(roll, pitch, 0.0, thrust), thrust != wanted)


def level(thrust: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Setpoint:
    """Setpoint with `tilt` (roll, pitch) [rad] and `thrust` [units], clipped to its bounds."""
    bounded = min(max(thrust, THRUST_FLOOR), THRUST_CEILING) if math.isfinite(thrust) else THRUST_FLOOR
    return setpoint(*tilt, 0.0, bounded)


def ramp(elapsed: float, times: Times, constants: CommandMap) -> Setpoint:
    """Level setpoint `elapsed` [s] into the ramp, with thrust that rises linearly to hover."""
    share = min(elapsed / times.ramp, 1.0)
    return level(THRUST_FLOOR + share * (constants.hover_thrust - THRUST_FLOOR))


def sinking_share(climb: float, times: Times) -> float:
    """Thrust over trim that brings a drone with vertical speed `climb` [m/s] to `times.descend_speed` downward."""
    return 1 + min(max(-0.4 * (climb + times.descend_speed), -0.3), 0.1)


def timed_share(height: float, climb: float, left: float) -> float:
    """Thrust over trim that lands a pair at `height` [m] with vertical speed `climb` [m/s] before `left` seconds pass.

    Then the firmware stops a drone that hears nothing and holds its last thrust. The descent is controlled by measured
    height and speed, so that it is the same whether one drone obeys or both. Near the ground it is not slowed: a pair
    that bounces may be in the air when a drone is stopped.
    """
    least, most = HELD_SPEEDS
    wanted = -min(max(height / max(left - STAND_BY, 0.2), least), most)
    faster = min(max(4 * (wanted - climb), -UNEVEN), UNEVEN) if height > NEAR_GROUND else -UNEVEN
    return 1 + faster / GRAVITY


def brake(velocity: np.ndarray) -> tuple[float, float]:
    """(roll, pitch) [rad] that brake the horizontal part of `velocity` (3,) [m/s] with a time constant of 0.7 s."""
    wanted = leader.command(-velocity / 0.7, 0.0, GRAVITY, BRAKE_TILT, 1.0)
    roll, pitch = float(wanted[0]), float(wanted[1])
    return (roll, pitch) if math.isfinite(roll) and math.isfinite(pitch) else (0.0, 0.0)


def smoothed(trim: float, thrust: float, period: float, hover: float) -> float:
    """New hover thrust `trim`: running average of `thrust` over 1 s, within 15 % of the nominal `hover` [units].

    The bound keeps a climb that has just begun from being taken for hover in a later blind descent.
    """
    moved = trim - math.expm1(-period) * (thrust - trim)
    return min(max(moved, 0.85 * hover), MOST_TRIM * hover)


class LastKnownState(NamedTuple):
    """State of the pair from which a blind descent begins."""

    trims: tuple[int, int]  # hover thrust of leader and follower [thrust units]
    height: float  # of O above where it stood [m]
    climb: float  # vertical speed of O [m/s]
    lift: float  # vertical acceleration under the last setpoints [m/s2]


def blind_shares(seen: LastKnownState, unheard: float, period: float, hardest: float = BRISK) -> list[float]:
    """Thrust over trim of a blind descent, one value per `period` [s], all below 1.

    The last setpoints were in force for the first `unheard` seconds. From then on height and speed are predicted, not
    measured: sink at `BLIND_SPEED`, reached with at most `hardest` [m/s2], until the ground, and 0.1 s more.
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
