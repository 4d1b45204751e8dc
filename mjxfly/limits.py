"""Settings of a flight: bounds on states, links and control loop, durations of its phases, results of checks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mjxball.control.motors import MOTORS, Motor
from mjxfly.supervisor import FlightState
from mjxfly.telemetry import Rig

STAND_SPARE = 0.25  # [m] above the goal: ceiling of a flight on the stand
NAMES = ("leader", "follower")
LOOP_RATE = 100.0  # [Hz] least rate of the control loop


def ticks_per_command(control_period: float) -> int:
    """Number of ticks of the control loop in a policy's `control_period` [s]."""
    return math.ceil(control_period * LOOP_RATE - 1e-9)


@dataclass(frozen=True)
class Limits:
    """Bounds that end a flight."""

    state_age: float = 0.1  # of a drone's newest state [s]
    fence_low: tuple[float, float, float] = (-1.5, -1.5, -0.3)  # of every drone from where O stood at the start [m]
    fence_high: tuple[float, float, float] = (1.5, 1.5, 1.5)  # [m]
    tilt: float = math.radians(40)  # of either drone from level [rad]
    hold_tilt: float = math.radians(25)  # the same in HOLD, while the other drone may be off [rad]
    stick_tilt: float = math.radians(30)  # of the line between the drones from level [rad]
    stick_error: float = 0.1  # of the distance between the drones [m]
    battery: float = 3.2  # [V]
    battery_time: float = 5.0  # below it [s]
    saturation_time: float = 1.0  # with the thrust at a bound [s]
    missed_deadlines: int = 10  # within a second
    longest_gap: float = 0.1  # between two ticks [s]
    fresh: float = 0.03  # for which states must be fresh before HOLD ends [s]
    gaps: int = 4  # times in HOLD in one flight, after which it lands
    variance: float = 5e-4  # of a trusted position estimate [m2]: without poses it is exceeded after about 1 s
    noise: float = 0.0  # of the positions beyond that of motion capture, standard deviation [m], see `positioning`

    def on_stand(self, goal_height: float) -> Limits:
        """Bounds for a stand: a ceiling, none sideways, where the estimates drift along the locked axes."""
        far = 1e3
        return replace(self, fence_low=(-far, -far, -0.1), fence_high=(far, far, goal_height + STAND_SPARE))


@dataclass(frozen=True)
class Times:
    """Durations of the supervisor's states, speeds of landings, and when the pair counts as landed."""

    arm: float = 0.3  # zero setpoints before the motors may turn [s]
    arm_limit: float = 3.0  # [s]
    spin: float = 0.3  # at a third of hover thrust before the motors are checked [s]
    spin_limit: float = 4.0  # [s]: gains may have to be written
    ramp: float = 1.5  # thrust from zero to hover [s]
    lift: float = 4.0  # after that, until the pair must be off the ground [s]
    land_speed: float = 0.25  # at which the goal sinks [m/s]
    land_spare: float = 6.0  # of LAND after the goal has reached the ground, at most [s]
    descend_speed: float = 0.4  # [m/s]
    descend_least: float = 4.0  # time limit of a descent [s]
    descend_share: float = 2.0  # its time limit over height / `descend_speed`, if that is longer
    drone_watchdog: float = 2.0  # after which the firmware stops a drone that hears nothing [s]
    stop: float = 0.5  # for which stops are repeated [s]
    stop_limit: float = 4.0  # [s]: the firmware counts as flying for 2 s after the last thrust
    settled: float = 0.3  # in LAND or DESCEND before the pair may count as landed [s]
    near_ground: float = 0.04  # height of O above its start below which it may have landed [m]
    still: float = 0.12  # vertical speed below which it may have landed [m/s]
    rest: float = 0.15  # window in which a landed pair does not sink [s]
    rest_sunk: float = 0.005  # by more than this [m]; a slow landing is no faster than `still`

    def descent_limit(self, height: float) -> float:
        """Time limit [s] of a descent from `height` [m], longer than a slow one takes: at the limit the motors stop."""
        return max(self.descend_least, self.descend_share * height / self.descend_speed)

    @property
    def limits(self) -> dict[FlightState, float]:
        """Time limits [s] of the states whose limit is the same in every flight."""
        return {
            FlightState.ARM: self.arm_limit,
            FlightState.SPIN: self.spin_limit,
            FlightState.RAMP: self.ramp + self.lift,
            FlightState.STOP: self.stop_limit,
            FlightState.KILL: self.stop,
        }


@dataclass(frozen=True)
class FlightSettings:
    """Duration, goal, loop period, motors and bounds of a flight."""

    seconds: float = 20.0  # in FlightState.FLY
    goal: tuple[float, float, float] = (0.0, 0.0, 0.4)  # of O, from where it stands at the start [m]
    dry_run: bool = False  # send zero setpoints only
    period: float = 0.01  # of the loop [s]
    motor: Motor = MOTORS["2.1"]  # model of both drones' motors, to recognise the firmware's force curve
    stand: bool = False  # sideways and pitch are locked
    limits: Limits = Limits()
    times: Times = Times()


class Check(NamedTuple):
    """One preflight check and its result."""

    name: str
    passed: bool
    found: str

    @classmethod
    def judged(cls, name: str, passed: bool, found: str, remedy: str) -> Check:
        """A check whose text includes the `remedy` if it failed."""
        return cls(name, passed, found if passed else f"{found}: {remedy}")


def within_fence(goal: Sequence[float], rig: Rig, limits: Limits) -> bool:
    """True if both drones are within the fence when O is at `goal`, from where it stood at the start [m]."""
    places = np.asarray(goal, float) + np.array([rig.leader_mount, rig.follower_mount])
    return bool((places >= limits.fence_low).all() and (places <= limits.fence_high).all())
