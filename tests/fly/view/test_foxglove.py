"""What Foxglove is sent while a flight goes on, for a client that is not Foxglove's: `websockets` and `rosbags`."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call
from fly_policies import untrained
from fly_virtual import VirtualTwin, log_header

from mjxfly import flight_log
from mjxfly.display import live_view
from mjxfly.flight_log import Journal
from mjxfly.limits import FlightSettings
from mjxfly.process import bounded
from mjxfly.view.foxglove import Foxglove
from mjxfly.view.main import main as view

client = pytest.importorskip("websockets.sync.client")
exceptions = pytest.importorskip("websockets.exceptions")
typesys = pytest.importorskip("rosbags.typesys")
DATA = struct.Struct("<BIQ")  # kind of message, subscription, time [ns]. https://github.com/foxglove/ws-protocol
PATIENCE = 20.0  # [s]
SUBSCRIBE = '{{"op": "subscribe", "subscriptions": [{{"id": {}, "channelId": {}}}]}}'
HANDSHAKE = (
    "GET / HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a short flight."""
    path, contents = tmp_path_factory.mktemp("log") / "flight.jsonl", untrained("flight")
    with Journal(path, **log_header(contents)) as notes:
        VirtualTwin(FlightSettings(seconds=0.5), contents=contents, log=notes).run()
    return path


@pytest.fixture(scope="module")
def records(log: Path) -> list[dict[str, Any]]:
    return list(flight_log.read(log))


def heard(plug: Any, operation: str) -> dict[str, Any]:
    """The next text of one kind."""
    while True:
        found = plug.recv(timeout=PATIENCE)
        if isinstance(found, str) and (told := json.loads(found))["op"] == operation:
            return told


def message(plug: Any, subscription: int, patience: float = PATIENCE) -> bytes:
    """The next message of one `subscription`. Raises TimeoutError."""
    while True:
        found = plug.recv(timeout=patience)
        if isinstance(found, bytes) and DATA.unpack_from(found)[:2] == (1, subscription):
            return found


def subscribe(server: Foxglove, plug: Any, subscription: int, channel: int) -> None:
    """Return once the server has heard it. Only a message tells: it may answer a ping sooner than a text before it."""
    probe = server.register_channel("/probe", "cdr", server.register_schema("x/msg/Probe", "ros2msg", b""))
    plug.send(SUBSCRIBE.format(subscription, channel))
    plug.send(SUBSCRIBE.format(0, probe))
    while True:
        server.add_message(probe, 0, b"", 0, 0)
        with contextlib.suppress(TimeoutError):
            message(plug, 0, 0.1)
            return


def test_a_foreign_client_reads_the_poses(records: list[dict[str, Any]]) -> None:
    half = len(records) // 2
    with Foxglove(0) as server:
        for record in records[:half]:
            server.take(record)
        with client.connect(server.address, subprotocols=["foxglove.sdk.v1"]) as plug:
            assert heard(plug, "serverInfo")["name"] == "mjxball"
            channels: dict[str, dict[str, Any]] = {}
            while "/leader/pose" not in channels:
                channels |= {one["topic"]: one for one in heard(plug, "advertise")["channels"]}
            pose = channels["/leader/pose"]
            assert (pose["encoding"], pose["schemaEncoding"]) == ("cdr", "ros2msg")
            subscribe(server, plug, 7, pose["id"])
            store = typesys.get_typestore(typesys.Stores.EMPTY)
            store.register(typesys.get_types_from_msg(pose["schema"], pose["schemaName"]))
            wanted, places = [], []
            for record in records[half:]:
                server.take(record)
                if record["kind"] != "state" or record["drone"] != "leader":
                    continue
                wanted.append(record["raw"].state.position)
                found = message(plug, 7)[DATA.size :]
                place = store.deserialize_cdr(found, pose["schemaName"]).pose.position
                places.append([place.x, place.y, place.z])
    assert len(places) > 20
    np.testing.assert_array_equal(places, wanted)


def test_the_live_view_serves_it_too(log: Path) -> None:
    with live_view(log, foxglove=0) as page:
        address = page.line.partition("Foxglove connects to ")[2]
        with client.connect(address, subprotocols=["foxglove.sdk.v1"]) as plug:
            topics: set[str] = set()
            while not topics >= {"/tf", "/follower/command", "/goal"}:
                topics |= {one["topic"] for one in heard(plug, "advertise")["channels"]}


