"""The safety supervisor: a pure state machine. `TRANSITIONS` defines it; docs/flying.md shows it as a table.

A state determines what is sent to both drones. A fault of one drone always brings both down together.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple


class FlightState(Enum):
    """State of the flight, by what is sent to both drones."""

    CHECK = "check"  # zeros, during the preflight checks
    ARM = "arm"  # zeros, which open the firmware's thrust lock while it arms
    SPIN = "spin"  # level, a third of hover thrust: the motors' PWM shows the firmware's force curve
    RAMP = "ramp"  # level, thrust rising until the pair is off the ground
    FLY = "fly"  # leader PID and follower policy
    LAND = "land"  # the same controllers with a goal that sinks
    DESCEND = "descend"  # level, thrust controls the sink rate if it is known, else follows a plan
    HOLD = "hold"  # a drone is not heard: level, a little below hover thrust, until its firmware stops it
    STOP = "stop"  # stop and zero setpoints, until the firmware counts neither drone as flying
    KILL = "kill"  # emergency stop, repeated; the firmware stays locked until reboot
    DONE = "done"  # motors off, disarmed; nothing more is sent

    @property
    def severity(self) -> int:
        """Precedence if one tick has several events. Only HOLD can lead back, to the state that it interrupted."""
        return list(FlightState).index(self)


class Event(Enum):
    """Input of the state machine; values are descriptions."""

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
    FRAME = "a drone's measured motion contradicts its IMU"
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
    """An event with details."""

    event: Event
    detail: str = ""

    def __str__(self) -> str:
        return self.event.name.lower().replace("_", " ") + (f": {self.detail}" if self.detail else "")


S, E = FlightState, Event
BEFORE_MOTORS = (S.CHECK, S.ARM)
ON_GROUND = (*BEFORE_MOTORS, S.SPIN)
GUIDED = (S.FLY, S.LAND)  # leader and follower controllers are in command
AIRBORNE = (S.RAMP, S.FLY, S.LAND, S.DESCEND, S.HOLD)
ENDED = (S.STOP, S.KILL, S.DONE)


# Events of a normal flight; and faults after which the pair descends under control.
PLANNED = frozenset({E.READY, E.ARMED, E.CURVE_KNOWN, E.HOVERING, E.TIME_UP, E.RESUMED, E.TOUCHED_DOWN, E.GROUNDED})
_CONTROLLED = (
    *(E.BAD_STATE, E.FENCE, E.LIFT, E.SATURATED, E.DEADLINES, E.STICK, E.ESTIMATOR, E.FRAME, E.APP_DESCENDS, E.POSE),
)


def _planned() -> dict[tuple[FlightState, Event], FlightState]:
    """Transitions of a normal flight, with those on request."""
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
        (S.HOLD, E.RESUMED): S.FLY,  # or another state that was interrupted, see `Supervisor._resumed`
        (S.STOP, E.GROUNDED): S.DONE,
        (S.STOP, E.TIMEOUT): S.DONE,
        (S.KILL, E.TIMEOUT): S.DONE,
    }


def _on_the_ground() -> dict[tuple[FlightState, Event], FlightState]:
    """Before the pair can lift, any fault stops the motors."""
    harmless = PLANNED | {E.SATURATED, E.DEADLINES, E.TIMEOUT, E.INTERRUPT}
    wrong = {(state, event): S.STOP for state in ON_GROUND for event in E if event not in harmless}
    return wrong | {(state, event): S.STOP for state in ON_GROUND for event in (E.TIMEOUT, E.INTERRUPT)}


def _in_the_air() -> dict[tuple[FlightState, Event], FlightState]:
    """In the air: land or descend under control, hold if a drone is not heard, stop if one cannot be controlled."""
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


def _table() -> dict[tuple[FlightState, Event], FlightState]:
    """All transitions; other pairs keep the state. The kill key works in every state but DONE."""
    kill = {(state, E.KEY_KILL): S.KILL for state in S if state is not S.DONE}
    return _planned() | _on_the_ground() | _in_the_air() | kill


TRANSITIONS = {pair: state for pair, state in _table().items() if pair[0] is not state}
SHORT = (S.ARM, S.SPIN, S.RAMP)  # states whose timeout is a fault
# The flight's exit code is 1 after any of these, or after a state of SHORT that lasted too long.
FAULTS = frozenset(E) - PLANNED - {E.INTERRUPT, E.TIMEOUT}


@dataclass(frozen=True)
class Supervisor:
    """State machine: state, time of entry, cause of an abort. Immutable: `after` returns the next one."""

    state: FlightState = FlightState.CHECK
    since: float = 0.0  # [s]
    cause: Fault | None = None  # first fault of an abort
    held: tuple[FlightState, float] | None = None  # state that HOLD interrupted, and its time of entry [s]

    def after(self, faults: list[Fault], now: float) -> Supervisor:
        """The supervisor after the `faults` of one tick at `now` [s]."""
        known = [fault for fault in faults if (self.state, fault.event) in TRANSITIONS]
        led = [(TRANSITIONS[self.state, fault.event], fault) for fault in known]
        # The kill key overrides all other events.
        asked = [pair for pair in led if pair[1].event is Event.KEY_KILL]
        best, why = max(asked or led, key=lambda pair: pair[0].severity, default=(self.state, None))
        if why is None:
            return self
        if why.event is Event.RESUMED:
            return self._resumed(now)
        unplanned = why.event in FAULTS or (self.state in SHORT and why.event is Event.TIMEOUT)
        first = self.cause or (why if unplanned else None)
        held = (self.state, self.since) if best is FlightState.HOLD else None
        return Supervisor(best, now, first, held)

    @property
    def may_resume(self) -> bool:
        """True in HOLD if it began with a gap in states or uplink while the controllers were in command."""
        guided = self.held is not None and self.held[0] in GUIDED
        return guided and self._gap

    @property
    def _gap(self) -> bool:
        return self.cause is not None and self.cause.event in (Event.STALE, Event.UNHEARD)

    def _resumed(self, now: float) -> Supervisor:
        """Back to the state that HOLD interrupted, with no cause if it was a gap; to DESCEND if it was the ramp."""
        state, since = self.held or (FlightState.DESCEND, now)
        cause = None if self._gap else self.cause
        return Supervisor(state, since, cause) if state in GUIDED else Supervisor(FlightState.DESCEND, now, self.cause)
