"""One drone over the real cflib: deadlines, parameters, ages, and links that die in every way."""

from __future__ import annotations

import dataclasses
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mjxball.errors import InputError
from mjxfly import packets
from mjxfly.connection import REACH, Deadlines, LinkError
from mjxfly.link import Link
from mjxfly.packets import Setpoint
from mjxfly.preflight import Preflight, reset_estimator
from mjxfly.telemetry import WRAP, FirmwareClock
from mjxfly.twin.conditions import DroneFaults, Injection, LinkFaults
from mjxfly.twin.physics import SimplePair
from mjxfly.twin.server import HOST, Twin

pytest.importorskip("cflib")
pytestmark = pytest.mark.clock  # by the clock
SHORT = Deadlines(connect=1.5, silence=1.0, attempts=2, parameter=0.5, first_state=0.7, close=1.0)


def wait_for(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


def nothing(kind: str, **fields: Any) -> None:
    """In the place of the flight log."""


@pytest.fixture
def twin() -> Iterator[Twin]:
    with Twin(SimplePair()) as running:
        yield running
    assert running.failure is None


@pytest.fixture
def links() -> Iterator[Callable[..., Link]]:
    made: list[Link] = []

    def make(uri: str, deadlines: Deadlines = SHORT) -> Link:
        made.append(Link(uri, "leader", nothing, deadlines))
        return made[-1]

    yield make
    for link in made:
        link.close()


@pytest.fixture
def link(twin: Twin, links: Callable[..., Link]) -> Link:
    """An open link that sends states."""
    opened = links(twin.uris[0], dataclasses.replace(SHORT, connect=10.0, first_state=5.0, parameter=3.0))
    opened.open()
    opened.start_states()
    return opened


def test_log_variables_are_read_once(link: Link) -> None:
    """Those that are not listed are left out, and the block that read them is gone: 16 blocks are all there are."""
    for _ in range(20):
        found = link.read_logs(["kalman.varPX", "pm.vbat", "lighthouse.status"])
        assert found.keys() == {"kalman.varPX", "pm.vbat"}
        assert 3.0 < found["pm.vbat"] < 4.3
    assert link.read_logs(["lighthouse.status"]) == {}


def test_log_requests_that_a_firmware_drops_are_repeated(
    monkeypatch: pytest.MonkeyPatch, links: Callable[..., Link]
) -> None:
    """Real firmware under load: 3 of 9 flights ended with "sends no state", since one request had been dropped.

    A request to make, extend or start a block is lost once; one of each twice; all of them, for good.
    """
    for commands, times in (({6}, 1), ({7}, 1), ({3}, 1), ({3, 6}, 2), ({3, 6}, 10**6)):
        with Twin(SimplePair()) as twin:
            receive, left = twin.drones[0].receive, [times]

            def lossy(datagram: bytes, now: float, receive=receive, left=left, commands=commands) -> None:  # type: ignore[no-untyped-def]
                if datagram[0] & 0xF3 == 0x51 and datagram[1] in commands and left[0]:
                    left[0] -= 1
                else:
                    receive(datagram, now)

            monkeypatch.setattr(twin.drones[0], "receive", lossy)
            link = links(twin.uris[0], dataclasses.replace(SHORT, connect=10.0, first_state=2.0, parameter=3.0))
            link.open()
            if times > 10:
                with pytest.raises(LinkError, match=r"does not send stateEstimateZ\.x"):
                    link.start_states()
            else:
                link.start_states()
                assert link.read_logs(["pm.vbat"]).keys() == {"pm.vbat"}


def test_states_arrive_and_are_young(link: Link) -> None:
    before = link.telemetry.received
    assert wait_for(lambda: link.telemetry.received >= before + 50)
    assert link.telemetry.age(time.monotonic()) < 0.1
    assert link.telemetry.newest is not None
    assert link.telemetry.newest.state.position[1] == pytest.approx(-0.15, abs=1e-3)
    assert link.identity.protocol == 12
    assert link.telemetry.health is not None


def test_only_the_newest_setpoint_counts_and_commands_go_first(twin: Twin, link: Link) -> None:
    link.send(packets.setpoint_packet(packets.ZERO))
    assert wait_for(lambda: link.stuck_for(time.monotonic()) == 0)
    before = link.sent
    for thrust in range(11000, 11100):
        link.send(packets.setpoint_packet(Setpoint(0, 0, 0, thrust)))
    assert wait_for(lambda: twin.truth.last_wire_thrust[0] == 11099)
    assert link.sent - before + link.overwritten == 100
    link.command(packets.EMERGENCY_STOP)
    assert wait_for(lambda: bool(twin.truth.info[0] & packets.LOCKED))


def test_parameters_are_written_and_read_back(twin: Twin, link: Link) -> None:
    link.write_parameters({"pid_rate.pitch_kd": 3.25})
    link.write_parameters({"kalman.resetEstimation": 1.0}, check=False)  # clears itself: 0 is read back
    assert twin.drones[0].peer.values["pid_rate.pitch_kd"] == 3.25


def test_an_estimator_is_reset_by_a_request_that_clears_itself(twin: Twin, link: Link) -> None:
    """Defect 1: the request was read back, found to be 0 again, and no flight began."""
    reset_estimator(link, Preflight(reset=0.0))
    assert twin.drones[0].peer.values["kalman.resetEstimation"] == 0


def test_tables_are_listed_once_for_a_firmware(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: Callable[..., Link]
) -> None:
    """Defect 9: every connection read 595 table entries and 240 values, 11.6 s at 10 ms, and failed at 20 ms."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with Twin(SimplePair()) as twin:
        requests: list[int] = []
        receive = twin.drones[0].receive
        monkeypatch.setattr(
            twin.drones[0], "receive", lambda datagram, now: (requests.append(datagram[0]), receive(datagram, now))
        )
        patient = dataclasses.replace(SHORT, connect=30.0, parameter=3.0)
        before = links(twin.uris[0], patient)
        before.open()
        before.close()
        first = len(requests)
        links(twin.uris[0], patient).open()
        assert first > 600
        assert len(requests) - first < 250  # checksums, versions, identity, and pings at 100 Hz while they are awaited


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("pid_rate.no_such", 1.0, "pid_rate.no_such"),
        ("firmware.revision0", 1.0, "firmware.revision0"),
        ("commander.enHighLevel", 300.0, "commander.enHighLevel"),
    ],
)
def test_parameters_that_cannot_be_written_are_named(link: Link, name: str, value: float, reason: str) -> None:
    with pytest.raises(LinkError, match=reason):
        link.write_parameters({name: value})


def test_a_parameter_that_does_not_stick_is_found(link: Link) -> None:
    """The firmware of no app keeps its controller if it is asked for that of an app."""
    with pytest.raises(LinkError, match=r"stabilizer\.controller of the leader reads 1 after 6 was written"):
        link.write_parameters({"stabilizer.controller": 6.0})


def test_a_parameter_that_is_never_confirmed_has_a_deadline(twin: Twin, link: Link) -> None:
    twin.drones[0].link = LinkFaults(silent_down=True)
    with pytest.raises(LinkError, match="did not confirm"):
        link.write_parameters({"pid_rate.roll_kp": 100.0})


def test_a_library_that_hangs_in_a_request_has_a_deadline(link: Link, monkeypatch: pytest.MonkeyPatch) -> None:
    """As cflib's sends do, which share a lock with a ping that a dead link never answers."""
    link._deadlines = dataclasses.replace(link._deadlines, request=0.2)
    monkeypatch.setattr(link._crazyflie.log, "add_config", lambda *_: threading.Event().wait())
    began = time.monotonic()
    with pytest.raises(LinkError, match="takes no packet"):
        link.start_states()
    assert time.monotonic() - began < 2


def test_nobody_there() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind((HOST, 0))
        port = free.getsockname()[1]
    link = Link(f"udp://{HOST}:{port}", "leader", nothing, SHORT)
    with pytest.raises(InputError, match="cannot be reached"):
        link.open()


def test_a_dongle_that_is_not_there_is_not_the_drones_fault() -> None:
    link = Link("radio://ABCDEF0123/80/2M/E7E7E7E7E7", "leader", nothing, SHORT)
    with pytest.raises(InputError, match="plug a Crazyradio in") as error:
        link.open()
    assert REACH not in str(error.value)


def test_somebody_who_never_answers() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind((HOST, 0))
        link = Link(f"udp://{HOST}:{mute.getsockname()[1]}", "leader", nothing, SHORT)
        started = time.monotonic()
        with pytest.raises(InputError, match="no answer within"):
            link.open()
        assert time.monotonic() - started < 10  # connect 1.5 and close 1.0, with slack for a busy machine


def test_lost_parameter_packets_are_repeated(twin: Twin, link: Link) -> None:
    twin.drones[0].link = LinkFaults(loss=0.3)
    values = {f"pid_rate.{axis}_kp": 7.0 + place for place, axis in enumerate(("roll", "pitch", "yaw"))}
    link.write_parameters(values)
    assert {name: twin.drones[0].peer.values[name] for name in values} == values


def test_a_reply_that_is_lost_while_connecting_has_a_deadline(twin: Twin, links: Callable[..., Link]) -> None:
    twin.drones[0].link = LinkFaults(loss=0.3)  # of two hundred exchanges: one is lost for certain
    with pytest.raises(LinkError, match="cannot be reached"):
        links(twin.uris[0]).open()


def test_silence_makes_the_state_old(twin: Twin, link: Link) -> None:
    twin.drones[0].link = LinkFaults(silent_down=True)
    assert wait_for(lambda: link.telemetry.age(time.monotonic()) > 0.2)
    assert link.lost is None  # a silent peer gives no error at all: only the age tells
    twin.drones[0].link = LinkFaults()
    assert wait_for(lambda: link.telemetry.age(time.monotonic()) < 0.1)


def test_delay_shows_in_the_firmwares_clock(twin: Twin, link: Link) -> None:
    twin.drones[0].link = LinkFaults(delay=0.3)
    assert wait_for(lambda: link.telemetry.age(time.monotonic()) < 0.1)
    time.sleep(0.5)
    newest = link.telemetry.newest
    assert newest is not None
    now = time.monotonic()
    assert now - newest.arrival < 0.25  # packets keep coming
    assert link.telemetry.age(now) > 0.25  # and are old


def test_a_log_block_that_answers_late_is_not_made_anew(twin: Twin, links: Callable[..., Link]) -> None:
    """50 ms each way: it was deleted while its first packet was on its way, and the flight was refused."""
    for delay in (0.05, 0.15):
        twin.drones[0].link = LinkFaults()
        link = links(twin.uris[0], dataclasses.replace(SHORT, connect=10.0, first_state=5.0, parameter=3.0))
        link.open()
        twin.drones[0].link = LinkFaults(delay=delay)
        link.start_states()
        before = link.telemetry.received
        assert wait_for(lambda link=link, before=before: link.telemetry.received >= before + 20)  # type: ignore[misc]
        assert link.read_logs(["pm.vbat"]).keys() == {"pm.vbat"}
        assert link.telemetry.health is not None
        link.close()


def test_a_stopped_clock_makes_the_state_old(twin: Twin, link: Link) -> None:
    twin.drones[0].faults = DroneFaults(clock_stopped=True)
    assert wait_for(lambda: link.telemetry.age(time.monotonic()) > 0.3)


def test_a_refused_datagram_ends_the_link_and_nothing_hangs(twin: Twin, link: Link) -> None:
    twin.inject(Injection("port", 0, 0.0))
    for _ in range(30):
        link.send(packets.setpoint_packet(packets.ZERO))
        time.sleep(0.01)
    assert wait_for(lambda: link.lost is not None)
    started = time.monotonic()
    link.close()
    assert time.monotonic() - started < 5


def test_loss_and_jitter_leave_states_in_order(twin: Twin, link: Link) -> None:
    twin.drones[0].link = LinkFaults(loss=0.2, jitter=0.03)
    stamps = []
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        assert link.telemetry.newest is not None
        stamps.append(link.telemetry.newest.stamp)
        time.sleep(0.002)
    assert stamps == sorted(stamps)
    assert len(set(stamps)) > 20
    assert link.telemetry.late > 0  # the overtaken ones are counted and not used


def test_the_firmware_clock_wraps() -> None:
    clock = FirmwareClock()
    assert clock.update(WRAP - 20, 100.0) == 0.0
    assert clock.update(WRAP - 10, 100.01) == pytest.approx(0.01)
    assert clock.update(5, 100.025) == pytest.approx(0.025)
    assert clock.age(0.025, 100.03) == pytest.approx(0.005, abs=1e-5)


def test_a_restarted_firmware_is_never_young_again() -> None:
    clock = FirmwareClock()
    clock.update(500_000, 100.0)
    assert clock.update(20, 100.01) is None
    assert clock.restarted
    assert clock.age(0.0, 100.02) == float("inf")


def test_a_slow_clock_is_no_delay() -> None:
    clock, arrival = FirmwareClock(), 0.0
    for number in range(60_000):  # ten minutes, 50 parts in a million slow
        arrival = 0.01 * number * (1 + 50e-6)
        seconds = clock.update(10 * number, arrival)
        assert seconds is not None
    assert clock.age(seconds, arrival) < 1e-3