def test_only_this_machine_is_served() -> None:
    with Foxglove(0) as server:
        port = int(server.address.rpartition(":")[2])
        listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        listening += [line.split()[1] for line in Path("/proc/net/tcp6").read_text().splitlines()[1:]]
    assert [one for one in listening if one.endswith(f":{port:04X}")] == [f"0100007F:{port:04X}"]


def test_pages_of_elsewhere_are_refused() -> None:
    """By their origin, and by the name by which they reached this machine."""
    asked: list[tuple[dict[str, Any], bool]] = [
        ({}, True),
        ({"origin": "https://app.foxglove.dev"}, True),
        ({"origin": "http://localhost:8080"}, True),
        ({"origin": "file://"}, True),
        ({"origin": "http://evil.example"}, False),
        ({"origin": "https://app.foxglove.dev.evil.example"}, False),
        ({"origin": "http://app.foxglove.dev"}, False),
        ({"origin": "http://localhost.evil.example"}, False),
        ({"origin": "null"}, False),
        ({"additional_headers": {"Origin": "file:///"}, "origin": "http://evil.example"}, False),
    ]
    with Foxglove(0) as server:
        for headers, welcome in asked:
            if welcome:
                with client.connect(server.address, subprotocols=["foxglove.sdk.v1"], **headers) as plug:
                    assert heard(plug, "serverInfo")["name"] == "mjxball", headers
                continue
            with pytest.raises(exceptions.InvalidStatus, match="403"):
                client.connect(server.address, subprotocols=["foxglove.sdk.v1"], **headers)
        port = int(server.address.rpartition(":")[2])
        for name in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example"):
            with socket.create_connection(("127.0.0.1", port)) as plug:
                plug.sendall(HANDSHAKE.format(name).encode())
                assert plug.recv(100).startswith(b"HTTP/1.1 403"), name


def test_a_client_that_says_anything_else_is_let_go_of_and_the_others_stay() -> None:
    with Foxglove(0) as server, client.connect(server.address, subprotocols=["foxglove.sdk.v1"]) as stays:
        for text in ("nonsense", "[1]", "[" * 60_000, '{"op": "subscribe"}', SUBSCRIBE.format(2**40, 1), "x" * 10**6):
            with client.connect(server.address, subprotocols=["foxglove.sdk.v1"]) as plug:
                plug.send(text)
                with contextlib.suppress(exceptions.ConnectionClosed):
                    while plug.recv(timeout=PATIENCE):
                        pass
        schema = server.register_schema("x/msg/Y", "ros2msg", b"float64 x")
        channel = server.register_channel("/y", "cdr", schema)
        stays.send('{"op": "unknown"}')
        subscribe(server, stays, 3, channel)
        server.add_message(channel, 5, b"12345678", 5, 0)
        assert message(stays, 3) == DATA.pack(1, 3, 5) + b"12345678"


def test_a_client_that_does_not_read_holds_nobody_up() -> None:
    """What it misses are the oldest data, no topic; one that never reads is left behind when the flight ends."""
    server = Foxglove(0)
    with client.connect(server.address, subprotocols=["foxglove.sdk.v1"], compression=None, close_timeout=0.1) as plug:
        channel = server.register_channel("/y", "cdr", server.register_schema("x/msg/Y", "ros2msg", b"uint8[] x"))
        subscribe(server, plug, 3, channel)
        for number in range(3000):
            server.add_message(channel, number, bytes(20_000), number, 0)
            if number == 1000:
                server.register_channel("/late", "cdr", 1)
        times, texts = [0], ""
        while times[-1] < 2999:
            found = plug.recv(timeout=PATIENCE)
            if isinstance(found, str):
                texts += found
            else:
                times.append(DATA.unpack_from(found)[2])
        assert 1000 <= len(times) < 3000
        assert "/late" in texts
        for number in range(3000):
            server.add_message(channel, number, bytes(20_000), number, 0)
        assert bounded(server.__exit__, PATIENCE)


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "flight.jsonl"
    with Foxglove(0) as server:
        taken = server.address.rpartition(":")[2]
        cases = [
            (["--live", log, "--foxglove", taken], f"port {taken} of --foxglove cannot be had"),
            (["--live", log, "--foxglove", 70000], "--foxglove must be 1 to 65535, not 70000"),
            ([log, "--foxglove", 0], "--foxglove goes with --live"),
        ]
        for arguments, reason in cases:
            assert call(view, arguments) == 2, arguments
            errors = capsys.readouterr().err
            assert reason in errors, errors
            assert_one_line(errors)
