"""Flight logs for other programs, read by libraries that did not write them."""

from __future__ import annotations

import csv
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY, assert_one_line, call, environment
from fly_virtual import short_log

from mjxfly.flight_log import Journal, read
from mjxfly.limits import NAMES
from mjxfly.log import main
from mjxfly.messages import TYPES
from mjxfly.recording import Recording, read_recording

PARTS = ("pose", "twist", "battery", "health", "setpoint", "command")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short flight's log, as the runner writes it."""
    path = tmp_path_factory.mktemp("log") / "flight.jsonl"
    return short_log(path, ("warning", {"text": "a text of one's own"}))


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
    assert kinds.keys() >= {
        *drones,
        "/tf",
        "/object/pose",
        "/goal",
        "/phase",
        "/rosout",
        "/follower/network",
        "/record",
    }
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


def test_csv_and_parquet_hold_the_flight(log: Path, flight: Recording, tmp_path: Path) -> None:
    assert call(main, [log, tmp_path / "flight.csv"]) == 0
    with (tmp_path / "flight.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    np.testing.assert_allclose([float(row["z"]) for row in rows], flight.position[:, 2])
    assert [row["phase"] for row in rows] == list(flight.phase)
    assert rows[0]["leader_roll"] == ""  # no controller was in command
    parquet = pytest.importorskip("pyarrow.parquet")
    assert call(main, [log, tmp_path / "flight.parquet"]) == 0
    columns = parquet.read_table(tmp_path / "flight.parquet").to_pydict()
    np.testing.assert_array_equal(columns["follower_sent_thrust"], flight.sent[:, 1, 3])
    assert list(columns) == list(rows[0])


def killed(command: list[str], path: Path, lines: list[bytes], stdout: Any) -> subprocess.Popen[bytes]:
    """A program that was killed with `lines` on its standard input once the file `path` had not grown for a while."""
    process = subprocess.Popen(
        [sys.executable, *command], cwd=REPOSITORY, env=environment(), stdin=subprocess.PIPE, stdout=stdout
    )
    assert process.stdin is not None
    process.stdin.write(b"".join(lines))
    process.stdin.flush()
    size, since = 0, time.monotonic()
    while not size or time.monotonic() - since < 1.5:
        now = path.stat().st_size if path.exists() else 0
        size, since = now, time.monotonic() if now != size else since
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return process


def times_of(path: Path) -> list[int]:
    """Of the ticks in a bag, by `rosbags`."""
    with pytest.importorskip("rosbags.highlevel").AnyReader([path]) as reader:
        goals = [one for one in reader.connections if one.topic == "/goal"]
        return [time for _, time, _ in reader.messages(goals)]


@pytest.mark.slow
def test_a_killed_recorder_leaves_a_whole_file(log: Path, tmp_path: Path) -> None:
    """All but what came after its last chunk, for `rosbags`, mcap's own streaming reader and ours."""
    stream_reader = pytest.importorskip("mcap.stream_reader")
    lines = log.read_bytes().splitlines(keepends=True)
    path = tmp_path / "killed.mcap"
    with path.open("xb") as target:
        killed(["-m", "mjxfly.log_export"], path, lines[:400], target)
    ticks = [one for one in read(path) if one["kind"] == "tick"]
    assert len(ticks) == sum(b'"kind": "tick"' in line for line in lines[:400]) > 10
    assert len(times_of(path)) == len(ticks)
    with path.open("rb") as stream:
        kinds = [type(one).__name__ for one in stream_reader.StreamReader(stream, validate_crcs=True).records]
    assert (kinds.count("DataEnd"), kinds[-1]) == (1, "Footer")


@pytest.mark.slow
def test_a_recorder_on_a_full_disk_says_so() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    with full.open("wb") as out:
        command = [sys.executable, "-m", "mjxfly.log_export"]
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": subprocess.PIPE}
        done = subprocess.run(command, text=True, check=False, cwd=REPOSITORY, env=environment(), **streams)
    assert done.returncode == 2
    assert_one_line(done.stderr)


WRITER = """
import sys
from pathlib import Path
from mjxfly.flight_log import Journal
from mjxball.reading import parse_json
first, *lines = [parse_json(line) for line in sys.stdin.buffer]
header = {name: value for name, value in first.items() if name not in ("t", "kind", "schema", "wall", "pid")}
journal = Journal(Path(sys.argv[1]), **header)
for line in lines:
    journal.note(**line)
while True:
    pass
"""


@pytest.mark.slow
def test_the_recorder_of_a_killed_runner_ends_its_file(log: Path, flight: Recording, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    lines = log.read_bytes().splitlines(keepends=True)
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, path], cwd=REPOSITORY, env=environment(), stdin=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        process.stdin.write(b"".join(lines))
        process.stdin.close()
        wanted = sum(b'"kind": "tick"' in line for line in lines)
        until = time.monotonic() + 60
        while not (path.exists() and path.stat().st_size and len(times_of(path)) == wanted):
            assert time.monotonic() < until, "the recorder writes nothing"
            time.sleep(0.1)
        process.send_signal(signal.SIGKILL)
    again = read_recording(path)
    np.testing.assert_array_equal(again.position, flight.position)


@pytest.mark.slow
def test_a_recorder_that_ends_is_told_of(log: Path, tmp_path: Path) -> None:
    """The flight goes on; the log says that it is not complete."""
    notes = Journal(tmp_path / "flight.mcap", policy="no header of a flight")
    for _ in range(100):
        notes.note("warning", text="x")
        if notes.failure:
            break
        time.sleep(0.1)
    notes.close()
    assert notes.failure == "Broken pipe"


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
        ([tmp_path / "noise.jsonl", tmp_path / "new.mcap"], "noise.jsonl"),
        ([tmp_path / "none.jsonl", tmp_path / "new.mcap"], "none.jsonl"),
        ([tmp_path / "old.mcap", tmp_path / "new.mcap"], "old.mcap is not converted to .mcap; expected a flight log"),
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
