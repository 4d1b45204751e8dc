"""What is still normal: bounds on states, links and loop, and what is watched over time: estimators, uplinks. Pure.

The estimators run on the drones. One whose poses stop, freeze or jump goes on reporting; it shows in the variance, in a
step that its own velocity does not explain, or against the other drone, which sits on the same stick.

"""

from __future__ import annotations

import collections
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxball.control.motors import MOTORS, Motor
from mjxball.fly import packets
from mjxball.fly.packets import DroneState, Health
from mjxball.fly.supervisor import Event, Fault
from mjxball.fly.telemetry import ObjectState, Rig, Sample, object_of_one, object_state

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


@dataclass(frozen=True)
class WatchLimits:
    """From where on an estimator is not believed, and a drone counts as not hearing."""

    variance: float = (
        5e-4  # of the estimated position along any axis [m2]: without poses it is reached in about a second
    )
    jump: float = 0.08  # of the position, beyond what its velocity explains [m]
    jump_time: float = 0.1  # between two states, beyond which nothing is said about a jump [s]
    height: float = 0.05  # of one drone against the other one and the roll [m]
    climb: float = 0.3  # likewise [m/s]
    lasting: float = 0.25  # [s] that heights or climbs must disagree
    echo: float = 0.3  # [s] within which a thrust that was sent comes back as the one in force
    unheard: int = 4  # health packets in a row without such an echo


class EstimatorWatch:
    """Judges both estimators. `update` once a tick; `trusted` says whose position may be used."""

    def __init__(self, rig: Rig, limits: WatchLimits = WatchLimits(), sideways: bool = True):
        """`sideways` false: on a stand, where the estimators invent motion along the locked axes."""
        self._rig, self._limits = rig, limits
        self._axes = (0, 1, 2) if sideways else (2,)
        self._before: list[Sample | None] = [None, None]
        self._height, self._climb = Sustained(limits.lasting), Sustained(limits.lasting)
        self.trusted = [True, True]
        self.contradiction = False  # of the two drones; nobody knows which one is wrong

    def update(self, samples: Sequence[Sample], healths: Sequence[Health | None], now: float) -> list[Fault]:
        """What is wrong with the estimates at `now` [s]; a distrust lasts until the flight ends."""
        found = []
        for number, (sample, health) in enumerate(zip(samples, healths, strict=True)):
            reason = self._jumped(number, sample) or self._uncertain(health)
            if reason:
                self.trusted[number] = False
                found.append(Fault(Event.ESTIMATOR, f"{NAMES[number]}: {reason}"))
        if all(self.trusted):
            found += self._against_each_other(samples, now)
        return found

    def _jumped(self, number: int, sample: Sample) -> str:
        before, self._before[number] = self._before[number], sample
        if before is None or before.stamp == sample.stamp:
            return ""
        step = sample.stamp - before.stamp
        if not 0 < step <= self._limits.jump_time:
            return ""
        velocity = 0.5 * (sample.state.velocity + before.state.velocity)
        beyond = sample.state.position - before.state.position - step * velocity
        size = math.sqrt(sum(float(beyond[axis]) ** 2 for axis in self._axes))
        return f"its position jumped by {size:.2f} m" if size > self._limits.jump else ""

    def _uncertain(self, health: Health | None) -> str:
        if health is None:
            return ""
        variance = max(health.variance[axis] for axis in self._axes)
        if variance <= self._limits.variance:
            return ""
        return f"position variance {variance:.2g} m2, no more than {self._limits.variance:g} is believed"

    def _against_each_other(self, samples: Sequence[Sample], now: float) -> list[Fault]:
        """Heights and climbs of the two ends of one stick, whose attitude both drones measure."""
        leader, follower = (sample.state for sample in samples)
        matrices = [rotations.matrix_from_quaternion(state.quaternion) for state in (leader, follower)]
        matrix, span = 0.5 * (matrices[0] + matrices[1]), self._rig.span
        turning = np.cross(0.5 * (leader.rates + follower.rates), span)
        beside = float((leader.position - follower.position - matrix @ span)[2])
        faster = float((leader.velocity - follower.velocity - matrix @ turning)[2])
        high = self._height.update(abs(beside) > self._limits.height, now)
        fast = self._climb.update(abs(faster) > self._limits.climb, now)
        if not (high or fast):
            return []
        self.contradiction = True
        detail = f"the leader's height is {100 * beside:+.0f} cm from where the follower and the roll put it"
        if not high:
            detail = f"the leader climbs {faster:+.1f} m/s against the follower"
        return [Fault(Event.ESTIMATOR, detail)]

    def object(self, samples: Sequence[Sample], fresh: Sequence[bool]) -> ObjectState | None:
        """The object's state from those that are fresh and trusted; None if there is none.

        Where the two contradict each other, the lower height and the faster descent count.
        """
        states = [sample.state for sample in samples]
        good = [one and known for one, known in zip(self.trusted, fresh, strict=True)]
        if all(good):
            both = object_state(states, self._rig)
            if not self.contradiction:
                return both
            each = [object_of_one(state, mount) for state, mount in zip(states, self._rig.mounts, strict=True)]
            position, velocity = both.position.copy(), both.velocity.copy()
            position[2] = min(one.position[2] for one in each)
            velocity[2] = min(one.velocity[2] for one in each)
            return both._replace(position=position, velocity=velocity)
        for state, mount, known in zip(states, self._rig.mounts, good, strict=True):
            if known:
                return object_of_one(state, mount)
        return None


class UplinkWatch:
    """Whether one drone acts on what it is sent: its thrust in force must be one that was sent a moment ago."""

    def __init__(self, name: str, limits: WatchLimits = WatchLimits()):
        self._name, self._limits = name, limits
        self._sent: collections.deque[tuple[float, int]] = collections.deque()
        self._missing = 0
        self._judged = -math.inf
        self.heard = -math.inf  # [s] when the last thrust that it acted on was sent

    def sent(self, thrust: int, now: float) -> None:
        """`thrust` [units] goes out at `now` [s]."""
        self._sent.append((now, thrust))

    def update(self, health: Health | None, arrival: float) -> list[Fault]:
        """Judge a health packet that came at `arrival` [s]; the same one is judged once."""
        if health is None or arrival <= self._judged or not math.isfinite(health.thrust):
            return []
        self._judged = arrival
        while self._sent and self._sent[0][0] < arrival - self._limits.echo:
            self._sent.popleft()
        times = [time for time, thrust in self._sent if time <= arrival and abs(thrust - health.thrust) < 1.5]
        if times:
            self._missing, self.heard = 0, max(self.heard, times[-1])
            return []
        self._missing += 1
        if self._missing < self._limits.unheard:
            return []
        return [Fault(Event.UNHEARD, f"the {self._name} acts on thrust {health.thrust:.0f}, which was not sent lately")]
