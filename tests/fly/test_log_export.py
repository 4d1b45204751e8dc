"""Flight logs for other programs, read by libraries that did not write them."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call
from fly_policies import untrained
from fly_virtual import VirtualTwin, log_header

from mjxball.export import main
from mjxball.fly.flight_log import Journal
from mjxball.fly.limits import NAMES, FlightSettings
from mjxball.fly.log_export import FIELDS, TYPES
from mjxball.fly.recording import Recording, read_recording

OURS = "mjxball_msgs"
PARTS = ("pose", "twist", "battery", "health", "setpoint", "command")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short flight's log, as the runner writes it."""
    path, contents = tmp_path_factory.mktemp("log") / "flight.jsonl", untrained("flight")
    with Journal(path, **log_header(contents)) as notes:
        VirtualTwin(FlightSettings(seconds=1.0), contents=contents, log=notes).run()
        notes.note("warning", text="a text of one's own")
    return path


@pytest.fixture(scope="module")
def flight(log: Path) -> Recording:
    """The same as arrays."""
    return read_recording(log)


def test_rosbags_reads_every_message_of_the_bag(log: Path, flight: Recording, tmp_path: Path) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel")
    assert call(main, [log, tmp_path / "flight.mcap"]) == 0
    found: dict[str, list[Any]] = {}
    with highlevel.AnyReader([tmp_path / "flight.mcap"]) as reader:
        kinds = {one.topic: one.msgtype.replace("/msg/", "/") for one in reader.connections}
        for connection, time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(raw, connection.msgtype)))
    assert kinds == {topic: TYPES[topic.rpartition("/")[2]] for topic in kinds}
    drones = {f"/{drone}/{part}" for drone in NAMES for part in PARTS}
    assert kinds.keys() >= {*drones, "/tf", "/object/pose", "/goal", "/phase", "/rosout", "/follower/network"}
    # Each number stands where a reader of ROS expects it.
    last = found["/object/pose"][-1][1]
    place, turned = last.pose.position, last.pose.orientation
    np.testing.assert_allclose([place.x, place.y, place.z], flight.position[-1], atol=0.01)
    np.testing.assert_allclose([turned.w, turned.x, turned.y, turned.z], flight.quaternion[-1], atol=0.01)
    sent = [[one.roll, one.pitch, one.yaw_rate, one.thrust] for _, one in found["/leader/setpoint"]]
    np.testing.assert_array_equal(sent[-len(flight.time) :], flight.sent[:, 0])
    ticks = np.array([time for time, _ in found["/goal"]][-len(flight.time) :]) * 1e-9
    np.testing.assert_allclose(ticks - ticks[0], flight.time, atol=1e-6)
    frames = {one.transforms[0].child_frame_id for _, one in found["/tf"]}
    assert frames == {"leader", "follower", "object"}
    assert [one.msg for _, one in found["/rosout"]][-1] == "warning: a text of one's own"
    assert "transition: ramp; fly" in " ".join(one.msg for _, one in found["/rosout"])


def test_the_types_are_those_of_ros() -> None:
    """As `rosbags` has them, field by field and in their order."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in FIELDS.items():
        if name.startswith(OURS):
            continue
        wanted = typesys.get_types_from_msg(text, name.replace("/", "/msg/"))
        for kind, (_, fields) in wanted.items():
            assert fields == store.fielddefs[kind][1], kind


def test_a_twist_is_in_the_axes_of_its_frame(log: Path, tmp_path: Path) -> None:
    """A drone that turned by 90 degrees to the left and moves along x of the world moves to its own right."""
    from mjxball.fly.log_export import _moving

    left = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    (twist,) = (
        one
        for topic, one in _moving("leader", np.zeros(3), left, np.array([1.0, 0, 0]), np.zeros(3), 0)
        if "twist" in topic
    )
    along = twist["twist"]["linear"]
    np.testing.assert_allclose([along["x"], along["y"], along["z"]], [0.0, -1.0, 0.0], atol=1e-12)


def test_csv_and_parquet_hold_the_flight(log: Path, flight: Recording, tmp_path: Path) -> None:
    assert call(main, [log, tmp_path / "flight.csv"]) == 0
    with (tmp_path / "flight.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    np.testing.assert_allclose([float(row["z"]) for row in rows], flight.position[:, 2])
    assert [row["phase"] for row in rows] == list(flight.phase)
    assert rows[0]["leader_roll"] == ""  # no law was in command
    parquet = pytest.importorskip("pyarrow.parquet")
    assert call(main, [log, tmp_path / "flight.parquet"]) == 0
    columns = parquet.read_table(tmp_path / "flight.parquet").to_pydict()
    np.testing.assert_array_equal(columns["follower_sent_thrust"], flight.sent[:, 1, 3])
    assert list(columns) == list(rows[0])


def clock(log: Path, other: Path, wall: str) -> Path:
    """`log` with another wall clock."""
    other.write_text(re.sub(r'"wall": [\d.e+]+', f'"wall": {wall}', log.read_text(), count=1))
    return other


def test_refusals(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there.csv").write_text("mine")
    (tmp_path / "noise.jsonl").write_bytes(b"\x00\x01")
    cases = [
        ([log, tmp_path / "flight.bag"], "must end in .mcap, .csv, .parquet"),
        ([log, tmp_path / "there.csv"], "exists"),
        ([log, tmp_path / "new.csv", "--int8"], "takes no other flag"),
        ([tmp_path / "noise.jsonl", tmp_path / "new.mcap"], "noise.jsonl"),
        ([tmp_path / "none.jsonl", tmp_path / "new.mcap"], "none.jsonl"),
        ([clock(log, tmp_path / "late.jsonl", "1e300"), tmp_path / "new.mcap"], "none that a bag can hold"),
        ([clock(log, tmp_path / "early.jsonl", "-1e9"), tmp_path / "new.mcap"], "none that a bag can hold"),
    ]
    for arguments, reason in cases:
        assert call(main, arguments) == 2, arguments
        errors = capsys.readouterr().err
        assert reason in errors, errors
        assert_one_line(errors)
    assert (tmp_path / "there.csv").read_text() == "mine"
    assert not list(tmp_path.glob("new*"))
