"""Faults of drones and estimates in flight, in single states and over time. Pure.

The estimators run on the drones. One whose poses stop, freeze or jump keeps reporting. The fault shows in its variance,
in a step that its velocity does not explain, or in a contradiction to the other drone on the same stick.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from mjxball.control import rotations
from mjxfly import packets
from mjxfly.limits import NAMES, FlightSettings, Limits
from mjxfly.measured import REPEATING, DroneWatch
from mjxfly.packets import DroneState, Health
from mjxfly.supervisor import AIRBORNE, GUIDED, ON_GROUND, Event, Fault, FlightState
from mjxfly.telemetry import DroneLink, ObjectState, Rig, Sample, object_of_one, object_state

# Thresholds at which an estimator is not trusted, or a drone counts as not hearing.
JUMP = 0.08  # of the position, beyond what its velocity explains [m]
JUMP_TIME = 0.1  # longest step between two states that is checked for a jump [s]
HEIGHT, CLIMB = 0.05, 0.3  # difference between both drones' heights [m] and climbs [m/s], corrected for the attitude
LASTING = 0.25  # [s] for which heights or climbs must disagree
APART, SIGMAS = 0.015, 4.0  # change of their relative position along an axis: [m], and in standard deviations
USUAL = 10.0  # [s] time constant of the mean that this change is measured from
LIMITS = Limits()
ECHO = 0.3  # [s] within which a sent thrust is reported back as the one in force
RECENT = 0.1  # [s] of sent thrusts with which a constant thrust in force is compared
ROUNDING = 1.5  # [thrust units] rounding tolerance between two equal thrusts
CLOSED = (
    FlightState.RAMP,
    *GUIDED,
)  # the thrust depends on the estimates; before, the streams of a pair at rest may freeze
# [s] after CLOSED in which a stream may freeze by the same cause. Later a frozen estimate still steers a descent better
# than none, since the blind descent would start in its middle.
TOGETHER = 0.1
FROZEN = 0.1  # [s] without change of its states after which a drone that does not hear counts as frozen
RISING = (
    FlightState.RAMP,
    FlightState.FLY,
)  # contact with the ground causes accelerations that the packets do not resolve
UNHEARD = 4  # consecutive health packets without an echo, or with a constant one


class Sustained:
    """True once a condition has held without a break for `seconds`."""

    def __init__(self, seconds: float):
        self.seconds, self._since = seconds, math.inf

    def update(self, holds: bool, now: float) -> bool:
        """Add whether the condition `holds` at `now` [s]; return whether it has lasted."""
        self._since = min(self._since, now) if holds else math.inf
        return now - self._since >= self.seconds


def down_reason(info: int, armed: bool = True) -> str:
    """Why the firmware will not fly, by its `info` bits, empty if it will; CAN_FLY counts only if it is `armed`."""
    for bit, reason in ((packets.LOCKED, "is locked"), (packets.CRASHED, "crashed"), (packets.TUMBLED, "tumbled")):
        if info & bit:
            return reason
    return "" if info & packets.CAN_FLY or not armed else "cannot fly (its supervisor says no)"


def stick_faults(states: Sequence[DroneState], span: np.ndarray, limits: Limits) -> list[Fault]:
    """Faults of length and tilt of the line between both reported positions; the stick is `span` (3,) [m]."""
    line = states[0].position - states[1].position
    length, known = math.sqrt(float(line @ line)), math.sqrt(float(span @ span))
    if abs(length - known) > limits.stick_error:
        return [Fault(Event.STICK, f"the drones are {length:.2f} m apart on a stick of {known:.2f} m")]
    tilt = math.asin(min(abs(float(line[2]) - float(span[2])) / known, 1.0))
    if tilt > limits.stick_tilt:
        return [Fault(Event.STICK, f"the stick tilts {math.degrees(tilt):.0f} degrees")]
    return []


def link_faults(links: Sequence[DroneLink], ages: Sequence[float], limits: Limits, now: float) -> list[Fault]:
    """Links that have ended or cannot send, and states that are too old; `ages` (2,) [s] by the worse clock."""
    faults = []
    for name, link in zip(NAMES, links, strict=True):
        if link.lost:
            faults.append(Fault(Event.LINK_LOST, f"{name}: {link.lost}"))
        elif link.stuck_for(now) > limits.state_age:
            faults.append(Fault(Event.LINK_LOST, f"{name}: nothing can be sent"))
    old = [(name, age) for name, age in zip(NAMES, ages, strict=True) if not age <= limits.state_age]
    return faults + [Fault(Event.STALE, f"state of the {name} is {1000 * age:.0f} ms old") for name, age in old]


class Monitor:
    """Checks both drones' states, estimates and uplinks. `update` once a tick."""

    def __init__(self, rig: Rig, settings: FlightSettings):
        self._rig, self._settings = rig, settings
        bounds = settings.limits
        self._hold_limits = dataclasses.replace(bounds, tilt=min(bounds.hold_tilt, bounds.tilt))
        self._low = [Sustained(bounds.battery_time) for _ in NAMES]
        self.origin = np.zeros(3)  # where O stood at the start [m]
        self.estimators = EstimatorWatch(rig, not settings.stand, bounds)
        axes = (2,) if settings.stand else (0, 1, 2)
        self._drones = [DroneWatch(axes, bounds.noise) for _ in NAMES]
        self.uplinks = [UplinkWatch(name) for name in NAMES]
        self.object: ObjectState | None = None  # newest trusted state
        self._closed_at = -math.inf  # [s] last time in a state of `CLOSED`

    def update(self, phase: FlightState, links: Sequence[DroneLink], ages: Sequence[float], now: float) -> list[Fault]:
        """Faults in the supervisor's state `phase` at `now` [s]; `ages` (2,) [s] are those of the states."""
        samples = [link.telemetry.newest for link in links if link.telemetry.newest is not None]
        healths = [link.telemetry.health for link in links]
        fresh = [age <= self._settings.limits.state_age for age in ages]
        self._closed_at = now if phase in CLOSED else self._closed_at
        dry, faults = self._settings.dry_run, self._measured(phase, links, now)
        if phase in AIRBORNE and all(fresh):
            faults += self.estimators.update(samples, [one and one.health for one in healths], now)
        if phase in AIRBORNE and not dry:  # a dry run is never echoed
            for health, watch, drone in zip(healths, self.uplinks, self._drones, strict=True):
                found = watch.update(*health) if health is not None else []
                faults += [watch.frozen] if found and drone.stands(FROZEN) else found
        self.object = self.estimators.object(samples, fresh) or self.object
        bounds = self._hold_limits if phase is FlightState.HOLD else self._settings.limits
        states = [sample.state for sample in samples]
        for name, state, known in zip(NAMES, states, fresh, strict=True):
            faults += self._from_state(name, state, bounds, phase not in ON_GROUND and not dry) if known else []
        faults += stick_faults(states, self._rig.span, bounds) if all(fresh) else []
        for name, state, low in zip(NAMES, states, self._low, strict=True):
            if low.update(state.battery < bounds.battery, now):
                faults.append(Fault(Event.BATTERY, f"{name} at {state.battery:.2f} V"))
        return faults

    def unverified_axes(self) -> str:
        """Instruction to move the pair by hand so that the IMUs verify the remaining axes; empty if none remain."""
        orders = [(name, watch.imu.unverified_axes()) for name, watch in zip(NAMES, self._drones, strict=True)]
        return next((f"{order} within a second (the {name} has not shown it)" for name, order in orders if order), "")

    def _measured(self, phase: FlightState, links: Sequence[DroneLink], now: float) -> list[Fault]:
        """Faults of frozen streams and of contradictions to the IMU; updated on the ground too, reported in flight."""
        found = []
        for number, (name, link, watch) in enumerate(zip(NAMES, links, self._drones, strict=True)):
            sample, sensed, clock = link.telemetry.newest, link.telemetry.sensed, link.telemetry.clock
            still = watch.state(sample) if sample is not None else ""
            wrong = ""
            if sensed is not None:
                repeated, wrong = watch.sensed(sensed.sensed, clock.seconds(sensed.stamp))
                still = still or repeated
            own = [Fault(Event.ESTIMATOR, f"{name}: {still}")] if still and now - self._closed_at <= TOGETHER else []
            own += [Fault(Event.FRAME, f"{name}: {wrong}")] if wrong and phase in RISING else []
            if self._settings.dry_run:  # carried by hand it can contradict its IMU, but at rest its streams may freeze
                own = [fault for fault in own if fault.event is Event.FRAME]
            if own:
                self.estimators.trusted[number] = False
                found += own
        return found

    def _from_state(self, name: str, state: DroneState, limits: Limits, armed: bool) -> list[Fault]:
        if not np.isfinite([*state.position, *state.velocity, *state.quaternion, *state.rates]).all():
            return [Fault(Event.BAD_STATE, f"state of the {name} is not finite")]
        faults, place, tilt = [], state.position - self.origin, rotations.tilt_of_quaternion(state.quaternion)
        if (place < limits.fence_low).any() or (place > limits.fence_high).any():
            where = ", ".join(f"{value:.2f}" for value in place)
            faults.append(Fault(Event.FENCE, f"{name} at ({where}) m"))
        if tilt > limits.tilt:
            faults.append(Fault(Event.TILT, f"{name} tilts {math.degrees(tilt):.0f} degrees"))
        if down := down_reason(state.info, armed):
            faults.append(Fault(Event.DRONE_DOWN, f"{name} {down}"))
        return faults


