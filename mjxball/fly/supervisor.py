"""The safety supervisor: a pure state machine. `TRANSITIONS` is all of it; `docs/flying.md` prints the same table.

States say what both drones are sent, and always both: any fault on one of them brings both down together.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple


class State(Enum):
    """What both drones are sent."""

    CHECK = "check"  # zeros, while the checks before flight run
    ARM = "arm"  # zeros, which open the firmware's thrust lock while it arms
    RAMP = "ramp"  # level, thrust rising to hover
    FLY = "fly"  # leader PID and follower policy
    LAND = "land"  # the same laws toward a goal that sinks
    DESCEND = "descend"  # level, thrust held to a sinking speed where it is known, else ramped down
    HOLD = "hold"  # a drone is not heard: level, a little less than the trims, until its own watchdog must stop it
    STOP = "stop"  # zeros and stop setpoints
    KILL = "kill"  # emergency stop, repeated; the firmware stays locked until reboot
    DONE = "done"  # motors off, disarmed; nothing more is sent

    @property
    def severity(self) -> int:
        """Order in which states may follow each other; aborts never go back."""
        return list(State).index(self)


class Event(Enum):
    """What may happen."""

    READY = "all checks before flight passed"
    REFUSED = "a check before flight failed"
    ARMED = "both drones armed with the thrust lock open"
    HOVERING = "the thrust ramp ended"
    TIME_UP = "the flight time is over"
    INTERRUPT = "Ctrl-C or SIGTERM"
    KEY_KILL = "kill key, or Ctrl-C again"
    STALE = "a drone's state is older than 100 ms by the host's or the firmware's clock"
    LINK_LOST = "a link reported its end"
    BAD_STATE = "a state or a command is not finite"
    FENCE = "a drone left the geofence"
    TILT = "a drone tilts beyond the limit"
    STICK = "the two positions contradict the stick: its length or its tilt"
    BATTERY = "a battery is low"
    SATURATED = "thrust has been at its bound for too long"
    DEADLINES = "the loop missed too many deadlines"
    WATCHDOG = "the watchdog process ended"
    DRONE_DOWN = "a drone's firmware is locked, crashed, tumbled or cannot fly"
    TOUCHED_DOWN = "the pair stands on the ground"
    TIMEOUT = "the state has lasted as long as it may"


class Fault(NamedTuple):
    """An event with what is known about it."""

    event: Event
    detail: str = ""


S, E = State, Event
BEFORE_MOTORS = (S.CHECK, S.ARM)
GUIDED = (S.FLY, S.LAND)  # leader and follower laws are in command
AIRBORNE = (S.RAMP, S.FLY, S.LAND, S.DESCEND, S.HOLD)
ENDED = (S.STOP, S.KILL, S.DONE)


def _planned() -> dict[tuple[State, Event], State]:
    """A flight in which nothing is wrong, and who may end it early."""
    return {
        (S.CHECK, E.READY): S.ARM,
        (S.ARM, E.ARMED): S.RAMP,
        (S.RAMP, E.HOVERING): S.FLY,
        (S.FLY, E.TIME_UP): S.LAND,
        (S.FLY, E.TIMEOUT): S.LAND,
        (S.FLY, E.INTERRUPT): S.LAND,
        (S.RAMP, E.INTERRUPT): S.DESCEND,
        (S.LAND, E.TOUCHED_DOWN): S.STOP,
        (S.DESCEND, E.TOUCHED_DOWN): S.STOP,
        (S.STOP, E.TIMEOUT): S.DONE,
        (S.KILL, E.TIMEOUT): S.DONE,
    }


def _on_the_ground() -> dict[tuple[State, Event], State]:
    """Before the motors turn, whatever is wrong ends it."""
    harmless = {E.READY, E.ARMED, E.HOVERING, E.TIME_UP, E.TOUCHED_DOWN, E.SATURATED, E.DEADLINES}
    return {(state, event): S.STOP for state in BEFORE_MOTORS for event in E if event not in harmless}


def _in_the_air() -> dict[tuple[State, Event], State]:
    """What can still be flown lands or sinks level, what cannot be heard is mirrored, what is lost is cut."""
    table = {(S.FLY, event): S.LAND for event in (E.BATTERY, E.WATCHDOG)}
    table |= {(S.RAMP, event): S.DESCEND for event in (E.BATTERY, E.WATCHDOG, E.TIMEOUT)}
    table[S.LAND, E.TIMEOUT] = S.DESCEND
    for state in (S.RAMP, *GUIDED):
        table |= {(state, event): S.DESCEND for event in (E.BAD_STATE, E.FENCE, E.SATURATED, E.DEADLINES)}
    for state in AIRBORNE:
        table |= {(state, event): S.STOP for event in (E.DRONE_DOWN, E.TILT, E.STICK)}
        table |= {(state, event): S.HOLD for event in (E.STALE, E.LINK_LOST)}
    table |= {(state, E.TIMEOUT): S.STOP for state in (S.DESCEND, S.HOLD)}
    table[S.DESCEND, E.BAD_STATE] = S.STOP
    return table


def _table() -> dict[tuple[State, Event], State]:
    """Every pair that changes the state; all others keep it. A kill is possible until everything is over."""
    kill = {(state, E.KEY_KILL): S.KILL for state in S if state is not S.DONE}
    return _planned() | _on_the_ground() | _in_the_air() | kill


TRANSITIONS = {pair: state for pair, state in _table().items() if pair[0] is not state}
SHORT = (S.ARM, S.RAMP)  # states whose time limit is only reached if something is wrong
# The flight's exit code is 1 after any of these, or after a state of SHORT that lasted too long.
FAULTS = frozenset(E) - {E.READY, E.ARMED, E.HOVERING, E.TIME_UP, E.INTERRUPT, E.TOUCHED_DOWN, E.TIMEOUT}


@dataclass(frozen=True)
class Supervisor:
    """State and when it was entered. Immutable: `after` returns the next one."""

    state: State = State.CHECK
    since: float = 0.0  # [s]
    cause: Fault | None = None  # what began the abort

    def after(self, faults: list[Fault], now: float) -> Supervisor:
        """The supervisor after everything that happened in one tick ending at `now` [s]."""
        led = [
            (TRANSITIONS[self.state, fault.event], fault)
            for fault in faults
            if (self.state, fault.event) in TRANSITIONS
        ]
        # Whoever pressed the kill key wants nothing else.
        asked = [pair for pair in led if pair[1].event is Event.KEY_KILL]
        best, why = max(asked or led, key=lambda pair: pair[0].severity, default=(self.state, None))
        if why is None:
            return self
        unplanned = why.event in FAULTS or (self.state in SHORT and why.event is Event.TIMEOUT)
        first = self.cause or (why if unplanned else None)
        return Supervisor(best, now, first)


def table_rows() -> list[tuple[str, str, str]]:
    """(state, event, next state) of every transition, in the order of the enumerations: what the docs print."""
    order = [(state, event) for state in State for event in Event]
    return [(s.value, e.value, TRANSITIONS[s, e].value) for s, e in order if (s, e) in TRANSITIONS]


def markdown() -> str:
    """The table as Markdown, an event a line and a state a column; an empty cell keeps the state."""
    states = [state for state in State if state is not State.DONE]
    lines = ["| event | " + " | ".join(state.value for state in states) + " |", "|---" * (len(states) + 1) + "|"]
    for event in Event:
        cells = [TRANSITIONS[state, event].value if (state, event) in TRANSITIONS else "" for state in states]
        lines.append(f"| {event.value} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
