"""The supervisor's table, exhaustively: every state with every event, and every pair of events."""

from __future__ import annotations

import itertools
from collections import deque

import pytest

from mjxball.fly.supervisor import (
    AIRBORNE,
    BEFORE_MOTORS,
    ENDED,
    FAULTS,
    TRANSITIONS,
    Event,
    Fault,
    State,
    Supervisor,
    table_rows,
)

PAIRS = list(itertools.product(State, Event))


def after(state: State, *events: Event) -> State:
    return Supervisor(state).after([Fault(event) for event in events], 1.0).state


@pytest.mark.parametrize(("state", "event"), PAIRS, ids=lambda value: value.name)
def test_every_pair(state: State, event: Event) -> None:
    reached = after(state, event)
    assert reached is TRANSITIONS.get((state, event), state)
    assert reached.severity >= state.severity  # nothing ever goes back
    if state in ENDED:
        assert reached not in AIRBORNE  # no way from stopped motors to thrust
    if event in FAULTS - {Event.REFUSED} and state in (State.RAMP, State.FLY):  # REFUSED belongs to the ground
        assert reached not in (State.RAMP, State.FLY)  # a fault always ends the flight
    if event is Event.KEY_KILL and state is not State.DONE:
        assert reached is State.KILL
    if event in (Event.DRONE_DOWN, Event.TILT, Event.STICK) and state in (*AIRBORNE, *BEFORE_MOTORS):
        assert reached is State.STOP  # a drone that is down must not be lifted by the other
    if event in (Event.STALE, Event.LINK_LOST) and state in AIRBORNE:
        assert reached is State.HOLD


@pytest.mark.parametrize(("state", "event"), PAIRS, ids=lambda value: value.name)
def test_two_events_at_once_lead_no_less_far_than_either(state: State, event: Event) -> None:
    for other in Event:
        both, alone = after(state, event, other), (after(state, event), after(state, other))
        assert both is after(state, other, event)  # order of discovery does not matter
        if Event.KEY_KILL in (event, other) and state not in (State.KILL, State.DONE):
            assert both is State.KILL
        else:
            assert both.severity == max(one.severity for one in alone)


def test_before_the_motors_turn_only_progress_leads_to_thrust() -> None:
    ways = {(state, event) for (state, event), reached in TRANSITIONS.items() if reached in AIRBORNE}
    from_ground = {pair for pair in ways if pair[0] in BEFORE_MOTORS}
    assert from_ground == {(State.ARM, Event.ARMED)}


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


def test_nothing_happens_without_an_event() -> None:
    for state in State:
        supervisor = Supervisor(state, 5.0)
        assert supervisor.after([], 9.0) is supervisor


def test_table_rows_are_the_table() -> None:
    rows = table_rows()
    assert len(rows) == len(set(rows)) == len(TRANSITIONS)
    assert ("fly", Event.STALE.value, "hold") in rows
