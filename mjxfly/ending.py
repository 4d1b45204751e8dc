"""Why a flight ended and how it came down: the signals of the last second in their order, and the touchdown. Pure.

The supervisor acts on the worst of what it sees in one tick. What began first is often another signal, such as a
computer that stood still and for that reason neither sent nor heard anything.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjxfly.limits import NAMES, FlightSettings
from mjxfly.packets import GRAVITY
from mjxfly.supervisor import ENDED, PLANNED, Event, Fault, Supervisor

LAST = 1.0  # [s] before the abort from which on a signal may be its cause
APART = 0.2  # [s] between two signals that have nothing to do with each other
LATE = 0.03  # [s] of a tick, from where on it is a signal
SHOWN = 3  # signals at most
CONTACT = 0.02  # [m] of O above where it stood
SPEED_TIME = 0.15  # [s] before the contact in which the fastest descent counts
SPARE = 0.5  # [m/s] that a descent may be faster than a free fall from the highest place


@dataclass
class Signal:
    """Something that was wrong for a while."""

    event: Event
    text: str  # as it began
    began: float  # [s]
    last: float  # [s]


class Signals:
    """What is wrong, since when. `update` once a tick while the pair may fly."""

    def __init__(self, settings: FlightSettings):
        bounds = settings.limits
        # What is reported once it has lasted for so long [s].
        self._lead = {
            Event.STALE: bounds.state_age,
            Event.LINK_LOST: bounds.state_age,
            Event.UNHEARD: bounds.state_age,
            Event.FROZEN: bounds.state_age,
            Event.SATURATED: bounds.saturation_time,
        }
        self._period = settings.period
        self._open: dict[tuple[Event, str], Signal] = {}
        self._all: list[Signal] = []

    def update(self, faults: Sequence[Fault], now: float, gap: float = 0.0) -> None:
        """What one tick at `now` [s] found, `gap` [s] after the one before."""
        late = max(gap - self._period, 0.0)
        for fault in faults:
            if fault.event not in (*PLANNED, Event.INTERRUPT, Event.TIMEOUT, Event.DEADLINES):
                self._note(fault.event, str(fault), now - self._lead.get(fault.event, 0.0), now)
        missed = next((f" ({fault.detail})" for fault in faults if fault.event is Event.DEADLINES), "")
        if late > LATE or missed:
            # It explains what was neither sent nor heard meanwhile, so it comes before that.
            text = f"this computer was too busy: a tick came {1e3 * late:.0f} ms late{missed}"
            self._note(Event.DEADLINES, text, now - gap - self._lead[Event.STALE], now)

    def _note(self, event: Event, text: str, began: float, now: float) -> None:
        key = event, next((name for name in NAMES if name in text), "")
        signal = self._open.get(key)
        if signal is None or now - signal.last > APART:
            signal = self._open[key] = Signal(event, text, began, now)
            self._all.append(signal)
        signal.last = now

    def chain(self, cause: Fault, at: float) -> list[Signal]:
        """The signals of an abort with `cause` at `at` [s], the first one first.

        Back from the abort, whatever did not end before the next one began; then what followed. Nothing older than a
        second counts.
        """
        known = sorted((one for one in self._all if one.last >= at - LAST), key=lambda one: one.began)
        first = at
        for one in sorted(known, key=lambda one: -one.last):
            if one.last >= first - APART:
                first = min(first, one.began)
        return [one for one in known if one.began >= first] or [Signal(cause.event, str(cause), at, at)]


class Touchdown:
    """The first contact with the ground after the pair was up, as the estimators have it."""

    def __init__(self, lifted: float):
        """`lifted` [m] of O above where it stood is up."""
        self._lifted, self.up = lifted, False
        self._fall: collections.deque[tuple[float, float]] = collections.deque()
        self._highest = 0.0  # [m]
        self.doubt = ""  # why what the estimators have is no fact
        self.speed = math.nan  # downward [m/s]
        self.place = np.full(2, math.nan)  # (2,) of O from where it stood [m]

    def update(self, place: np.ndarray, climb: float, now: float, doubt: str = "") -> None:
        """O is at `place` (3,) from where it stood [m] and climbs at `climb` [m/s].

        One `doubt` of that in the air, or a descent faster than any fall, and nothing is told any more.
        """
        if math.isfinite(self.speed) or self.doubt or not (np.isfinite(place).all() and math.isfinite(climb)):
            return
        self._highest = max(self._highest, float(place[2]))
        if not doubt and -climb > math.sqrt(2 * GRAVITY * self._highest) + SPARE:
            doubt = "its estimated speed is faster than a fall"
        self.doubt = doubt if self.up else ""
        if self.doubt:
            return
        self.up = self.up or place[2] >= self._lifted
        self._fall.append((now, -climb))
        while self._fall[0][0] < now - SPEED_TIME:
            self._fall.popleft()
        if self.up and place[2] < CONTACT:
            self.speed, self.place = max(fall for _, fall in self._fall), place[:2].copy()

    def __str__(self) -> str:
        """Speed and place."""
        if not math.isfinite(self.speed):
            return f"how fast and where is not known: {self.doubt}" if self.doubt else "no touchdown was seen"
        x, y = self.place
        return f"{max(self.speed, 0.0):.2f} m/s, at ({x:+z.2f}, {y:+z.2f}) m from the start"


class Ending:
    """Both, for one flight."""

    def __init__(self, settings: FlightSettings, lifted: float):
        self._signals, self.touchdown = Signals(settings), Touchdown(lifted)
        self._aborted, self._now = math.inf, 0.0

    def update(self, faults: Sequence[Fault], supervisor: Supervisor, now: float, gap: float) -> None:
        """One tick: its `faults`, and the `supervisor` after it."""
        self._now = now
        if supervisor.cause is None:
            self._aborted = math.inf  # also where a gap has closed again
        elif math.isinf(self._aborted):
            self._aborted = now
        if supervisor.state not in ENDED or now == self._aborted:
            self._signals.update(faults, now, gap)

    def sentences(self, supervisor: Supervisor, start: float, asked: bool) -> list[str]:
        """How it ended, a line each; `start` [s] of the flight, `asked` to land."""
        landed = f"landed {'as asked' if asked else 'as planned'}: {self.touchdown}"
        if supervisor.cause is None:
            return [landed] if self.touchdown.up else []
        chain = self._signals.chain(supervisor.cause, min(self._aborted, self._now))[:SHOWN]
        parts = [f"{one.text} (at {max(one.began - start, 0.0):.2f} s)" for one in chain]
        told = [f"ended early: {'; then '.join(parts)}"]
        if supervisor.cause.event not in [one.event for one in chain]:
            told.append(f"that led to: {supervisor.cause}")
        return [*told, f"came down: {self.touchdown}"] if self.touchdown.up else told
