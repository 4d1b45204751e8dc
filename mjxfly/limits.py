"""What is still normal, and how long each part of a flight takes: bounds on states, links and loop; settings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mjxball.control.motors import MOTORS, Motor
from mjxfly.supervisor import State
from mjxfly.telemetry import Rig

STAND_SPARE = 0.25  # [m] above the goal, the height at which a stand's flight is ended
NAMES = ("leader", "follower")
LOOP_RATE = 100.0  # [Hz] of the runner's ticks at least


def ticks_per_command(control_period: float) -> int:
    """Ticks of the runner's loop in a policy's `control_period` [s], a whole number."""
    return math.ceil(control_period * LOOP_RATE - 1e-9)


@dataclass(frozen=True)
class Limits:
    """Bounds that end a flight."""

    state_age: float = 0.1  # [s]
    fence_low: tuple[float, float, float] = (-1.5, -1.5, -0.3)  # of every drone from where O stood at the start [m]
    fence_high: tuple[float, float, float] = (1.5, 1.5, 1.5)  # [m]
    tilt: float = math.radians(40)  # of either drone from level [rad]
    hold_tilt: float = math.radians(25)  # the same while the other one is not heard: it may be off [rad]
    stick_tilt: float = math.radians(30)  # of the line between the drones from level [rad]
    stick_error: float = 0.1  # of the distance between the drones [m]
    battery: float = 3.2  # [V]
    battery_time: float = 5.0  # below it [s]
    saturation_time: float = 1.0  # of thrust at a bound [s]
    missed_deadlines: int = 10  # within a second
    longest_gap: float = 0.1  # between two ticks [s]
    fresh: float = 0.03  # [s] that states must be fresh before a flight that was held goes on
    gaps: int = 4  # of the states in one flight, after which it lands
    variance: float = 5e-4  # of an estimated position that is believed [m2]: without poses it is reached in about 1 s
    noise: float = 0.0  # of a position beyond motion capture's, standard deviation [m], see `positioning`

    def on_stand(self, goal_height: float) -> Limits:
        """Bounds for a stand: a ceiling, and no word about sideways, which its estimators invent."""
        far = 1e3
        return replace(self, fence_low=(-far, -far, -0.1), fence_high=(far, far, goal_height + STAND_SPARE))


@dataclass(frozen=True)
class Times:
    """How long the states last, and how fast the pair comes down."""

    arm: float = 0.3  # zeros before the motors may turn [s]
    arm_limit: float = 3.0  # [s]
    spin: float = 0.3  # at a third of hover before the motors are checked [s]
    spin_limit: float = 4.0  # [s]: gains may have to be written
    ramp: float = 1.5  # thrust from nothing to hover [s]
    lift: float = 4.0  # more, until the pair is off the ground [s]
    land_speed: float = 0.25  # at which the goal sinks [m/s]
    land_spare: float = 6.0  # beyond the time the goal takes to the ground [s]
    descend_speed: float = 0.4  # [m/s]
    descend_least: float = 4.0  # [s] in which a descent is over, or
    descend_share: float = 2.0  # in so many times what its height takes at that speed, if that is more
    drone_watchdog: float = 2.0  # after which the firmware stops a drone that hears nothing [s]
    stop: float = 0.5  # stops are repeated for this long [s]
    stop_limit: float = 4.0  # [s]: the firmware counts as flying for 2 s after the last thrust
    settled: float = 0.3  # a landing is believed after this [s]
    near_ground: float = 0.04  # of O above where it stood [m]
    still: float = 0.12  # vertical speed below which it stands [m/s]
    rest: float = 0.15  # that it must not have sunk in [s]
    rest_sunk: float = 0.005  # by more than that [m]: a slow landing is as slow, and is not over

    def descent_limit(self, height: float) -> float:
        """How long a descent from `height` [m] may last [s]: longer than a slow one, which a cut would let fall."""
        return max(self.descend_least, self.descend_share * height / self.descend_speed)

    @property
    def limits(self) -> dict[State, float]:
        """How long a state may last [s], where that does not depend on the flight."""
        return {
            State.ARM: self.arm_limit,
            State.SPIN: self.spin_limit,
            State.RAMP: self.ramp + self.lift,
            State.STOP: self.stop_limit,
            State.KILL: self.stop,
        }


@dataclass(frozen=True)
class FlightSettings:
    """What is flown and within which bounds."""

    seconds: float = 20.0  # in State.FLY
    goal: tuple[float, float, float] = (0.0, 0.0, 0.4)  # of O, from where it stands at the start [m]
    dry_run: bool = False  # zeros are sent, whatever is wanted
    period: float = 0.01  # of the loop [s]
    motor: Motor = MOTORS["2.1"]  # of both drones, by which the firmware's curve is recognised
    stand: bool = False  # sideways and pitch are locked
    limits: Limits = Limits()
    times: Times = Times()


class Check(NamedTuple):
    """One check and how it went."""

    name: str
    passed: bool
    found: str

    @classmethod
    def judged(cls, name: str, passed: bool, found: str, remedy: str) -> Check:
        """One that tells its `remedy` unless it is `passed`."""
        return cls(name, passed, found if passed else f"{found}: {remedy}")


def within_fence(goal: Sequence[float], rig: Rig, limits: Limits) -> bool:
    """True if both drones are within the fence when O is at `goal`, from where it stood at the start [m]."""
    places = np.asarray(goal, float) + np.array([rig.leader_mount, rig.follower_mount])
    return bool((places >= limits.fence_low).all() and (places <= limits.fence_high).all())