class EstimatorWatch:
    """Checks both estimators. `update` once a tick; `trusted` (2,) says whose position may be used."""

    def __init__(self, rig: Rig, sideways: bool = True, limits: Limits = LIMITS):
        """Not `sideways`: on a stand, whose locked axes are ignored since the estimates drift along them."""
        self._rig, self._limits = rig, limits
        self._axes = (0, 1, 2) if sideways else (2,)
        self._before: list[Sample | None] = [None, None]
        self._height, self._climb, self._relative = Sustained(LASTING), Sustained(LASTING), Sustained(REPEATING)
        self._mean: np.ndarray | None = None  # (3,) slow mean of the leader's error against follower and stick [m]
        self._mean_time = 0.0  # [s] time of that mean
        self._spread = np.zeros(3)  # (3,) standard deviation of the relative position, by the filters' variances [m]
        self.trusted = [True, True]
        self.contradiction = False  # the estimates contradict each other, and it is unknown which one is wrong

    def update(self, samples: Sequence[Sample], healths: Sequence[Health | None], now: float) -> list[Fault]:
        """Faults of the estimates at `now` [s]. An estimator that is not trusted once stays so for the flight."""
        found = []
        for number, (sample, health) in enumerate(zip(samples, healths, strict=True)):
            reason = self._jumped(number, sample) or self._uncertain(health)
            if reason:
                self.trusted[number] = False
                found.append(Fault(Event.ESTIMATOR, f"{NAMES[number]}: {reason}"))
        known = [health.variance for health in healths if health is not None]
        self._spread = np.sqrt(np.sum(known, axis=0)) if known else self._spread
        if all(self.trusted):
            found += self._against_each_other(samples, now)
        return found

    def _jumped(self, number: int, sample: Sample) -> str:
        before, self._before[number] = self._before[number], sample
        if before is None or before.stamp == sample.stamp:
            return ""
        step = sample.stamp - before.stamp
        if not 0 < step <= JUMP_TIME:
            return ""
        velocity = 0.5 * (sample.state.velocity + before.state.velocity)
        beyond = sample.state.position - before.state.position - step * velocity
        size = math.sqrt(sum(float(beyond[axis]) ** 2 for axis in self._axes))
        return f"its position jumped by {size:.2f} m" if size > JUMP else ""

    def _uncertain(self, health: Health | None) -> str:
        if health is None:
            return ""
        variance = max(health.variance[axis] for axis in self._axes)
        if variance <= self._limits.variance:
            return ""
        return f"position variance {variance:.2g} m2, no more than {self._limits.variance:g} is believed"

    def _against_each_other(self, samples: Sequence[Sample], now: float) -> list[Fault]:
        """Compare heights, climbs and relative position of the drones with the stick at its measured attitude."""
        leader, follower = (sample.state for sample in samples)
        matrices = [rotations.matrix_from_quaternion(state.quaternion) for state in (leader, follower)]
        matrix, span = 0.5 * (matrices[0] + matrices[1]), self._rig.span
        turning = rotations.cross(0.5 * (leader.rates + follower.rates), span)
        later = (samples[0].arrival - samples[1].arrival) * 0.5 * (leader.velocity + follower.velocity)
        beside = leader.position - follower.position - later - matrix @ span
        faster = float((leader.velocity - follower.velocity - matrix @ turning)[2])
        details = {
            f"the leader's height is {100 * beside[2]:+.0f} cm from where the follower and the roll put it": (
                self._height.update(abs(beside[2]) > max(HEIGHT, SIGMAS * math.sqrt(2) * self._limits.noise), now)
            ),
            f"the leader climbs {faster:+.1f} m/s against the follower": self._climb.update(abs(faster) > CLIMB, now),
        }
        apart = self._moved_apart(beside, now)
        details[f"the leader moved {1000 * apart:.0f} mm from where the stick puts it"] = self._relative.update(
            apart > 0, now
        )
        found = [Fault(Event.ESTIMATOR, detail) for detail, holds in details.items() if holds][:1]
        self.contradiction = self.contradiction or bool(found)
        return found

    def _moved_apart(self, beside: np.ndarray, now: float) -> float:
        """Largest change [m] of `beside` (3,), the leader's position error against follower and stick; 0 within noise.

        The change is from a slow mean: a constant error, of the frames or mounts, is no fault.
        """
        if self._mean is None:
            self._mean, self._mean_time = beside, now
        moved = beside - self._mean
        self._mean = self._mean - math.expm1((self._mean_time - now) / USUAL) * moved
        self._mean_time = now
        beyond = np.abs(moved)[list(self._axes)] > np.maximum(APART, SIGMAS * self._spread[list(self._axes)])
        return float(np.abs(moved)[list(self._axes)].max()) if beyond.any() else 0.0

    def object(self, samples: Sequence[Sample], fresh: Sequence[bool]) -> ObjectState | None:
        """The object's state from the fresh and trusted estimates; None if there is none.

        If the two contradict each other, it has the lower height and the faster descent.
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
    """Whether one drone acts on its setpoints: the thrust in force was sent recently, and changes as the sent one does.

    A constant thrust in force shows a lost uplink before it is too old, even if its value happens to be sent again.
    """

    def __init__(self, name: str):
        self._name = name
        self._sent: collections.deque[tuple[float, int]] = collections.deque()
        self._missing = 0
        self._checked, self._before = -math.inf, math.nan
        self.heard = -math.inf  # [s] send time of the last thrust that it acted on
        self.hears = True  # whether the newest health packet shows that it acts on setpoints

    @property
    def frozen(self) -> Fault:
        """The fault of a drone that does not act on setpoints because all its values are frozen."""
        return Fault(
            Event.FROZEN,
            f"all numbers of the {self._name} stand still: its IMU is dead, or its control or its estimator hangs",
        )

    def sent(self, thrust: int, now: float) -> None:
        """Add a sent `thrust` [units] at `now` [s]."""
        self._sent.append((now, thrust))

    def update(self, health: Health, arrival: float) -> list[Fault]:
        """Check a health packet that arrived at `arrival` [s], once; return the fault if it is not heard."""
        if arrival <= self._checked or not math.isfinite(health.thrust):
            return []
        self._checked = arrival
        while self._sent and self._sent[0][0] < arrival - ECHO:
            self._sent.popleft()
        moved, self._before = health.thrust != self._before, health.thrust
        times = [time for time, thrust in self._sent if time <= arrival and abs(thrust - health.thrust) < ROUNDING]
        recent = [thrust for time, thrust in self._sent if time >= arrival - RECENT]
        # A constant thrust in force is right if most recent ones were equal to it, as at a bound; else one was lost.
        usual = sum(abs(thrust - health.thrust) < ROUNDING for thrust in recent) >= len(recent) / 2
        self.hears = bool(times) and (moved or usual)
        if self.hears:
            self._missing, self.heard = 0, max(self.heard, times[-1])
            return []
        self._missing += 1
        if self._missing < UNHEARD:
            return []
        return [Fault(Event.UNHEARD, f"the {self._name} acts on thrust {health.thrust:.0f}, which was not sent lately")]
