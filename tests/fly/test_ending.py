"""Why a flight ended: the first cause among the signals of the last second, and how the pair came down."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fly_virtual import VirtualTwin
from tables import rows

from mjxfly.ending import Signals, Touchdown
from mjxfly.limits import FlightSettings
from mjxfly.supervisor import Event, Fault, FlightState

LINK, OLD = Fault(Event.LINK_LOST, "leader: nothing can be sent"), Fault(Event.STALE, "state of the leader is 0 ms old")
BUSY, TILT = Fault(Event.DEADLINES, "12 missed in a second"), Fault(Event.TILT, "follower tilts 41 degrees")
FULL, LOW = Fault(Event.SATURATED, "for 1 s"), Fault(Event.BATTERY, "follower at 3.10 V")

# Ticks (time, faults, gap before it), the abort, and the events that explain it, the first cause first.
CHAINS = [
    # A computer that stood still neither sends nor hears: that came first, whatever the tick found beside it.
    ([(7.57, [LINK, OLD, BUSY], 0.134)], 7.57, ["DEADLINES", "LINK_LOST", "STALE"]),
    # A late tick of long ago, or one that was over before the link fell silent, explains nothing.
    ([(6.31, [BUSY], 0.12), (7.57, [LINK], 0.01)], 7.57, ["LINK_LOST"]),
    ([(7.00, [], 0.06), (7.57, [OLD], 0.01)], 7.57, ["STALE"]),
    # One that runs into it does, although no tick was late enough for a fault.
    ([(7.50, [], 0.08), (7.57, [OLD], 0.01)], 7.57, ["DEADLINES", "STALE"]),
    # What followed is told, too; a thrust at its bound has been there for a second.
    ([(7.57, [OLD], 0.01), (7.7, [OLD, TILT], 0.01)], 7.57, ["STALE", "TILT"]),
    ([(7.0, [LOW], 0.01), (7.1, [LOW], 0.01), (7.5, [FULL], 0.01)], 7.5, ["SATURATED", "BATTERY"]),
]


@rows("ticks, at, expected", CHAINS)
def test_the_first_cause_comes_first(ticks: list, at: float, expected: list[str]) -> None:
    signals = Signals(FlightSettings())
    for now, faults, gap in ticks:
        signals.update(faults, now, gap)
    cause = next(faults for now, faults, _ in ticks if now == at)[0]
    assert [signal.event.name for signal in signals.chain(cause, at)] == expected


def test_a_fault_without_a_signal_is_its_own_cause() -> None:
    assert [one.event for one in Signals(FlightSettings()).chain(TILT, 3.0)] == [Event.TILT]


def measured(text: str) -> float:
    """The touchdown speed in a sentence [m/s]."""
    return float(text.split(": ")[1].split(" m/s", maxsplit=1)[0])


@pytest.mark.parametrize("asked", [False, True])
def test_a_good_flight_says_how_it_landed(asked: bool) -> None:
    world = VirtualTwin(FlightSettings(seconds=2.0, goal=(0.2, -0.1, 0.4)))
    world.fly_until(FlightState.FLY)
    if asked:
        world.fly_for(1.5)
        world.flight.interrupts = 1
    world.run()
    (told,) = world.flight.how_it_ended()
    assert ("as asked" in told, "as planned" in told) == (asked, not asked)
    assert measured(told) == pytest.approx(world.touchdown_speed(), abs=0.05)
    x, y = (float(part) for part in told.split("(")[1].split(")")[0].split(","))
    place = world.state.position.mean(axis=0)
    assert (x, y) == (pytest.approx(place[0], abs=0.02), pytest.approx(place[1], abs=0.02))


def test_a_busy_computer_is_no_lost_link() -> None:
    """A stall of 134 ms held the pair for 2 s, blind, and was called a lost link."""
    world = VirtualTwin(FlightSettings(seconds=9.0))
    world.fly_until(FlightState.FLY)
    world.fly_for(2.0)
    world.advance(0.134)
    world.links[0].stuck = 0.134  # nobody sent meanwhile
    world.flight.tick(world.now, 0.124, 12, 0.134)
    assert world.flight.supervisor.state is FlightState.DESCEND
    world.links[0].stuck = 0.0
    world.run()
    why, down = world.flight.how_it_ended()
    assert "too busy" in why
    assert "124 ms" in why
    assert "link lost" not in why
    assert measured(down) == pytest.approx(world.touchdown_speed(), abs=0.1)


def test_a_link_that_fails_is_no_busy_computer() -> None:
    world = VirtualTwin(FlightSettings(seconds=9.0))
    world.fly_until(FlightState.FLY)
    world.fly_for(0.7)
    world.flight.tick(world.now, 0.03, 3, 0.05)
    world.fly_for(1.26)
    world.links[0].lost = "dongle unplugged"
    world.run()
    why = world.flight.how_it_ended()[0]
    assert "dongle unplugged" in why
    assert "busy" not in why


def test_a_touchdown_that_is_not_known_is_not_told() -> None:
    """(height [m], climb [m/s], doubt) every 10 ms: speeds of estimates that are no facts were told as such."""
    up, fall = [(0.4, 0.0, "")], [(0.4 - 0.02 * n, -1.0, "") for n in range(1, 21)]
    for way, told in (
        ([*up, *fall], 1.0),
        ([(0.0, 0.0, "it stands on its head"), *up, *fall], 1.0),  # it was on the ground
        ([*up, *fall, (0.0, -3.0, "it turned over")], 1.0),  # it was down
        ([*up, (0.3, -1.0, "it turned over"), *fall], math.nan),
        ([*up, (0.3, -4.0, ""), *fall], math.nan),  # 2.8 m/s is a fall from there
    ):
        touchdown = Touchdown(0.05)
        for number, (height, climb, doubt) in enumerate(way):
            touchdown.update(np.array([0.0, 0.0, height]), climb, 0.01 * number, doubt)
        assert touchdown.speed == pytest.approx(told, nan_ok=True)
        assert ("m/s" in str(touchdown)) == math.isfinite(told)
