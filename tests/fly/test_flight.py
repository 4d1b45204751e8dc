"""A flight in virtual time: the whole chain but sockets and clocks, with every kind of fault."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from fly_virtual import ARMED_BY_HAND, VirtualTwin, thrusts
from hypothesis import given, settings
from hypothesis import strategies as st
from tables import rows

from mjxfly import packets, session
from mjxfly.limits import FlightSettings, Times
from mjxfly.setpoints import LastKnownState, Variant
from mjxfly.supervisor import AIRBORNE, Event, Fault, FlightState, Supervisor
from mjxfly.watchdog import PERIOD, descent_packets

NORMAL = ["arm", "spin", "ramp", "fly", "land", "stop", "done"]


def test_a_flight_from_start_to_end() -> None:
    world = VirtualTwin(FlightSettings(seconds=5.0, goal=(0.2, -0.1, 0.5)))
    world.fly_until(FlightState.FLY)
    world.fly_for(4.9)
    there = world.state.position.mean(axis=0)
    # The policy's metadata promises to settle within 2.8 s, but for another plant; 5 cm shows that signs are right.
    np.testing.assert_allclose(there, [0.2, -0.1, 0.5], atol=0.05)
    world.fly_until(FlightState.DONE)
    assert world.log.transitions() == NORMAL
    assert world.flight.supervisor.cause is None
    world.advance(0.05)
    assert world.running() == [False, False]
    assert world.state.position[:, 2].max() < 0.01
    # A 2.1 stays armed. The firmware is not locked: it may fly again without a reboot.
    assert [drone.firmware.locked for drone in world.drones] == [False, False]


def test_a_brushless_pair_is_armed_under_zeros() -> None:
    world = VirtualTwin(kind=ARMED_BY_HAND)
    assert not world.drones[0].firmware.supervisor.armed
    world.fly_until(FlightState.SPIN)
    assert all(drone.firmware.supervisor.armed for drone in world.drones)
    assert {thrust for _, thrust in thrusts(world, 0)[:-1]} == {0}  # the last one is the first that turns
    world.fly_until(FlightState.DONE)
    assert world.log.transitions() == NORMAL


def test_a_dry_run_sends_zeros_and_never_arms() -> None:
    world = VirtualTwin(FlightSettings(seconds=1.0, dry_run=True), ARMED_BY_HAND)
    world.fly_until(FlightState.FLY)
    assert all(value.thrust > 10000 for value in world.flight.view.wanted)  # what it would have sent
    world.fly_until(FlightState.DONE)
    for number in range(2):
        assert {thrust for _, thrust in thrusts(world, number)} == {0}
        others = {packet for _, packet in world.links[number].packets if packet.port != 3}
        assert others <= {packets.STOP}
    assert world.running() == [False, False]


def test_one_interrupt_lands_and_a_second_one_kills() -> None:
    world = VirtualTwin()
    world.fly_until(FlightState.FLY)
    world.flight.interrupts = 1
    world.fly_until(FlightState.LAND)
    world.fly_for(0.2)
    assert world.running() == [True, True]
    world.flight.interrupts = 2
    world.fly_until(FlightState.KILL)
    world.advance(0.1)  # the firmware looks every 40 ms: off at the first look, locked at the second
    assert world.running() == [False, False]
    assert all(drone.firmware.locked for drone in world.drones)


@pytest.mark.parametrize(("missed", "gap"), [(50, 0.01), (0, 0.2)])
def test_a_loop_that_cannot_keep_up_descends(missed: int, gap: float) -> None:
    world = VirtualTwin()
    world.fly_until(FlightState.FLY)
    world.flight.tick(world.now, 0.0, missed, gap)
    assert world.flight.supervisor.state is FlightState.DESCEND
    assert world.flight.supervisor.cause.event is Event.DEADLINES


def test_thrust_at_its_bound_for_too_long_descends() -> None:
    world = VirtualTwin(FlightSettings(seconds=20.0))
    heavy = [Variant(dataclasses.replace(one, carried_mass=0.0434), {}) for one in world.flight.maps]
    world.flight.spin.chosen = lambda: (heavy[0], heavy[1])
    world.fly_until(FlightState.FLY)
    world.fly_until(FlightState.DESCEND)
    assert world.flight.supervisor.cause.event in (Event.SATURATED, Event.FENCE)
    world.fly_until(FlightState.DONE)


def test_failed_checks_never_turn_a_motor() -> None:
    world = VirtualTwin()
    world.flight.ready, world.flight.refusal = False, "battery"
    world.fly_until(FlightState.DONE)
    assert world.log.transitions() == ["stop", "done"]
    assert {thrust for _, thrust in thrusts(world, 0)} == {0}
    assert world.flight.supervisor.cause.event is Event.REFUSED


def test_a_watchdog_that_dies_ends_the_flight() -> None:
    world = VirtualTwin(FlightSettings(seconds=20.0))
    alive = [True]
    beats: list[tuple[bool, LastKnownState]] = []

    class Guard:
        def beat(self, flying: bool, seen: LastKnownState) -> bool:
            beats.append((flying, seen))
            return alive[0]

    world.flight.watchdog = Guard()
    world.fly_until(FlightState.FLY)
    world.fly_for(2.0)
    flying, (trims, height, climb, _) = beats[-1]
    assert flying
    assert height == pytest.approx(world.state.position[:, 2].mean(), abs=0.05)
    assert climb == pytest.approx(world.state.velocity[:, 2].mean(), abs=0.05)
    hover = world.flight.maps[0].hover_thrust
    assert all(abs(trim - hover) < 0.1 * hover for trim in trims)
    alive[0] = False
    world.fly_until(FlightState.LAND)
    world.fly_until(FlightState.DONE)
    assert world.flight.supervisor.cause.event is Event.WATCHDOG
    assert not beats[-1][0]


def test_an_abort_during_the_ramp_does_not_jump_to_hover() -> None:
    world = VirtualTwin()
    world.fly_until(FlightState.RAMP)
    world.fly_for(0.3)
    highest = max(thrust for _, thrust in thrusts(world, 0))
    world.fault_link(1, silent_down=True)
    world.fly_until(FlightState.DONE)
    # The abort holds a running average of the ramp, and the ramp goes on for the 100 ms that it takes to see the fault.
    assert max(thrust for _, thrust in thrusts(world, 0)) < highest + 6000


def test_every_state_has_a_time_limit_in_the_air() -> None:
    world = VirtualTwin(FlightSettings(times=Times(), seconds=3.0))
    assert all(math.isfinite(world.flight._limit(state)) for state in AIRBORNE)


QUICK = Times(arm=0.1, ramp=0.5, stop=0.2)


class Guard:
    """In the place of the watchdog."""

    def __init__(self) -> None:
        self.beats: list[bool] = []
        self.left = False

    def beat(self, flying: bool, seen: LastKnownState) -> bool:
        self.beats.append(flying)
        return True

    def leave(self) -> None:
        self.left = True


def fail(world: VirtualTwin, guard: Guard) -> None:
    """Have the flight go on from where it is, to a tick that fails."""

    def tick(*_: object) -> bool:
        raise RuntimeError("a bug")

    world.flight.watchdog, world.flight.begin, world.flight.tick = guard, lambda now: None, tick


@rows("phase", [FlightState.CHECK, FlightState.ARM, FlightState.SPIN])
def test_a_bug_in_the_runner_on_the_ground_stops_both(phase: FlightState) -> None:
    world, guard = VirtualTwin(), Guard()
    world.fly_until(phase)
    fail(world, guard)
    session.run(world.flight)
    assert len(guard.beats) > 20  # the watchdog is told throughout, or it would end us and send thrust again
    assert not any(guard.beats)
    world.advance(0.05)
    assert world.running() == [False, False]
    assert world.flight.supervisor.state is FlightState.DONE
    assert world.flight.supervisor.cause is not None
    assert any("RuntimeError: a bug" in record.get("text", "") for record in world.log.records)


class Ended(BaseException):
    """The process has ended."""


def test_a_bug_in_the_runner_in_the_air_is_no_worse_than_its_death(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """It was an emergency stop: a fall from wherever the pair was, and locked drones."""

    def ended(code: int) -> None:
        raise Ended(code)

    monkeypatch.setattr(session.os, "_exit", ended)
    for phase in (FlightState.RAMP, FlightState.FLY, FlightState.LAND, FlightState.DESCEND, FlightState.HOLD):
        world, guard, saved = VirtualTwin(FlightSettings(seconds=1.2, times=QUICK)), Guard(), []
        world.fly_until(FlightState.FLY if phase in (FlightState.DESCEND, FlightState.HOLD) else phase)
        if phase in (FlightState.DESCEND, FlightState.HOLD):
            world.fly_for(1.0)
            world.flight.supervisor = Supervisor(phase, world.now, Fault(Event.STICK))
            world.flight._hold([]) if phase is FlightState.HOLD else world.tick()
        seen, before = world.flight._last_known_state(), [len(link.packets) for link in world.links]
        fail(world, guard)
        with pytest.raises(Ended) as left:
            session.run(world.flight, lambda saved=saved: saved.append(True))
        assert (left.value.args, guard.left, saved) == ((1,), True, [True])
        assert "RuntimeError: a bug" in capsys.readouterr().err
        assert [len(link.packets) for link in world.links] == before  # not a word to the drones
        for packets_of_both in zip(*(descent_packets(number, seen, 0.0) for number in range(2)), strict=True):
            for link, packet in zip(world.links, packets_of_both, strict=True):
                link.send(packet)
            world.advance(PERIOD)
            world.track.append(world.moment())
        assert world.running() == [False, False], phase
        assert not any(drone.firmware.locked for drone in world.drones)
        speed = world.touchdown_speed()
        assert not speed > 0.8, (phase, speed)

    def note(*_: object, **fields: object) -> None:
        raise OSError("no log")

    world.flight.supervisor, world.flight.watchdog, world.flight.note = Supervisor(FlightState.FLY), None, note
    with pytest.raises(Ended):  # the controllers on board: nobody else takes over, and the apps land
        session.run(world.flight)
    assert "the apps on board land both drones" in capsys.readouterr().err


def test_a_log_that_is_not_written_keeps_the_pair_on_the_ground(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(session, "check", lambda *_: [])
    nobody = SimpleNamespace(mocap=None, apps=None, rehearsal_error=lambda: None, rig=None, preflight=None)
    for failure in (None, "No space left on device"):
        journal = SimpleNamespace(failure=failure, note=lambda *_, **fields: None)
        assert session._checked([], nobody, FlightSettings(), journal) is (failure is None)
    assert "log: No space left on device" in capsys.readouterr().out


def test_asking_twice_to_land_is_no_kill_but_ctrl_c_twice_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The landing key repeats while it is held, and a closed terminal sends SIGHUP more than once."""
    for names, kills in ((("land", "land"), False), (("interrupt", "interrupt"), True), (("land", "interrupt"), True)):
        world = VirtualTwin()
        world.fly_until(FlightState.FLY)

        @contextlib.contextmanager
        def pressed(*given, names=names):
            by_name = dict(zip(("land", "interrupt", "kill"), given, strict=True))
            for name in names:
                by_name[name]()
            yield

        monkeypatch.setattr(session, "listening", pressed)
        monkeypatch.setattr(world.flight, "tick", lambda *_: False)
        session.run(world.flight)
        assert (world.flight.interrupts > 1) is kills


