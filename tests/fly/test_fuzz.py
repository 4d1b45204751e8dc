"""Both ends fed with bytes that nobody should send: no crash, no hang, no motor command outside the limits."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjxfly import packets
from mjxfly.connection import Deadlines, LinkError
from mjxfly.link import Link
from mjxfly.twin import logs
from mjxfly.twin.conditions import DroneFaults
from mjxfly.twin.drone import garbage
from mjxfly.twin.firmware import BOOT_TIME, Firmware
from mjxfly.twin.physics import SimplePair
from mjxfly.twin.protocol import MAX_DATA, Peer
from mjxfly.twin.server import HOST, Twin

READINGS = {name: 1e12 for name, _ in logs.LOG_VARIABLES}
ports = st.sampled_from(
    [
        0x2C,
        0x2D,
        0x2E,
        0x2F,
        0x3C,
        0x4C,
        0x5C,
        0x5D,
        0x6C,
        0x6D,
        0x6E,
        0x7C,
        0x7D,
        0x9C,
        0x9D,
        0xDC,
        0xDD,
        0xFC,
        0xFD,
        0xFF,
    ]
)
datagrams = st.one_of(
    st.binary(max_size=64), st.tuples(ports, st.binary(max_size=30)).map(lambda p: bytes([p[0]]) + p[1])
)


@settings(max_examples=200)
@given(st.lists(datagrams, max_size=40))
def test_the_twin_takes_any_bytes(received: list[bytes]) -> None:
    peer = Peer(Firmware())
    for number, datagram in enumerate(received):
        now = 0.01 * number
        answers = peer.receive(datagram, now) + peer.log_data(READINGS, now)
        assert all(1 <= len(answer) <= 1 + MAX_DATA for answer in answers)
        out = peer.firmware.step(now).setpoint
        assert all(map(math.isfinite, out))
        assert out.thrust == 0 or 1000 <= out.thrust <= 60000
        assert all(abs(angle) <= 180 for angle in out[:3])
    assert len(peer.logs.by_number) <= 16
    assert all(block.size <= 26 for block in peer.logs.by_number.values())


def test_truncated_requests_are_survived_at_every_length() -> None:
    requests = [bytes([0x5D, 6, 1, 0x75, 2, 0]), bytes([0x2C, 2, 1, 0]), bytes([0x2F, 7, 1, 0]), bytes([0x9D, 1, 1])]
    requests += [bytes([0x2E, 0, 0, 1]), bytes([0x5D, 3, 1, 1]), bytes([0x3C]) + packets.pack_setpoint(packets.ZERO)]
    for request in requests:
        for length in range(len(request) + 1):
            Peer(Firmware()).receive(request[:length], 0.0)


cflib = pytest.importorskip("cflib")
DEADLINES = Deadlines(connect=10.0, parameter=1.0, first_state=2.0, close=2.0)


def opened(twin: Twin) -> Link:
    def nothing(kind: str, **fields: Any) -> None:
        pass

    link = Link(twin.uris[0], "leader", nothing, DEADLINES)
    link.open()
    link.start_states()
    return link


@pytest.mark.clock
def test_cflib_still_connects_after_a_storm() -> None:
    random = np.random.default_rng(5)
    with Twin(SimplePair()) as twin:
        ports = [int(uri.rsplit(":", 1)[1]) for uri in twin.uris]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for number in range(3000):
                sock.sendto(garbage(random), (HOST, ports[number % 2]))
                assert max(truth := twin.truth.thrust) <= 60000, truth
        time.sleep(0.1)
        for drone in twin.drones:
            drone.reboot()
        time.sleep(BOOT_TIME + 0.5)
        link = opened(twin)
        assert link.telemetry.received > 0
        link.close()
    assert twin.failure is None


@pytest.mark.clock
def test_the_runner_survives_a_hostile_twin() -> None:
    with Twin(SimplePair()) as twin:
        link = opened(twin)
        twin.drones[0].faults = DroneFaults(garbage=4.0)  # 800 datagrams a second
        end = time.monotonic() + 3.0
        while time.monotonic() < end:
            link.send(packets.setpoint_packet(packets.ZERO))
            newest = link.telemetry.newest
            assert newest is not None
            assert all(np.isfinite(part).all() for part in newest.state[:4])
            time.sleep(0.01)
        assert link.sent > 20
        assert link.telemetry.age(time.monotonic()) < 0.5  # no datagram had cflib reset the log
        assert link.stuck_for(time.monotonic()) < 1.0
        started = time.monotonic()
        link.close()
        assert time.monotonic() - started < 5
    assert twin.failure is None


@pytest.mark.clock
def test_connecting_to_a_hostile_twin_ends_one_way_or_the_other() -> None:
    with Twin(SimplePair()) as twin:
        twin.drones[0].faults = DroneFaults(garbage=2.0)
        started = time.monotonic()
        with contextlib.suppress(LinkError):
            opened(twin).close()
        # connect 10, first_state 2, close 2, with slack
        assert time.monotonic() - started < 20
    assert twin.failure is None
