"""The supervisor's table, exhaustively: every state with every event, and every pair of events."""

from __future__ import annotations

import itertools
from collections import deque

from tables import rows

from mjxfly.supervisor import AIRBORNE, ENDED, FAULTS, ON_GROUND, TRANSITIONS, Event, Fault, FlightState, Supervisor

PAIRS = list(itertools.product(FlightState, Event))


def after(state: FlightState, *events: Event) -> FlightState:
    return Supervisor(state).after([Fault(event) for event in events], 1.0).state


@rows("state, event", PAIRS)
def test_every_pair(state: FlightState, event: Event) -> None:
    reached = after(state, event)
    if (state, event) == (FlightState.HOLD, Event.RESUMED):
        return  # alone leads back, see below
    assert reached is TRANSITIONS.get((state, event), state)
    assert reached.severity >= state.severity
    if state in ENDED:
        assert reached not in AIRBORNE  # no way from stopped motors to thrust
    on_ground = {Event.REFUSED, Event.CURVE_UNKNOWN, Event.APP_REFUSES}
    if event in FAULTS - on_ground and state in (FlightState.RAMP, FlightState.FLY):
        assert reached not in (FlightState.RAMP, FlightState.FLY)  # a fault always ends the flight
    if event is Event.KEY_KILL and state is not FlightState.DONE:
        assert reached is FlightState.KILL
    if event in (Event.DRONE_DOWN, Event.TILT) and state in (*AIRBORNE, *ON_GROUND):
        assert reached is FlightState.STOP  # a drone that is down must not be lifted by the other
    if event in (Event.STALE, Event.LINK_LOST, Event.UNHEARD, Event.FROZEN) and state in AIRBORNE:
        assert reached is FlightState.HOLD


@rows("state, event", PAIRS)
def test_two_events_at_once_lead_no_less_far_than_either(state: FlightState, event: Event) -> None:
    for other in set(Event) - {Event.RESUMED}:
        if event is Event.RESUMED:
            continue
        both, alone = after(state, event, other), (after(state, event), after(state, other))
        assert both is after(state, other, event)  # order of discovery does not matter
        if Event.KEY_KILL in (event, other) and state not in (FlightState.KILL, FlightState.DONE):
            assert both is FlightState.KILL
        else:
            assert both.severity == max(one.severity for one in alone)


def test_before_the_motors_turn_only_progress_leads_to_thrust() -> None:
    ways = {(state, event) for (state, event), reached in TRANSITIONS.items() if reached in AIRBORNE}
    from_ground = {pair for pair in ways if pair[0] in ON_GROUND}
    assert from_ground == {(FlightState.SPIN, Event.CURVE_KNOWN)}
    to_spin = {pair for pair, reached in TRANSITIONS.items() if reached is FlightState.SPIN}
    assert to_spin == {(FlightState.ARM, Event.ARMED)}


def test_timeouts_alone_end_every_flight() -> None:
    for state in AIRBORNE:
        for _ in FlightState:
            state = after(state, Event.TIMEOUT)  # noqa: PLW2901
        assert state is FlightState.DONE


def test_every_state_can_be_reached_and_left() -> None:
    reached, waiting = {FlightState.CHECK}, deque([FlightState.CHECK])
    while waiting:
        state = waiting.popleft()
        for event in Event:
            new = after(state, event)
            if new not in reached:
                reached.add(new)
                waiting.append(new)
    assert reached == set(FlightState)
    for state in set(FlightState) - {FlightState.DONE}:
        assert any(after(state, event) is not state for event in Event)
    assert all(after(FlightState.DONE, event) is FlightState.DONE for event in Event)


def test_the_cause_is_the_first_fault() -> None:
    flying = Supervisor(FlightState.FLY)
    landing = flying.after([Fault(Event.TIME_UP)], 1.0)
    assert landing.cause is None
    lost = landing.after([Fault(Event.STALE, "leader")], 2.0)
    assert lost.cause == Fault(Event.STALE, "leader")
    assert lost.after([Fault(Event.TILT)], 3.0).cause == lost.cause
    assert lost.since == 2.0


def test_a_gap_that_closes_leads_back_to_what_it_interrupted() -> None:
    """The flight's time goes on from where it began; a gap is no cause, whatever else began the abort is."""
    flying = Supervisor(FlightState.FLY, 3.0)
    held = flying.after([Fault(Event.STALE, "leader")], 5.0)
    assert (held.state, held.cause) == (FlightState.HOLD, Fault(Event.STALE, "leader"))
    assert held.after([Fault(Event.RESUMED)], 5.2) == flying
    landing = Supervisor(FlightState.LAND, 3.0, Fault(Event.BATTERY))
    assert landing.after([Fault(Event.STALE)], 5.0).after([Fault(Event.RESUMED)], 5.2) == landing
    ramp = Supervisor(FlightState.RAMP, 1.0).after([Fault(Event.STALE)], 2.0).after([Fault(Event.RESUMED)], 2.2)
    assert (ramp.state, ramp.cause) == (FlightState.DESCEND, Fault(Event.STALE))
    assert held.after([Fault(Event.RESUMED), Fault(Event.TILT)], 5.2).state is FlightState.STOP


def test_nothing_happens_without_an_event() -> None:
    for state in FlightState:
        supervisor = Supervisor(state, 5.0)
        assert supervisor.after([], 9.0) is supervisor


def test_only_a_gap_that_broke_into_flight_may_close() -> None:
    began = (
        (FlightState.RAMP, FlightState.FLY, FlightState.LAND, FlightState.DESCEND),
        (Event.STALE, Event.UNHEARD, Event.LINK_LOST, Event.FROZEN),
    )
    for state, event in itertools.product(*began):
        held = Supervisor(state).after([Fault(event)], 1.0)
        guided, gap = state in (FlightState.FLY, FlightState.LAND), event in (Event.STALE, Event.UNHEARD)
        assert held.may_resume is (guided and gap), (state, event)
    assert not Supervisor(FlightState.FLY, cause=Fault(Event.STALE)).may_resume


def test_time_is_a_fault_only_where_something_else_should_have_ended_the_state() -> None:
    for state in FlightState:
        for event in (Event.TIMEOUT, Event.INTERRUPT):
            cause = Supervisor(state).after([Fault(event)], 1.0).cause
            fault = event is Event.TIMEOUT and state in (FlightState.ARM, FlightState.SPIN, FlightState.RAMP)
            assert cause == (Fault(event) if fault else None), (state, event)


def test_a_fault_is_told_with_what_is_known_of_it() -> None:
    assert [str(Fault(Event.LINK_LOST)), str(Fault(Event.STALE, "leader"))] == ["link lost", "stale: leader"]
