"""States of both drones with their ages, by arrival and by the firmware's clock; state of the object from both."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjxball import config as configs
from mjxball.control import rotations
from mjxfly.app.protocol import AppSample
from mjxfly.packets import DroneState, Health, Packet, Sensed

Note = Callable[..., None]  # note(kind, t=None, **fields) adds a record to the flight log without blocking
WRAP = 1 << 24  # [ms] the firmware's time stamps have 24 bits
LONGEST_STEP = 10_000  # [ms] between two stamps; a larger one means that the drone was restarted
DRIFT = 1e-4  # largest relative drift of the firmware's clock against ours


class Sample(NamedTuple):
    """One received state."""

    state: DroneState
    arrival: float  # [s] of our monotonic clock
    stamp: float  # [s] of the firmware's clock, unwrapped


class HealthSample(NamedTuple):
    """One received health packet."""

    health: Health
    arrival: float  # [s] of our monotonic clock


class SensedSample(NamedTuple):
    """One received packet of sensed values."""

    sensed: Sensed
    stamp: int  # [ms] of the firmware's clock


class FirmwareClock:
    """Maps time stamps to our clock, with the smallest delay so far taken as zero.

    The age of a packet then includes its time in queues, and repeated packets with an old stamp age although they keep
    arriving.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._time = 0  # [ms] unwrapped
        self._offset = math.inf  # [s] arrival minus stamp
        self._newest = 0.0  # [s] newest arrival, our clock
        self.restarted = False

    def update(self, stamp: int, arrival: float) -> float | None:
        """Unwrapped time of `stamp` [ms] in seconds, None if it is older than an earlier one or the drone restarted."""
        if self._last is not None:
            step = (stamp - self._last + WRAP // 2) % WRAP - WRAP // 2
            self.restarted = self.restarted or abs(step) > LONGEST_STEP
            if step < 0 or self.restarted:
                return None
            self._time += step
        self._last = stamp
        seconds = self._time / 1000
        self._offset = min(arrival - seconds, self._offset + DRIFT * max(arrival - self._newest, 0.0))
        self._newest = arrival
        return seconds

    def seconds(self, stamp: int) -> float:
        """Unwrapped time of `stamp` [ms] in seconds, for a packet close to the newest state; NaN before the first."""
        if self._last is None:
            return math.nan
        return (self._time + (stamp - self._last + WRAP // 2) % WRAP - WRAP // 2) / 1000

    def age(self, seconds: float, now: float) -> float:
        """Age [s] at `now` of a packet stamped at `seconds` of the firmware's clock."""
        return math.inf if self.restarted else now - (seconds + self._offset)


class Telemetry:
    """Newest samples of one drone, and counts of its states."""

    def __init__(self) -> None:
        self.clock = FirmwareClock()
        self.newest: Sample | None = None
        self.health: HealthSample | None = None
        self.sensed: SensedSample | None = None  # None until the first one, or if the firmware does not list it
        self.app: AppSample | None = None
        self.received = self.damaged = self.late = 0

    def take(self, state: DroneState, stamp: int, arrival: float) -> bool:
        """Store a state stamped `stamp` [ms] that arrived at `arrival` [s]; false if it is older than the newest."""
        self.received += 1
        seconds = self.clock.update(stamp, arrival)
        if seconds is None:
            self.late += 1
            return False
        self.newest = Sample(state, arrival, seconds)
        return True

    def age(self, now: float) -> float:
        """Age of the newest state [s], the larger of both clocks'; infinite before the first one."""
        sample = self.newest
        if sample is None:
            return math.inf
        return max(now - sample.arrival, self.clock.age(sample.stamp, now))


class DroneLink(Protocol):
    """The part of `link.Link` that a flight uses. Nothing here blocks."""

    telemetry: Telemetry
    lost: str | None  # why the link has ended
    busy: bool | str  # of `write_later`: True while writing, a text if it failed

    def send(self, packet: Packet) -> None:
        """Send `packet` as the newest setpoint."""

    def command(self, packet: Packet) -> None:
        """Send `packet` ahead of setpoints."""

    def write_later(self, values: Mapping[str, float]) -> None:
        """Write firmware parameters; see `busy`."""

    def stuck_for(self, now: float) -> float:
        """Time for which waiting packets could not be sent [s]."""
        ...


class ObjectState(NamedTuple):
    """State of the assembly, as the controllers observe it."""

    position: np.ndarray  # (3,) of O in the world [m]
    velocity: np.ndarray  # (3,) [m/s]
    quaternion: np.ndarray  # (4,) attitude body -> world (w, x, y, z), as the follower measures it
    rates: np.ndarray  # (3,) body rates [rad/s], likewise

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) attitude body -> world."""
        return rotations.matrix_from_quaternion(self.quaternion)


@dataclass(frozen=True)
class Rig:
    """Mounting points of leader and follower relative to O, body axes [m]."""

    leader_mount: tuple[float, float, float]
    follower_mount: tuple[float, float, float]

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> Rig:
        """The rig that a policy was trained for, from its metadata."""
        plant: Any = metadata["plant"]
        leader = int(plant.get("leader", 0))
        mounts = [tuple(drone["mount"]) for drone in plant["drones"]]
        return cls(mounts[leader], mounts[1 - leader])

    @classmethod
    def of_plant(cls, plant: configs.Plant) -> Rig:
        """The rig of a plant with two drones. Raises InputError for any other."""
        leader, follower = plant.pair
        return cls(leader.mount, follower.mount)

    @property
    def mounts(self) -> np.ndarray:
        """(2, 3) mounting points of leader and follower relative to O [m]."""
        return np.array([self.leader_mount, self.follower_mount])

    @property
    def span(self) -> np.ndarray:
        """(3,) position of the leader relative to the follower [m]."""
        return np.array(self.leader_mount) - np.array(self.follower_mount)

    @property
    def weights(self) -> tuple[float, float]:
        """Weights of leader and follower by which the mean of their mounts is O."""
        ahead, behind = (float(np.linalg.norm(mount)) for mount in (self.leader_mount, self.follower_mount))
        return behind / (ahead + behind), ahead / (ahead + behind)


def object_state(states: Sequence[DroneState], rig: Rig) -> ObjectState:
    """State of the object from both drones' `states` (leader, follower).

    Position and velocity of O are weighted means, which need no attitude and average the two estimators' errors.
    Attitude and rates are the follower's own, as its policy observes them (paper).
    """
    lead, follow = rig.weights
    position = lead * states[0].position + follow * states[1].position
    velocity = lead * states[0].velocity + follow * states[1].velocity
    return ObjectState(position, velocity, states[1].quaternion, states[1].rates)


def object_of_one(state: DroneState, mount: np.ndarray) -> ObjectState:
    """State of the object from one drone's: p_O = p - R r, with `mount` r (3,) [m]."""
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    position = state.position - matrix @ mount
    velocity = state.velocity - matrix @ rotations.cross(state.rates, mount)
    return ObjectState(position, velocity, state.quaternion, state.rates)


def yaw_of(state: DroneState) -> float:
    """Yaw [rad] of one drone."""
    return float(rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))[2])
