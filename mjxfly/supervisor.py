"""The safety supervisor: a pure state machine. `TRANSITIONS` is all of it; docs/supervisor.md shows it as a table.

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
    SPIN = "spin"  # level, a third of hover: what the motors get shows which force curve the firmware has
    RAMP = "ramp"  # level, thrust rising until the pair is off the ground
    FLY = "fly"  # leader PID and follower policy
    LAND = "land"  # the same laws toward a goal that sinks
    DESCEND = "descend"  # level, thrust held to a sinking speed where it is known, else ramped down
    HOLD = "hold"  # a drone is not heard: level, a little less than the trims, until its own watchdog must stop it
    STOP = "stop"  # stop and zero setpoints, until the firmware counts neither drone as flying
    KILL = "kill"  # emergency stop, repeated; the firmware stays locked until reboot
    DONE = "done"  # motors off, disarmed; nothing more is sent

    @property
    def severity(self) -> int:
        """Order of precedence when one tick has several events; only HOLD leads back to what it interrupted."""
        return list(State).index(self)


class Event(Enum):
    """What may happen."""

    READY = "all checks before flight passed"
    REFUSED = "a check before flight failed"
    ARMED = "both drones armed with the thrust lock open"
    CURVE_KNOWN = "the force curves of both firmwares are known"
    CURVE_UNKNOWN = "a firmware's force curve is not one that can be flown"
    HOVERING = "the pair is off the ground"
    TIME_UP = "the flight time is over"
    INTERRUPT = "Ctrl-C or SIGTERM"
    KEY_KILL = "kill key, or Ctrl-C again"
    STALE = "a drone's state is older than 100 ms by the host's or the firmware's clock"
    GAPS = "states broke off too often"
    RESUMED = "fresh states of both drones have come back"
    LINK_LOST = "a link reported its end"
    UNHEARD = "a drone does not act on what it is sent"
    FROZEN = "a drone's sensors and control stand still"
    BAD_STATE = "a state or a command is not finite"
    FENCE = "a drone left the geofence"
    TILT = "a drone tilts beyond the limit"
    STICK = "the two positions contradict the stick: its length or its tilt"
    ESTIMATOR = "an estimator's position cannot be trusted"
    FRAME = "what is measured of a drone moves otherwise than its IMU feels"
    BATTERY = "a battery is low"
    LIFT = "a battery will not carry its drone to the end of a landing"
    SATURATED = "thrust has been at its bound for too long"
    DEADLINES = "the loop missed too many deadlines"
    WATCHDOG = "the watchdog process ended"
    DRONE_DOWN = "a drone's firmware is locked, crashed, tumbled or cannot fly"
    APP_REFUSES = "an app on board does not start"
    APP_LANDS = "an app on board lands, or is not heard"
    APP_DESCENDS = "an app on board descends"
    APP_STOPS = "an app on board turns its motors off"
    POSE = "the motion capture has had no good pose of a drone for too long"
    TOUCHED_DOWN = "the pair stands on the ground"
    GROUNDED = "the firmware counts neither drone as flying"
    TIMEOUT = "the state has lasted as long as it may"


class Fault(NamedTuple):
    """An event with what is known about it."""

    event: Event
    detail: str = ""

    def __str__(self) -> str:
        return self.event.name.lower().replace("_", " ") + (f": {self.detail}" if self.detail else "")


S, E = State, Event
BEFORE_MOTORS = (S.CHECK, S.ARM)
ON_GROUND = (*BEFORE_MOTORS, S.SPIN)
GUIDED = (S.FLY, S.LAND)  # leader and follower laws are in command
AIRBORNE = (S.RAMP, S.FLY, S.LAND, S.DESCEND, S.HOLD)
ENDED = (S.STOP, S.KILL, S.DONE)


# What goes as planned; and after what the pair sinks under control.
PLANNED = frozenset({E.READY, E.ARMED, E.CURVE_KNOWN, E.HOVERING, E.TIME_UP, E.RESUMED, E.TOUCHED_DOWN, E.GROUNDED})
_CONTROLLED = (
    *(E.BAD_STATE, E.FENCE, E.LIFT, E.SATURATED, E.DEADLINES, E.STICK, E.ESTIMATOR, E.FRAME, E.APP_DESCENDS, E.POSE),
)


def _planned() -> dict[tuple[State, Event], State]:
    """A flight in which nothing is wrong, and who may end it early."""
    return {
        (S.CHECK, E.READY): S.ARM,
        (S.ARM, E.ARMED): S.SPIN,
        (S.SPIN, E.CURVE_KNOWN): S.RAMP,
        (S.RAMP, E.HOVERING): S.FLY,
        (S.FLY, E.TIME_UP): S.LAND,
        (S.FLY, E.TIMEOUT): S.LAND,
        (S.FLY, E.INTERRUPT): S.LAND,
        (S.RAMP, E.INTERRUPT): S.DESCEND,
        (S.LAND, E.TOUCHED_DOWN): S.STOP,
        (S.DESCEND, E.TOUCHED_DOWN): S.STOP,
        (S.HOLD, E.RESUMED): S.FLY,  # or what else was interrupted, see `Supervisor.after`
        (S.STOP, E.GROUNDED): S.DONE,
        (S.STOP, E.TIMEOUT): S.DONE,
        (S.KILL, E.TIMEOUT): S.DONE,
    }


def _on_the_ground() -> dict[tuple[State, Event], State]:
    """Before the pair can lift, whatever is wrong ends it."""
    harmless = PLANNED | {E.SATURATED, E.DEADLINES, E.TIMEOUT, E.INTERRUPT}
    wrong = {(state, event): S.STOP for state in ON_GROUND for event in E if event not in harmless}
    return wrong | {(state, event): S.STOP for state in ON_GROUND for event in (E.TIMEOUT, E.INTERRUPT)}


def _in_the_air() -> dict[tuple[State, Event], State]:
    """What can still be flown lands or sinks level, what cannot be heard is mirrored, what is lost is cut."""
    table = {(S.FLY, event): S.LAND for event in (E.BATTERY, E.WATCHDOG, E.GAPS)}
    table |= {(S.RAMP, event): S.DESCEND for event in (E.BATTERY, E.WATCHDOG, E.GAPS, E.TIMEOUT)}
    table[S.LAND, E.TIMEOUT] = S.DESCEND
    table |= {(S.FLY, E.APP_LANDS): S.LAND, (S.RAMP, E.APP_LANDS): S.DESCEND}
    for state in (S.RAMP, *GUIDED):
        table |= {(state, event): S.DESCEND for event in _CONTROLLED}
    for state in AIRBORNE:
        table |= {(state, event): S.STOP for event in (E.DRONE_DOWN, E.TILT, E.APP_STOPS)}
        table |= {(state, event): S.HOLD for event in (E.STALE, E.LINK_LOST, E.UNHEARD, E.FROZEN)}
    table |= {(state, E.TIMEOUT): S.STOP for state in (S.DESCEND, S.HOLD)}
    table[S.DESCEND, E.BAD_STATE] = S.STOP
    return table


def _table() -> dict[tuple[State, Event], State]:
    """Every pair that changes the state; all others keep it. A kill is possible until everything is over."""
    kill = {(state, E.KEY_KILL): S.KILL for state in S if state is not S.DONE}
    return _planned() | _on_the_ground() | _in_the_air() | kill


TRANSITIONS = {pair: state for pair, state in _table().items() if pair[0] is not state}
SHORT = (S.ARM, S.SPIN, S.RAMP)  # states whose time limit is only reached if something is wrong
# The flight's exit code is 1 after any of these, or after a state of SHORT that lasted too long.
FAULTS = frozenset(E) - PLANNED - {E.INTERRUPT, E.TIMEOUT}


@dataclass(frozen=True)
class Supervisor:
    """State and when it was entered. Immutable: `after` returns the next one."""

    state: State = State.CHECK
    since: float = 0.0  # [s]
    cause: Fault | None = None  # what began the abort
    held: tuple[State, float] | None = None  # the state that HOLD interrupted, and when that was entered [s]

    def after(self, faults: list[Fault], now: float) -> Supervisor:
        """The supervisor after everything that happened in one tick ending at `now` [s]."""
        known = [fault for fault in faults if (self.state, fault.event) in TRANSITIONS]
        led = [(TRANSITIONS[self.state, fault.event], fault) for fault in known]
        # Whoever pressed the kill key wants nothing else.
        asked = [pair for pair in led if pair[1].event is Event.KEY_KILL]
        best, why = max(asked or led, key=lambda pair: pair[0].severity, default=(self.state, None))
        if why is None:
            return self
        if why.event is Event.RESUMED:
            return self._resumed(now)
        unplanned = why.event in FAULTS or (self.state in SHORT and why.event is Event.TIMEOUT)
        first = self.cause or (why if unplanned else None)
        held = (self.state, self.since) if best is State.HOLD else None
        return Supervisor(best, now, first, held)

    @property
    def may_resume(self) -> bool:
        """True in a hold that a gap in the states or in what a drone hears began while the laws were in command."""
        guided = self.held is not None and self.held[0] in GUIDED
        return guided and self._gap

    @property
    def _gap(self) -> bool:
        return self.cause is not None and self.cause.event in (Event.STALE, Event.UNHEARD)

    def _resumed(self, now: float) -> Supervisor:
        """Back to what HOLD interrupted; a gap that closed is no cause. A ramp is not taken up again."""
        state, since = self.held or (State.DESCEND, now)
        cause = None if self._gap else self.cause
        return Supervisor(state, since, cause) if state in GUIDED else Supervisor(State.DESCEND, now, self.cause)
