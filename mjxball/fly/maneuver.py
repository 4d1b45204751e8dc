"""What both drones are sent in each state of the supervisor in which no law is in command. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjxball.control import leader
from mjxball.fly.command import CommandMap
from mjxball.fly.packets import THRUST_CEILING, THRUST_FLOOR, Setpoint, setpoint

GRAVITY = 9.81


@dataclass(frozen=True)
class Times:
    """How long the states last, and how fast the pair comes down."""

    arm: float = 0.3  # zeros before the motors may turn [s]
    arm_limit: float = 3.0  # [s]
    spin: float = 0.3  # at a third of hover before the motors are judged [s]
    spin_limit: float = 4.0  # [s]: gains may have to be written
    ramp: float = 1.5  # thrust from nothing to hover [s]
    land_speed: float = 0.25  # at which the goal sinks [m/s]
    land_spare: float = 6.0  # beyond the time the goal takes to the ground [s]
    descend_speed: float = 0.4  # [m/s]
    descend_limit: float = 4.0  # [s]
    drone_watchdog: float = 2.0  # after which the firmware stops a drone that hears nothing [s]
    stop: float = 0.5  # stops are repeated for this long [s]
    stop_limit: float = 4.0  # [s]: the firmware counts as flying for 2 s after the last thrust
    settled: float = 0.3  # a landing is believed after this [s]
    near_ground: float = 0.04  # of O above where it stood [m]
    still: float = 0.12  # vertical speed below which it stands [m/s]


def ramp(elapsed: float, times: Times, constants: CommandMap) -> Setpoint:
    """Level, thrust rising in a straight line to hover."""
    share = min(elapsed / times.ramp, 1.0)
    return level(THRUST_FLOOR + share * (constants.hover_thrust - THRUST_FLOOR))


def sink(trim: float, climb: float | None, elapsed: float, times: Times) -> float:
    """Thrust [units] that lets a drone sink, from the `trim` that hovered; `climb` is its vertical speed [m/s].

    With a known speed it is held; without one (None) thrust falls from 95 to 70 % of the trim.
    """
    if climb is None:
        return trim * (0.95 - 0.25 * min(elapsed / times.descend_limit, 1.0))
    return trim * (1 + min(max(-0.4 * (climb + times.descend_speed), -0.3), 0.1))


def level(thrust: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Setpoint:
    """`tilt` (roll, pitch) [rad], level if not given, at `thrust`, within bounds."""
    bounded = min(max(thrust, THRUST_FLOOR), THRUST_CEILING) if math.isfinite(thrust) else THRUST_FLOOR
    return setpoint(*tilt, 0.0, bounded)


BRAKE_TILT = math.radians(8)  # of a descent that brakes sideways


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
    return min(max(moved, 0.85 * hover), 1.15 * hover)


class LastKnownState(NamedTuple):
    """What is known of the pair at the moment when nothing more will be heard of it."""

    trims: tuple[int, int]  # thrust that hovers, leader and follower [thrust units]
    height: float  # of O above where it stood [m]
    climb: float  # its vertical speed [m/s]
    lift: float  # its vertical acceleration under the setpoints that were sent last [m/s2]


BLIND_SPEED = 0.5  # [m/s] at which a blind descent sinks
BLIND_LIMIT = 2.5  # [s] that it lasts at most
BRISK, GENTLE = 3.0, 0.7  # [m/s2] downward at most: where both drones hear, and where one may not


def blind_shares(seen: LastKnownState, unheard: float, period: float, hardest: float = BRISK) -> list[float]:
    """Shares of the trim for a descent that is flown blind, one per `period` [s], all below 1.

    The first `unheard` seconds went by under the last setpoints. From there the pair's height is computed, not
    measured: sink at `BLIND_SPEED`, gained with at most `hardest` [m/s2], until it must stand, and 0.1 s more.
    """
    known = [value if math.isfinite(value) else 0.0 for value in (seen.height, seen.climb, seen.lift)]
    lift = min(max(known[2], -3.0), 3.0)
    height = known[0] + known[1] * unheard + 0.5 * lift * unheard**2
    climb = known[1] + lift * unheard
    shares: list[float] = []
    while height > 0 and len(shares) * period < BLIND_LIMIT:
        wanted = min(max(3 * (-BLIND_SPEED - climb), -hardest), -0.15)
        shares.append(1 + wanted / GRAVITY)
        climb += wanted * period
        height += climb * period
    return shares + [1 - hardest / GRAVITY] * round(0.1 / period)
