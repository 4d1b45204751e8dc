"""A flight in virtual time: the whole chain but sockets and clocks, with every kind of fault."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from fly_virtual import World, thrusts

from mjxball.fly import packets, sortie
from mjxball.fly.contract import FlightSettings
from mjxball.fly.maneuver import Glimpse, Times
from mjxball.fly.supervisor import AIRBORNE, Event, State
from mjxball.fly.twin.firmware import FirmwareTimes

NORMAL = ["arm", "ramp", "fly", "land", "stop", "done"]


def test_a_flight_from_start_to_end() -> None:
    world = World(FlightSettings(seconds=5.0, goal=(0.2, -0.1, 0.5)))
    world.fly_until(State.FLY)
    world.fly_for(4.9)
    there = world.state.position.mean(axis=0)
    # The policy's card promises to settle within 2.8 s, but for another plant; 5 cm shows that signs are right.
    np.testing.assert_allclose(there, [0.2, -0.1, 0.5], atol=0.05)
    world.fly_until(State.DONE)
    assert world.notes.transitions() == NORMAL
    assert world.flight.supervisor.cause is None
    world.advance(0.05)
    assert world.running() == [False, False]
    assert world.state.position[:, 2].max() < 0.01
    assert [drone.firmware.armed for drone in world.drones] == [False, False]
    # The firmware is not locked: it may fly again without a reboot.
    assert [drone.firmware.locked for drone in world.drones] == [False, False]


def test_a_brushless_pair_is_armed_under_zeros() -> None:
    world = World(times=FirmwareTimes(auto_arm=False))
    assert not world.drones[0].firmware.armed
    world.fly_until(State.RAMP)
    assert all(drone.firmware.armed for drone in world.drones)
    assert {thrust for _, thrust in thrusts(world, 0)[:-1]} == {0}  # the last one is the ramp's first
    world.fly_until(State.DONE)
    assert world.notes.transitions() == NORMAL


def test_a_dry_run_sends_zeros_and_never_arms() -> None:
    world = World(FlightSettings(seconds=1.0, dry_run=True), FirmwareTimes(auto_arm=False))
    world.fly_until(State.FLY)
    assert all(value.thrust > 10000 for value in world.flight.view.wanted)  # what it would have sent
    world.fly_until(State.DONE)
    for number in range(2):
        assert {thrust for _, thrust in thrusts(world, number)} == {0}
        others = {packet for _, packet in world.links[number].packets if packet.port != 3}
        assert others <= {packets.STOP}
    assert world.running() == [False, False]


def test_one_interrupt_lands_and_a_second_one_kills() -> None:
    world = World()
    world.fly_until(State.FLY)
    world.flight.interrupts = 1
    world.fly_until(State.LAND)
    world.fly_for(0.2)
    assert world.running() == [True, True]
    world.flight.interrupts = 2
    world.fly_until(State.KILL)
    world.advance(0.05)
    assert world.running() == [False, False]
    assert all(drone.firmware.locked for drone in world.drones)


@pytest.mark.parametrize(("missed", "gap"), [(50, 0.01), (0, 0.2)])
def test_a_loop_that_cannot_keep_up_descends(missed: int, gap: float) -> None:
    world = World()
    world.fly_until(State.FLY)
    world.flight.tick(world.now, 0.0, missed, gap)
    assert world.flight.supervisor.state is State.DESCEND
    assert world.flight.supervisor.cause.event is Event.DEADLINES


def test_thrust_at_its_bound_for_too_long_descends() -> None:
    world = World(FlightSettings(seconds=20.0))
    world.flight.maps = tuple(dataclasses.replace(one, carried_mass=0.06) for one in world.flight.maps)
    world.fly_until(State.FLY)
    world.fly_until(State.DESCEND)
    assert world.flight.supervisor.cause.event in (Event.SATURATED, Event.FENCE)
    world.fly_until(State.DONE)


def test_failed_checks_never_turn_a_motor() -> None:
    world = World()
    world.flight.ready, world.flight.refusal = False, "battery"
    world.fly_until(State.DONE)
    assert world.notes.transitions() == ["stop", "done"]
    assert {thrust for _, thrust in thrusts(world, 0)} == {0}
    assert world.flight.supervisor.cause.event is Event.REFUSED


def test_a_watchdog_that_dies_ends_the_flight() -> None:
    world = World(FlightSettings(seconds=20.0))
    alive = [True]
    beats: list[tuple[bool, Glimpse]] = []

    class Guard:
        def beat(self, flying: bool, seen: Glimpse) -> bool:
            beats.append((flying, seen))
            return alive[0]

    world.flight.guard = Guard()
    world.fly_until(State.FLY)
    world.fly_for(2.0)
    flying, (trims, height, climb, _) = beats[-1]
    assert flying
    assert height == pytest.approx(world.state.position[:, 2].mean(), abs=0.05)
    assert climb == pytest.approx(world.state.velocity[:, 2].mean(), abs=0.05)
    hover = world.flight.maps[0].hover_thrust
    assert all(abs(trim - hover) < 0.1 * hover for trim in trims)
    alive[0] = False
    world.fly_until(State.LAND)
    world.fly_until(State.DONE)
    assert world.flight.supervisor.cause.event is Event.WATCHDOG
    assert not beats[-1][0]


def test_an_abort_during_the_ramp_does_not_jump_to_hover() -> None:
    world = World()
    world.fly_until(State.RAMP)
    world.fly_for(0.3)
    highest = max(thrust for _, thrust in thrusts(world, 0))
    world.disturb(1, silent_down=True)
    world.fly_until(State.DONE)
    # The abort holds a running average of the ramp, and the ramp goes on for the 100 ms that it takes to see the fault.
    assert max(thrust for _, thrust in thrusts(world, 0)) < highest + 6000


def test_every_state_has_a_time_limit_in_the_air() -> None:
    world = World(FlightSettings(times=Times(), seconds=3.0))
    assert all(math.isfinite(world.flight._limit(state)) for state in AIRBORNE)


def test_a_bug_in_the_runner_stops_both(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    world.fly_until(State.FLY)
    assert world.running() == [True, True]

    def broken(*_: object) -> bool:
        raise RuntimeError("a bug")

    monkeypatch.setattr(world.flight, "tick", broken)
    sortie.run(world.flight)
    world.advance(0.05)
    assert world.running() == [False, False]
    assert world.flight.supervisor.state is State.DONE
    assert world.flight.supervisor.cause is not None
    assert any("RuntimeError: a bug" in record.get("text", "") for record in world.notes.records)
