"""The supervisor's table, exhaustively: every state with every event, and every pair of events."""

from __future__ import annotations

import itertools
from collections import deque

from tables import rows

from mjxfly.supervisor import AIRBORNE, ENDED, FAULTS, ON_GROUND, TRANSITIONS, Event, Fault, State, Supervisor

PAIRS = list(itertools.product(State, Event))


def after(state: State, *events: Event) -> State:
    return Supervisor(state).after([Fault(event) for event in events], 1.0).state


@rows("state, event", PAIRS)
def test_every_pair(state: State, event: Event) -> None:
    reached = after(state, event)
    if (state, event) == (State.HOLD, Event.RESUMED):
        return  # alone leads back, see below
    assert reached is TRANSITIONS.get((state, event), state)
    assert reached.severity >= state.severity
    if state in ENDED:
        assert reached not in AIRBORNE  # no way from stopped motors to thrust
    on_ground = {Event.REFUSED, Event.CURVE_UNKNOWN, Event.APP_REFUSES}
    if event in FAULTS - on_ground and state in (State.RAMP, State.FLY):
        assert reached not in (State.RAMP, State.FLY)  # a fault always ends the flight
    if event is Event.KEY_KILL and state is not State.DONE:
        assert reached is State.KILL
    if event in (Event.DRONE_DOWN, Event.TILT) and state in (*AIRBORNE, *ON_GROUND):
        assert reached is State.STOP  # a drone that is down must not be lifted by the other
    if event in (Event.STALE, Event.LINK_LOST, Event.UNHEARD, Event.FROZEN) and state in AIRBORNE:
        assert reached is State.HOLD


@rows("state, event", PAIRS)
def test_two_events_at_once_lead_no_less_far_than_either(state: State, event: Event) -> None:
    for other in set(Event) - {Event.RESUMED}:
        if event is Event.RESUMED:
            continue
        both, alone = after(state, event, other), (after(state, event), after(state, other))
        assert both is after(state, other, event)  # order of discovery does not matter
        if Event.KEY_KILL in (event, other) and state not in (State.KILL, State.DONE):
            assert both is State.KILL
        else:
            assert both.severity == max(one.severity for one in alone)


def test_before_the_motors_turn_only_progress_leads_to_thrust() -> None:
    ways = {(state, event) for (state, event), reached in TRANSITIONS.items() if reached in AIRBORNE}
    from_ground = {pair for pair in ways if pair[0] in ON_GROUND}
    assert from_ground == {(State.SPIN, Event.CURVE_KNOWN)}
    to_spin = {pair for pair, reached in TRANSITIONS.items() if reached is State.SPIN}
    assert to_spin == {(State.ARM, Event.ARMED)}


def test_timeouts_alone_end_every_flight() -> None:
    for state in AIRBORNE:
        for _ in State:
            state = after(state, Event.TIMEOUT)  # noqa: PLW2901
        assert state is State.DONE


def test_every_state_can_be_reached_and_left() -> None:
    reached, waiting = {State.CHECK}, deque([State.CHECK])
    while waiting:
        state = waiting.popleft()
        for event in Event:
            new = after(state, event)
            if new not in reached:
                reached.add(new)
                waiting.append(new)
    assert reached == set(State)
    for state in set(State) - {State.DONE}:
        assert any(after(state, event) is not state for event in Event)
    assert all(after(State.DONE, event) is State.DONE for event in Event)


def test_the_cause_is_the_first_fault() -> None:
    flying = Supervisor(State.FLY)
    landing = flying.after([Fault(Event.TIME_UP)], 1.0)
    assert landing.cause is None
    lost = landing.after([Fault(Event.STALE, "leader")], 2.0)
    assert lost.cause == Fault(Event.STALE, "leader")
    assert lost.after([Fault(Event.TILT)], 3.0).cause == lost.cause
    assert lost.since == 2.0


def test_a_gap_that_closes_leads_back_to_what_it_interrupted() -> None:
    """The flight's time goes on from where it began; a gap is no cause, whatever else began the abort is."""
    flying = Supervisor(State.FLY, 3.0)
    held = flying.after([Fault(Event.STALE, "leader")], 5.0)
    assert (held.state, held.cause) == (State.HOLD, Fault(Event.STALE, "leader"))
    assert held.after([Fault(Event.RESUMED)], 5.2) == flying
    landing = Supervisor(State.LAND, 3.0, Fault(Event.BATTERY))
    assert landing.after([Fault(Event.STALE)], 5.0).after([Fault(Event.RESUMED)], 5.2) == landing
    ramp = Supervisor(State.RAMP, 1.0).after([Fault(Event.STALE)], 2.0).after([Fault(Event.RESUMED)], 2.2)
    assert (ramp.state, ramp.cause) == (State.DESCEND, Fault(Event.STALE))
    assert held.after([Fault(Event.RESUMED), Fault(Event.TILT)], 5.2).state is State.STOP


def test_nothing_happens_without_an_event() -> None:
    for state in State:
        supervisor = Supervisor(state, 5.0)
        assert supervisor.after([], 9.0) is supervisor


def test_only_a_gap_that_broke_into_flight_may_close() -> None:
    began = (
        (State.RAMP, State.FLY, State.LAND, State.DESCEND),
        (Event.STALE, Event.UNHEARD, Event.LINK_LOST, Event.FROZEN),
    )
    for state, event in itertools.product(*began):
        held = Supervisor(state).after([Fault(event)], 1.0)
        guided, gap = state in (State.FLY, State.LAND), event in (Event.STALE, Event.UNHEARD)
        assert held.may_resume is (guided and gap), (state, event)
    assert not Supervisor(State.FLY, cause=Fault(Event.STALE)).may_resume


def test_time_is_a_fault_only_where_something_else_should_have_ended_the_state() -> None:
    for state in State:
        for event in (Event.TIMEOUT, Event.INTERRUPT):
            cause = Supervisor(state).after([Fault(event)], 1.0).cause
            fault = event is Event.TIMEOUT and state in (State.ARM, State.SPIN, State.RAMP)
            assert cause == (Fault(event) if fault else None), (state, event)


def test_a_fault_is_told_with_what_is_known_of_it() -> None:
    assert [str(Fault(Event.LINK_LOST)), str(Fault(Event.STALE, "leader"))] == ["link lost", "stale: leader"]
