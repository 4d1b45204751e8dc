"""Why a flight ended and how the pair came down: faults of the last second in order, and the touchdown. Pure.

The supervisor acts on the most severe fault of one tick. Another one often began earlier, such as a computer that
stalled and therefore neither sent nor received anything.
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

LAST = 1.0  # [s] before the abort in which a signal may be its cause
APART = 0.2  # [s] of silence after which the same fault counts as a new signal, and two signals as unrelated
LATE = 0.03  # [s] lateness of a tick that counts as a signal
SHOWN = 3  # signals in the report at most
CONTACT = 0.02  # [m] height of O above where it stood that counts as contact
SPEED_TIME = 0.15  # [s] before the contact; the fastest descent in it is the touchdown speed
SPARE = 0.5  # [m/s] by which a descent may exceed a free fall from the highest point


@dataclass
class Signal:
    """A fault that lasted for some time."""

    event: Event
    text: str  # at its beginning
    began: float  # [s]
    last: float  # [s]


class Signals:
    """Faults and when they began. `update` once a tick while the pair may fly."""

    def __init__(self, settings: FlightSettings):
        bounds = settings.limits
        # Time [s] for which these faults have lasted when they are first reported.
        self._delay = {
            Event.STALE: bounds.state_age,
            Event.LINK_LOST: bounds.state_age,
            Event.UNHEARD: bounds.state_age,
            Event.FROZEN: bounds.state_age,
            Event.SATURATED: bounds.saturation_time,
        }
        self._period = settings.period
        self._active: dict[tuple[Event, str], Signal] = {}
        self._history: list[Signal] = []

    def update(self, faults: Sequence[Fault], now: float, gap: float = 0.0) -> None:
        """Add the `faults` of one tick at `now` [s], `gap` [s] after the previous one."""
        late = max(gap - self._period, 0.0)
        for fault in faults:
            if fault.event not in (*PLANNED, Event.INTERRUPT, Event.TIMEOUT, Event.DEADLINES):
                self._note(fault.event, str(fault), now - self._delay.get(fault.event, 0.0), now)
        missed = next((f" ({fault.detail})" for fault in faults if fault.event is Event.DEADLINES), "")
        if late > LATE or missed:
            # The stall explains missing messages, so it must precede the faults that these cause.
            text = f"this computer was too busy: a tick came {1e3 * late:.0f} ms late{missed}"
            self._note(Event.DEADLINES, text, now - gap - self._delay[Event.STALE], now)

    def _note(self, event: Event, text: str, began: float, now: float) -> None:
        key = event, next((name for name in NAMES if name in text), "")
        signal = self._active.get(key)
        if signal is None or now - signal.last > APART:
            signal = self._active[key] = Signal(event, text, began, now)
            self._history.append(signal)
        signal.last = now

    def chain(self, cause: Fault, at: float) -> list[Signal]:
        """The signals that led to an abort with `cause` at time `at` [s], in order of their beginning.

        Going back from the abort, a signal belongs to the chain if it lasted until `APART` before the chain so far
        began. Signals that ended more than `LAST` before the abort do not count.
        """
        known = sorted((one for one in self._history if one.last >= at - LAST), key=lambda one: one.began)
        first = at
        for one in sorted(known, key=lambda one: -one.last):
            if one.last >= first - APART:
                first = min(first, one.began)
        return [one for one in known if one.began >= first] or [Signal(cause.event, str(cause), at, at)]


class Touchdown:
    """First contact with the ground after take-off, by the drones' estimates."""

    def __init__(self, lifted: float):
        """`lifted` [m] is the height of O above its start from which the pair counts as airborne."""
        self._lifted, self.up = lifted, False
        self._fall: collections.deque[tuple[float, float]] = collections.deque()
        self._highest = 0.0  # [m]
        self.doubt = ""  # why the estimates cannot be trusted
        self.speed = math.nan  # downward [m/s]
        self.place = np.full(2, math.nan)  # (2,) of O from where it stood [m]

    def update(self, place: np.ndarray, climb: float, now: float, doubt: str = "") -> None:
        """Add O's position `place` (3,) relative to its start [m] and its vertical speed `climb` [m/s].

        After a `doubt` in the air, or a descent faster than a fall, speed and place stay unknown.
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
        """Speed and place of the touchdown in words."""
        if not math.isfinite(self.speed):
            return f"how fast and where is not known: {self.doubt}" if self.doubt else "no touchdown was seen"
        x, y = self.place
        return f"{max(self.speed, 0.0):.2f} m/s, at ({x:+z.2f}, {y:+z.2f}) m from the start"


class Ending:
    """Collects the signals and the touchdown of one flight, and reports its end."""

    def __init__(self, settings: FlightSettings, lifted: float):
        self._signals, self.touchdown = Signals(settings), Touchdown(lifted)
        self._aborted, self._now = math.inf, 0.0

    def update(self, faults: Sequence[Fault], supervisor: Supervisor, now: float, gap: float) -> None:
        """Add one tick at `now` [s]: its `faults`, the `supervisor` after it, `gap` [s] since the previous tick."""
        self._now = now
        if supervisor.cause is None:
            self._aborted = math.inf  # also after a HOLD that was resumed
        elif math.isinf(self._aborted):
            self._aborted = now
        if supervisor.state not in ENDED or now == self._aborted:
            self._signals.update(faults, now, gap)

    def sentences(self, supervisor: Supervisor, start: float, asked: bool) -> list[str]:
        """The end of the flight in sentences; it began at `start` [s], `asked`: the user requested the landing."""
        landed = f"landed {'as asked' if asked else 'as planned'}: {self.touchdown}"
        if supervisor.cause is None:
            return [landed] if self.touchdown.up else []
        chain = self._signals.chain(supervisor.cause, min(self._aborted, self._now))[:SHOWN]
        parts = [f"{one.text} (at {max(one.began - start, 0.0):.2f} s)" for one in chain]
        sentences = [f"ended early: {'; then '.join(parts)}"]
        if supervisor.cause.event not in [one.event for one in chain]:
            sentences.append(f"that led to: {supervisor.cause}")
        return [*sentences, f"came down: {self.touchdown}"] if self.touchdown.up else sentences
