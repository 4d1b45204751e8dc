"""What Foxglove is sent while a flight goes on, for a client that is not Foxglove's: `websockets` and `rosbags`."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call
from fly_policies import untrained
from fly_virtual import VirtualTwin, log_header

from mjxball.fly import flight_log
from mjxball.fly.display import live_view
from mjxball.fly.flight_log import Journal
from mjxball.fly.limits import FlightSettings
from mjxball.view.foxglove import Foxglove
from mjxball.view.main import main as view

pytest.importorskip("foxglove")
client = pytest.importorskip("websockets.sync.client")
typesys = pytest.importorskip("rosbags.typesys")
DATA = struct.Struct("<BIQ")  # kind of message, subscription, time [ns]. https://github.com/foxglove/ws-protocol
PATIENCE = 20.0  # [s]


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
            plug.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": pose["id"]}]}))
            plug.ping().wait(PATIENCE)
            store = typesys.get_typestore(typesys.Stores.EMPTY)
            store.register(typesys.get_types_from_msg(pose["schema"], pose["schemaName"]))
            wanted, places = [], []
            for record in records[half:]:
                server.take(record)
                if record["kind"] != "state" or record["drone"] != "leader":
                    continue
                wanted.append(record["raw"].state.position)
                found = plug.recv(timeout=PATIENCE)
                kind, subscription, _ = DATA.unpack_from(found)
                assert (kind, subscription) == (1, 7)
                place = store.deserialize_cdr(found[DATA.size :], pose["schemaName"]).pose.position
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
