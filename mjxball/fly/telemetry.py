"""How old a drone's state is: by when it arrived here, and by the firmware's own clock. Pure but for its memory."""

from __future__ import annotations

import math
from typing import NamedTuple

from mjxball.fly.packets import DroneState, Health

WRAP = 1 << 24  # [ms] the firmware's time stamps have 24 bits
LONGEST_STEP = 10_000  # [ms] between two stamps; a larger one means that the drone was restarted
DRIFT = 1e-4  # of the firmware's clock against ours


class Sample(NamedTuple):
    """One state as it arrived."""

    state: DroneState
    arrival: float  # [s] of our monotonic clock
    stamp: float  # [s] of the firmware's clock, unwrapped


class HealthSample(NamedTuple):
    """One health packet as it arrived."""

    health: Health
    arrival: float  # [s] of our monotonic clock


class FirmwareClock:
    """Maps time stamps to our clock: the least delay ever seen counts as none.

    A packet that waited in a queue is then old by this clock although it has just arrived, and one that repeats an
    old stamp grows old although packets keep coming.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._time = 0  # [ms] unwrapped
        self._offset = math.inf  # [s] arrival less stamp
        self._newest = 0.0  # [s] of our clock
        self.restarted = False

    def update(self, stamp: int, arrival: float) -> float | None:
        """Time of `stamp` [ms] in seconds, None if it is older than one already seen or its clock started anew."""
        if self._last is not None:
            step = (stamp - self._last + WRAP // 2) % WRAP - WRAP // 2
            if abs(step) > LONGEST_STEP:
                self.restarted = True
            if step < 0 or self.restarted:
                return None
            self._time += step
        self._last = stamp
        seconds = self._time / 1000
        self._offset = min(arrival - seconds, self._offset + DRIFT * max(arrival - self._newest, 0.0))
        self._newest = arrival
        return seconds

    def age(self, seconds: float, now: float) -> float:
        """Age [s] at `now` of what was stamped at `seconds` of the firmware."""
        return math.inf if self.restarted else now - (seconds + self._offset)


class Telemetry:
    """The newest state of one drone, and how many came."""

    def __init__(self) -> None:
        self.clock = FirmwareClock()
        self.newest: Sample | None = None
        self.health: HealthSample | None = None
        self.received = self.damaged = self.late = 0

    def take(self, state: DroneState, stamp: int, arrival: float) -> Sample | None:
        """A state came with time stamp `stamp` [ms] at `arrival` [s]; None if a newer one came before."""
        self.received += 1
        seconds = self.clock.update(stamp, arrival)
        if seconds is None:
            self.late += 1
            return None
        sample = Sample(state, arrival, seconds)
        self.newest = sample
        return sample

    def age(self, now: float) -> float:
        """The worse of both ages [s]; infinite before the first state."""
        sample = self.newest
        if sample is None:
            return math.inf
        return max(now - sample.arrival, self.clock.age(sample.stamp, now))
