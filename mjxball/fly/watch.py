"""What is watched in flight beyond single states: the estimators, and whether a drone acts as told. Pure.

The estimators run on the drones. One whose poses stop, freeze or jump goes on reporting; it shows in the variance, in a
step that its own velocity does not explain, or against the other drone, which sits on the same stick.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjxball.control import rotations
from mjxball.fly.limits import NAMES, Sustained
from mjxball.fly.packets import Health
from mjxball.fly.pair import ObjectState, Rig, object_of_one, object_state
from mjxball.fly.supervisor import Event, Fault
from mjxball.fly.telemetry import Sample


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