@pytest.mark.parametrize("state", [FlightState.ARM, FlightState.RAMP])
def test_a_state_that_takes_too_long_is_a_fault(state: FlightState) -> None:
    after = Supervisor(state, 0.0).after([Fault(Event.TIMEOUT)], 1.0)
    assert after.cause is not None
    assert Supervisor(FlightState.FLY, 0.0).after([Fault(Event.TIMEOUT)], 1.0).cause is None


def test_a_kill_in_a_dry_run_locks_no_drone() -> None:
    world = VirtualTwin(FlightSettings(dry_run=True))
    world.fly_until(FlightState.FLY)
    world.flight.kill = True
    world.fly_until(FlightState.DONE)
    assert packets.EMERGENCY_STOP not in [packet for link in world.links for _, packet in link.packets]


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(
    raw=st.lists(st.tuples(*[st.binary(min_size=packets.STATE_SIZE, max_size=packets.STATE_SIZE)] * 2), max_size=30),
    paused=st.floats(0.0, 0.3),
)
def test_whatever_the_drones_report_no_command_leaves_its_bounds(raw: list[tuple[bytes, bytes]], paused: float) -> None:
    """A hostile pair that speaks the protocol well: states of any bytes in the middle of a flight."""
    world = VirtualTwin()
    world.fly_until(FlightState.FLY)
    world.fly_for(paused)
    before = [len(link.packets) for link in world.links]
    for pair_of_states in raw:
        world.now += 0.01
        for link, data in zip(world.links, pair_of_states, strict=True):
            with contextlib.suppress(packets.PacketError):  # the link drops such a packet
                link.telemetry.take(packets.unpack_state(data), round(1000 * world.now), world.now)
        if not world.flight.tick(world.now):
            break
    for link, count in zip(world.links, before, strict=True):
        sent = [
            packet for _, packet in link.packets[count:] if packet.port == packets.setpoint_packet(packets.ZERO).port
        ]
        assert sent or not raw
        for packet in sent:
            roll, pitch, yaw_rate, thrust = packets.unpack_setpoint(packet.data)
            assert max(map(abs, (roll, pitch, yaw_rate))) <= 15
            assert thrust <= 60000
