"""What both drones are sent in each state of the supervisor in which no law is in command. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjxball.fly.command import CommandMap, slewed
from mjxball.fly.packets import THRUST_CEILING, THRUST_FLOOR, Setpoint, setpoint


@dataclass(frozen=True)
class Times:
    """How long the states last, and how fast the pair comes down."""

    arm: float = 0.3  # zeros before the motors may turn [s]
    arm_limit: float = 3.0  # [s]
    ramp: float = 1.5  # thrust from nothing to hover [s]
    land_speed: float = 0.25  # at which the goal sinks [m/s]
    land_spare: float = 6.0  # beyond the time the goal takes to the ground [s]
    descend_speed: float = 0.4  # [m/s]
    descend_limit: float = 4.0  # [s]
    drone_watchdog: float = 2.0  # after which the firmware stops a drone that hears nothing [s]
    stop: float = 0.5  # stops are repeated for this long [s]
    settled: float = 0.3  # a landing is believed after this [s]
    near_ground: float = 0.04  # of O above where it stood [m]
    still: float = 0.12  # vertical speed below which it stands [m/s]


def ramp(elapsed: float, times: Times, constants: CommandMap, last: Setpoint, period: float) -> Setpoint:
    """Level, thrust rising in a straight line to hover."""
    share = min(elapsed / times.ramp, 1.0)
    thrust = THRUST_FLOOR + share * (constants.hover_thrust - THRUST_FLOOR)
    return level(thrust, last, period, constants)


def sink(trim: float, climb: float | None, elapsed: float, times: Times) -> float:
    """Thrust [units] that lets a drone sink, from the `trim` that hovered; `climb` is its vertical speed [m/s].

    With a known speed it is held; without one (None) thrust falls from 95 to 70 % of the trim.
    """
    if climb is None:
        return trim * (0.95 - 0.25 * min(elapsed / times.descend_limit, 1.0))
    return trim * (1 + min(max(-0.4 * (climb + times.descend_speed), -0.3), 0.1))


def level(thrust: float, last: Setpoint, period: float, constants: CommandMap) -> Setpoint:
    """Level attitude at `thrust`, within bounds and slew limits from `last`."""
    bounded = min(max(thrust, THRUST_FLOOR), THRUST_CEILING) if math.isfinite(thrust) else THRUST_FLOOR
    return slewed(setpoint(0.0, 0.0, 0.0, bounded), last, period, constants)


def smoothed(trim: float, thrust: float, period: float, constant: float = 0.3) -> float:
    """Running average of the thrust that hovers, with a time `constant` [s]."""
    return trim - math.expm1(-period / constant) * (thrust - trim)


# The blind way down, when nothing but the last trims and the last height is known.
BLIND_THRUST = 0.93  # of the trim: 0.7 m/s2 down
BLIND_SINKING = (1 - BLIND_THRUST) * 9.81  # [m/s2]


def blind_time(height: float) -> float:
    """How long a blind descent from `height` [m] takes, with 0.2 s to spare, at most 2.5 s."""
    known = height if math.isfinite(height) else 0.0
    return min(math.sqrt(2 * max(known, 0.0) / BLIND_SINKING) + 0.2, 2.5)
