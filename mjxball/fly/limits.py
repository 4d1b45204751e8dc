"""What is still normal: bounds on states, links and loop, and the pure functions that find a fault."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjxball.fly import packets
from mjxball.fly.packets import DroneState
from mjxball.fly.pair import Rig
from mjxball.fly.supervisor import Event, Fault

STAND_SPARE = 0.25  # [m] above the goal, the height at which a stand's flight is ended
NAMES = ("leader", "follower")


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
    battery: float = 3.2  # [V]; 3.35 for the brushless
    battery_time: float = 5.0  # below it [s]
    saturation_time: float = 1.0  # of thrust at a bound [s]
    missed_deadlines: int = 10  # within a second
    longest_gap: float = 0.1  # between two ticks [s]
    fresh: float = 0.03  # [s] that states must be fresh before a flight that was held goes on
    gaps: int = 4  # of the states in one flight, after which it lands

    def on_stand(self, goal_height: float) -> Limits:
        """Bounds for a stand: a ceiling, and no word about sideways, which its estimators invent."""
        far = 1e3
        return replace(self, fence_low=(-far, -far, -0.1), fence_high=(far, far, goal_height + STAND_SPARE))


def within_fence(goal: Sequence[float], rig: Rig, limits: Limits) -> bool:
    """True if both drones are within the fence when O is at `goal`, from where it stood at the start [m]."""
    places = np.asarray(goal, float) + np.array([rig.leader_mount, rig.follower_mount])
    return bool((places >= limits.fence_low).all() and (places <= limits.fence_high).all())


def age_faults(ages: list[float], limits: Limits) -> list[Fault]:
    """A drone whose state is older than `limits.state_age`; `ages` (2,) [s] is the worse of both clocks'."""
    old = [(name, age) for name, age in zip(NAMES, ages, strict=True) if not age <= limits.state_age]
    return [Fault(Event.STALE, f"state of the {name} is {1000 * age:.0f} ms old") for name, age in old]


def state_faults(
    states: list[DroneState],
    origin: np.ndarray,
    span: np.ndarray,
    limits: Limits,
    armed: bool = True,
    fresh: Sequence[bool] = (True, True),
) -> list[Fault]:
    """Everything wrong with two states; `origin` (3,) [m] is where O stood, `span` (3,) [m] leader from follower.

    Before they are `armed`, drones need not be able to fly; a state that is not `fresh` is not judged.
    """
    faults = []
    low, high = np.array(limits.fence_low), np.array(limits.fence_high)
    for name, state, known in zip(NAMES, states, fresh, strict=True):
        if not known:
            continue
        numbers = np.concatenate([state.position, state.velocity, state.quaternion, state.rates])
        if not np.isfinite(numbers).all():
            faults.append(Fault(Event.BAD_STATE, f"state of the {name} is not finite"))
            continue
        place = state.position - origin
        if (place < low).any() or (place > high).any():
            where = ", ".join(f"{value:.2f}" for value in place)
            faults.append(Fault(Event.FENCE, f"{name} at ({where}) m"))
        tilt = tilt_of(state)
        if tilt > limits.tilt:
            faults.append(Fault(Event.TILT, f"{name} tilts {math.degrees(tilt):.0f} degrees"))
        down = down_reason(state.info, armed)
        if down:
            faults.append(Fault(Event.DRONE_DOWN, f"{name} {down}"))
    return faults + (stick_faults(states, span, limits) if all(fresh) else [])


def stick_faults(states: list[DroneState], span: np.ndarray, limits: Limits) -> list[Fault]:
    """The line between the two reported positions against the stick that joins them."""
    line = states[0].position - states[1].position
    length, known = math.sqrt(float(line @ line)), math.sqrt(float(span @ span))
    if abs(length - known) > limits.stick_error:
        return [Fault(Event.STICK, f"the drones are {length:.2f} m apart on a stick of {known:.2f} m")]
    tilt = math.asin(min(abs(float(line[2]) - float(span[2])) / known, 1.0))
    if tilt > limits.stick_tilt:
        return [Fault(Event.STICK, f"the stick tilts {math.degrees(tilt):.0f} degrees")]
    return []


def tilt_of(state: DroneState) -> float:
    """Angle between body z and up [rad]."""
    return math.acos(min(max(packets.level_share(state.quaternion), -1.0), 1.0))


def down_reason(info: int, armed: bool = True) -> str:
    """Why the firmware will not fly, empty if it will; one that is not armed yet need not be able to."""
    for bit, reason in ((packets.LOCKED, "is locked"), (packets.CRASHED, "crashed"), (packets.TUMBLED, "tumbled")):
        if info & bit:
            return reason
    return "" if info & packets.CAN_FLY or not armed else "cannot fly (its supervisor says no)"


class Sustained:
    """True once a condition has held without a break for `seconds`."""

    def __init__(self, seconds: float):
        self.seconds, self._since = seconds, math.inf

    def update(self, holds: bool, now: float) -> bool:
        """Tell it whether the condition `holds` at `now` [s]."""
        self._since = min(self._since, now) if holds else math.inf
        return now - self._since >= self.seconds
