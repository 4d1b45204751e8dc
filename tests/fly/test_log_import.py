"""Flights that others recorded, written by libraries that know nothing of us, against the log they were made of."""

from __future__ import annotations

import dataclasses
import itertools
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call
from fly_virtual import short_log
from foreign_logs import NAMES, write_bag, write_cfclient

from mjxball.control.rotations import matrix_from_quaternion, quaternion_from_euler
from mjxball.errors import InputError
from mjxball.plotting import pyplot
from mjxfly import flight_log
from mjxfly.log import main as export
from mjxfly.log_schema import Record, StatePacket
from mjxfly.packets import DroneState
from mjxfly.recording import Recording, numbers, read_recording
from mjxfly.rig import identify
from mjxfly.rig.log import read_log

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
MEASURED = ("time", "position", "velocity", "quaternion", "rates", "sent")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short flight's log, as the runner writes it."""
    gain = {"drone": "follower", "name": "pid_attitude.roll_kp", "value": 7.0}
    path = tmp_path_factory.mktemp("log") / "flight.jsonl"
    return short_log(path, ("parameter", gain), ("end", {"code": 0}))


@pytest.fixture(scope="module")
def flight(log: Path) -> Recording:
    return read_recording(log)


@pytest.fixture(scope="module")
def records(log: Path) -> list[Record]:
    """States and ticks in the order of time."""
    own = (one for one in flight_log.read(log) if one["kind"] in ("state", "tick"))
    return sorted(own, key=lambda one: float(one["t"]))


@pytest.fixture(scope="module")
def exported(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "flight.mcap"
    assert call(export, [log, path]) == 0
    return path


def printed(main: Any, arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> list[str]:
    assert call(main, arguments) == 0
    return [line for line in capsys.readouterr().out.splitlines() if "figure" not in line]


def test_a_bag_of_ours_is_the_log_itself(log: Path, flight: Recording, exported: Path, tmp_path: Path) -> None:
    again = read_recording(exported)
    for field in dataclasses.fields(Recording):
        one, other = getattr(flight, field.name), getattr(again, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other, field.name)
        else:
            assert one == other, field.name
    assert again.setup.gains[1]["pid_attitude.roll_kp"] == 7.0
    tables = [call(export, [path, tmp_path / f"{path.suffix[1:]}.csv"]) for path in (log, exported)]
    assert tables == [0, 0]
    assert (tmp_path / "jsonl.csv").read_bytes() == (tmp_path / "mcap.csv").read_bytes()


@pytest.mark.slow
def test_its_report_has_the_same_numbers(log: Path, exported: Path, tmp_path: Path, capsys) -> None:
    reports = [printed(export, [path, tmp_path / path.suffix[1:], "--simulate"], capsys) for path in (log, exported)]
    assert reports[0] == reports[1]
    assert len(reports[0]) > 2


@pytest.mark.parametrize("sqlite", [False, True])
@pytest.mark.parametrize("odometry", [False, True])
def test_a_bag_of_crazyswarm2(
    records: list[Record], flight: Recording, tmp_path: Path, sqlite: bool, odometry: bool
) -> None:
    """Its names are sorted the other way round than its drones stand. A file in it without its folder does as well."""
    bag = write_bag(tmp_path / "bag", records, sqlite=sqlite, odometry=odometry)
    (file,) = (one for one in bag.iterdir() if one.suffix != ".yaml")
    for number, path in enumerate((bag, file)):
        assert call(export, [path, table := tmp_path / f"{number}.csv"]) == 0
        assert table.read_text().count("\n") == 1 + len(flight.time)
        again = read_recording(path)
        known = MEASURED if odometry else ("time", "position", "quaternion", "sent")
        for name in known:
            np.testing.assert_allclose(getattr(again, name), getattr(flight, name), atol=1e-6, err_msg=name)
        assert "cf7 is taken for the leader" in " ".join(again.remarks)
        assert ("differences of its poses" in " ".join(again.remarks)) is not odometry
        assert len(read_log(path).setpoints) > 100


@pytest.mark.parametrize("ours", [False, True])
def test_a_figure_has_what_a_recording_has(
    ours: bool, log: Path, records: list[Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No panel and no entry of the legend is empty; the CG, which no log has, is called assumed. Phases have names."""
    path = log if ours else write_bag(tmp_path / "bag", records, odometry=True)
    panels: dict[str, int] = {}
    legend: list[str] = []
    phases: list[str] = []

    def keep(figure: Any) -> None:
        assert all(np.isfinite(line.get_ydata()).any() for panel in figure.axes for line in panel.lines)
        curves = {panel: [one for one in panel.lines if len(one.get_xdata()) > 2] for panel in figure.axes}
        panels.update({panel.get_ylabel(): len(lines) for panel, lines in curves.items()})
        phases.extend(text.get_text() for text in figure.axes[0].texts)
        legend.extend(text.get_text() for text in figure.legends[0].get_texts())
        title = figure.legends[0].get_title().get_text()
        assert title.startswith(f"{path.name}: ")
        assert ("simulation: CG" in title) is ("simulated" in " ".join(legend))

    monkeypatch.setattr(pyplot(), "close", keep)
    assert call(export, [path, tmp_path / "alone"]) == 0
    assert "assumed CG offset [m]" not in panels
    assert not any("simulated" in one for one in legend)
    legend.clear()
    panels.clear()
    assert call(export, [path, tmp_path / "drawn", "--simulate"]) == 0
    monkeypatch.undo()
    pyplot().close("all")
    assert any("fly" in one for one in phases) is ours
    motion = ["x [m]", "y [m]", "z [m]"]
    commands = ["roll command [deg]", "pitch command [deg]", "vertical command [m/s²]"]
    if ours:
        assert [*panels] == [*motion, "distance to goal [mm]", "assumed CG offset [m]", *commands]
        assert {"goal", "thin: leader"} < {*legend}
    else:
        assert panels == {**dict.fromkeys(motion, 2), "assumed CG offset [m]": 1}
        assert legend == ["an unknown follower, flown", "the same, simulated"]


def test_messages_of_ours_without_the_lines(exported: Path, flight: Recording, tmp_path: Path) -> None:
    """As `ros2 bag record` leaves them that was told a few topics."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import StoragePlugin, Writer

    kept = ("pose", "twist", "setpoint", "battery")
    plugin = StoragePlugin.MCAP
    with AnyReader([exported]) as reader, Writer(tmp_path / "few", version=9, storage_plugin=plugin) as writer:
        topics = {
            one.topic: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore)
            for one in reader.connections
            if one.topic.endswith(kept)
        }
        for connection, time, raw in reader.messages():
            if connection.topic in topics:
                writer.write(topics[connection.topic], time, raw)
    again = read_recording(tmp_path / "few")
    for name in MEASURED:
        np.testing.assert_allclose(getattr(again, name), getattr(flight, name), atol=1e-6, err_msg=name)


def turning(rates: np.ndarray, step: float = 0.01) -> list[Record]:
    """Both drones of the stick turn by the same yaw rates (n,) [rad/s], with what the pair is sent."""
    found: list[Record] = []
    for number, yaw in enumerate(np.cumsum(rates) * step):
        turned = quaternion_from_euler(np.array([0.0, 0.0, yaw]))
        for name, side in (("leader", 1.0), ("follower", -1.0)):
            place = 0.15 * side * np.array([-np.sin(yaw), np.cos(yaw), 0.0])
            state = DroneState(place, np.zeros(3), turned, np.array([0.0, 0.0, rates[number]]), 0, 3.9)
            found.append({"t": number * step, "kind": "state", "drone": name, "raw": StatePacket(0, state)})
        found.append({"t": number * step, "kind": "tick", "sent": np.array([[1.0, 2.0, 3.0, 4e4]] * 2)})
    return found


def test_rates_and_velocity_of_poses(tmp_path: Path) -> None:
    """A steady turn: the velocity of each drone is rate times arm."""
    path = write_bag(tmp_path / "bag", turning(np.full(200, 0.8)))
    raw = [one for one in flight_log.read(path) if one["kind"] == "state" and one["drone"] == "leader"]
    for one in raw[2:-2]:
        state = one["raw"].state
        np.testing.assert_allclose(state.rates, [0, 0, 0.8], atol=1e-4)
        assert np.linalg.norm(state.velocity) == pytest.approx(0.8 * 0.15, rel=1e-4)


def swaying(count: int = 180, step: float = 0.01) -> list[Record]:
    """A pair that turns to and fro while it flies to and fro, with the velocities and rates of that."""
    found: list[Record] = []
    for number in range(count):
        time = number * step
        yaw, rate = 0.6 * np.sin(2.0 * time), 1.2 * np.cos(2.0 * time)
        roll = 0.3 * np.sin(3.0 * time)
        turned = quaternion_from_euler(np.array([roll, 0.0, yaw]))
        rates = np.array([0.9 * np.cos(3.0 * time), rate * np.sin(roll), rate * np.cos(roll)])
        centre, moving = np.array([0.3 * np.sin(time), 0, 0.4]), np.array([0.3 * np.cos(time), 0, 0])
        for name, side in (("leader", 0.15), ("follower", -0.15)):
            stick = side * matrix_from_quaternion(turned)[:, 1]
            velocity = moving + matrix_from_quaternion(turned) @ np.cross(rates, [0.0, side, 0.0])
            state = DroneState(centre + stick, velocity, turned, rates, 0, 3.9)
            found.append({"t": time, "kind": "state", "drone": name, "raw": StatePacket(0, state)})
        found.append({"t": time, "kind": "tick", "sent": np.array([[1.0, 2.0, 3.0, 4e4 + number]] * 2)})
    return found


def states_of(path: Path, told: list[str], drone: str = "follower") -> dict[float, np.ndarray]:
    """Numbers of a drone's states by time."""
    raw = [one for one in flight_log.read(path, told.append) if one.get("drone") == drone]
    return {round(one["t"], 3): numbers(one["raw"].state) for one in raw}


LOST = range(60, 100)  # rows of the follower
WRITERS = {
    "MCAP": lambda path, records: write_bag(path, records, odometry=True),
    "SQLite": lambda path, records: write_bag(path, records, odometry=True, sqlite=True),
    "cfclient": lambda path, records: write_cfclient(path, records, dict.fromkeys(NAMES, 1.0)),
}
MISSING: list[tuple[str, Callable[[DroneState], dict[str, Any]]]] = [
    ("position", lambda one: {"position": np.full(3, np.nan)}),
    ("position", lambda one: {"position": one.position * np.inf}),
    ("position", lambda one: {"position": np.full(3, 1e30)}),
    ("position", lambda one: {"position": np.array([0.0, 0.0, 5.0])}),
    ("quaternion", lambda one: {"quaternion": np.zeros(4)}),
    ("quaternion", lambda one: {"quaternion": 2.0 * one.quaternion}),
    ("quaternion", lambda one: {"quaternion": np.full(4, np.nan)}),
    ("body rate", lambda one: {"rates": np.full(3, np.nan)}),
    ("velocity", lambda one: {"velocity": np.full(3, -np.inf)}),
]


@pytest.mark.parametrize("source", WRITERS)
def test_rows_that_hold_nothing_are_missing(source: str, tmp_path: Path) -> None:
    """40 of 180 rows: the states without them are those of the whole recording, and the gap is told."""
    records = swaying()
    whole = states_of(WRITERS[source](tmp_path / "whole", records), [])
    for number, (quantity, change) in enumerate(MISSING[:: 4 if source == "SQLite" else 1]):
        spoilt = [
            {**one, "raw": one["raw"]._replace(state=one["raw"].state._replace(**change(one["raw"].state)))}
            if one.get("drone") == "follower" and k // 3 in LOST
            else one
            for k, one in enumerate(records)
        ]
        path, told = WRITERS[source](tmp_path / str(number), spoilt), []
        found = states_of(path, told)
        assert any(f"has no {quantity} in 40 of 180 rows, first 0.60 s after" in text for text in told), told
        lost = sorted(set(whole) - set(found))
        assert len(lost) == 40, (quantity, lost)
        assert lost[0] == pytest.approx(min(whole) + 0.6)
        for time, row in found.items():
            np.testing.assert_allclose(row, whole[time], atol=1e-6)
        assert any("no state of the follower for 0.41 s from 0.6 s on" in text for text in read_recording(path).remarks)


def test_setpoints_that_hold_nothing_are_held(tmp_path: Path) -> None:
    records = swaying()
    for source, write in WRITERS.items():
        spoilt = [
            {**one, "sent": one["sent"] * np.nan} if "sent" in one and k // 3 in LOST else one
            for k, one in enumerate(records)
        ]
        remarks = read_recording(write(tmp_path / source, spoilt)).remarks
        assert any("has no setpoint in 40 of 180 rows" in text for text in remarks)
        assert any(
            "ticks there is nothing for 0.41 s from 0.59 s on, where what was sent is held" in r for r in remarks
        )


@pytest.mark.parametrize("sqlite", [False, True])
def test_messages_without_a_stamp_are_missing(sqlite: bool, tmp_path: Path) -> None:
    """3 messages of each drone, the first ones or later; of a bag without stamps no time is known."""
    records = swaying()
    for begin in (0, 150):
        told: list[str] = []
        path = write_bag(
            tmp_path / str(begin), records, odometry=True, sqlite=sqlite, unstamped=range(begin, begin + 9)
        )
        assert len(states_of(path, told)) == 177
        assert len(read_recording(path).time) == 180 - 3 * (begin == 0)
        lost = "position, quaternion, velocity, body rate, battery in 3 of 180 rows"
        assert f"cf231 has no {lost}, first {begin / 300:.2f} s after" in " ".join(told)
    path = write_bag(tmp_path / "none", records, odometry=True, sqlite=sqlite, unstamped=range(540))
    with pytest.raises(InputError, match=r"is stamped 1\.7e\+09 s before it was received"):
        states_of(path, [])


def test_cfclient_s_rows_out_of_time(tmp_path: Path) -> None:
    """Stamps that are equal, go back, leap ahead, are 0, or are not there."""
    records = swaying()
    whole = states_of(write_cfclient(tmp_path / "whole", records, {"leader": 5.0, "follower": 7.0}), [])
    for number, stamp in enumerate(("7000", "6500", "99000", "0", "", "nan")):
        path, told = write_cfclient(tmp_path / str(number), records, {"leader": 5.0, "follower": 7.0}), []
        for file in (path / "follower").glob("*.csv"):
            lines = file.read_text().splitlines()
            file.write_text(
                "\n".join([*lines[:101], *(stamp + one[4:] for one in lines[101:104]), *lines[104:]]) + "\n"
            )
        found = states_of(path, told)
        assert len(found) == 177
        assert sum("3 of 180 rows whose time does not follow" in text for text in told) == 4
        for time, row in found.items():
            np.testing.assert_allclose(row, whole[time], atol=1e-4)


def test_texts_with_a_byte_order_mark_and_other_line_ends(tmp_path: Path) -> None:
    records = swaying(60)
    path = WRITERS["cfclient"](tmp_path / "logdata", records)
    whole = states_of(path, [])
    for text in path.rglob("*.csv"):
        text.write_bytes(b"\xef\xbb\xbf" + text.read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_equal(states_of(path, []), whole)
    text.write_bytes(text.read_text("utf-8-sig").encode("utf-16"))
    with pytest.raises(InputError, match="it is UTF-16; save it as UTF-8"):
        states_of(path, [])


@pytest.mark.parametrize("sqlite", [False, True])
def test_compressed_bags_are_read_with_and_without_their_metadata(sqlite: bool, tmp_path: Path) -> None:
    records = swaying(60)
    whole = states_of(write_bag(tmp_path / "plain", records, odometry=True, sqlite=sqlite), [])
    for mode in ("message", "file"):
        bag = write_bag(tmp_path / mode, records, odometry=True, sqlite=sqlite, compression=mode)
        (file,) = (one for one in bag.iterdir() if one.suffix != ".yaml")
        for path in (bag, file):
            np.testing.assert_equal(states_of(path, []), whole)
        (bag / "metadata.yaml").write_text("version: x")
        np.testing.assert_equal(states_of(bag, []), whole)
        (bag / "metadata.yaml").unlink()
        np.testing.assert_equal(states_of(bag, []), whole)


def moving(records: list[Record], change: Callable[[DroneState], dict[str, Any]]) -> list[Record]:
    """`records` with the changed fields of each state."""
    return [
        {**one, "raw": one["raw"]._replace(state=one["raw"].state._replace(**change(one["raw"].state)))}
        if "raw" in one
        else one
        for one in records
    ]


def in_axes(linear: bool, angular: bool) -> Callable[[DroneState], dict[str, Any]]:
    """Velocities in the drone's and rates in the world's axes, where asked for."""

    def turned(state: DroneState) -> dict[str, Any]:
        matrix = matrix_from_quaternion(state.quaternion)
        return {
            **({"velocity": matrix.T @ state.velocity} if linear else {}),
            **({"rates": matrix @ state.rates} if angular else {}),
        }

    return turned


def test_an_odometry_s_axes_are_those_in_which_it_agrees_with_its_poses(tmp_path: Path) -> None:
    """`nav_msgs` says the child frame, Crazyswarm2 writes the world's; a level pair that looks along x cannot tell."""
    records = swaying()
    truth = {round(one["t"], 3): numbers(one["raw"].state) for one in records if one.get("drone") == "follower"}
    for linear, angular in itertools.product((False, True), repeat=2):
        told: list[str] = []
        written = moving(records, in_axes(linear, angular))
        path = write_bag(tmp_path / f"{linear}{angular}", written, odometry=True, spin=True)
        for time, row in states_of(path, told).items():
            np.testing.assert_allclose(row, truth[time], atol=1e-6)
        assert any("velocity of cf231 is taken in the drone's axes" in text for text in told) is linear
        assert any("body rate of cf231 is taken in the world's axes" in text for text in told) is angular
    unlike = r" of cf(7|231) is not that of its poses, [\d.e+]+ {} wrong in the {}'s axes and .* or less"
    of_velocity, of_rates = unlike.format("m/s", "world"), unlike.format("rad/s", "drone")
    for name, by, reason in (
        ("mm", {"position": 1000.0}, rf"velocity{of_velocity}; is its position in mm\?$"),
        ("cm", {"position": 100.0}, rf"velocity{of_velocity}; is its position in cm\?$"),
        ("mm/s", {"velocity": 1000.0}, rf"velocity{of_velocity}; is its velocity in mm/s\?$"),
        ("back", {"velocity": -1.0}, rf"velocity{of_velocity}$"),
        ("degrees", {"rates": 57.3}, rf"body rate{of_rates}; is its body rate in deg/s\?$"),
    ):
        wrong = moving(records, lambda state, by=by: {key: by[key] * getattr(state, key) for key in by})
        with pytest.raises(InputError, match=reason):
            states_of(write_bag(tmp_path / name.replace("/", ""), wrong, odometry=True, spin=True), [])


def test_cfclient_s_two_clocks_are_brought_together(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    rates = np.convolve(random.normal(size=900), np.ones(30) / 6, "same")
    boots = {"leader": 12.5, "follower": 860.0}
    told: list[str] = []
    path = write_cfclient(tmp_path / "logdata", turning(rates), boots)
    found = list(flight_log.read(path, told.append))
    times = {name: [one["t"] for one in found if one.get("drone") == name] for name in boots}
    np.testing.assert_allclose(times["leader"], times["follower"], atol=0.004)
    quick = write_cfclient(tmp_path / "quick", turning(rates), boots)
    for file in (quick / "follower").glob("*.csv"):
        head, *lines = file.read_text().splitlines()
        rows = [line.split(",", 1) for line in lines]
        file.write_text("\n".join([head, *(f"{1.002 * float(stamp):.1f},{rest}" for stamp, rest in rows)]) + "\n")
    again = [one["t"] for one in flight_log.read(quick) if one.get("drone") == "follower"]
    np.testing.assert_allclose(times["leader"], again, atol=0.004)
    tick = next(one for one in found if one["kind"] == "tick")
    np.testing.assert_allclose(tick["sent"], [[1.0, 2.0, 3.0, 4e4]] * 2)
    assert any("its" not in text and "-847.5" in text for text in told)
    assert call(export, [path, tmp_path / "flight.csv"]) == 0
    assert (tmp_path / "flight.csv").read_text().startswith("time,phase,")


def test_cfclient_s_drones_on_two_sticks_are_refused(tmp_path: Path) -> None:
    random = np.random.default_rng(4)
    one, other = (turning(random.normal(size=500)) for _ in range(2))
    mixed = [row for row in one if row.get("drone") != "follower"] + [row for row in other if "drone" in row][1::2]
    path = write_cfclient(tmp_path / "logdata", sorted(mixed, key=lambda row: float(row["t"])), dict.fromkeys(NAMES, 0))
    with pytest.raises(InputError, match=r"is of two clocks: at best the drones' rates agree by 0\.[0-4]"):
        list(flight_log.read(path))


def in_chunks(path: Path, target: Path) -> Path:
    """A copy of the bag `path` in chunks of 10 kB."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with path.open("rb") as source, target.open("xb") as stream:
        writer, schemas, channels = Writer(stream, chunk_size=10_000), dict[int, int](), dict[int, int]()
        writer.start(profile="ros2")
        for kind, channel, message in make_reader(source).iter_messages():
            if kind.id not in schemas:
                schemas[kind.id] = writer.register_schema(kind.name, kind.encoding, kind.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schemas[kind.id])
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


def truncated(path: Path, size: int, target: Path) -> Path:
    target.write_bytes(path.read_bytes()[:size])
    return target


def test_an_mcap_file_that_is_cut_is_read_as_far_as_it_goes(records: list[Record], tmp_path: Path) -> None:
    from rosbags.rosbag2 import ReaderError
    from rosbags.rosbag2.storage_mcap import McapReader

    bag = in_chunks(write_bag(tmp_path / "bag", records) / "bag.mcap", tmp_path / "chunks.mcap")
    size, counts = bag.stat().st_size, []
    whole = sum(one["kind"] == "state" for one in flight_log.read(bag))
    folder = tmp_path / "bag"
    for share in np.linspace(0.3, 0.999, 15):
        cut = truncated(bag, round(share * size), folder / "bag.mcap")
        with pytest.raises(ReaderError):
            McapReader(cut).open()
        told: list[str] = []
        numbers = [sum(one["kind"] == "state" for one in flight_log.read(one, told.append)) for one in (cut, folder)]
        assert numbers[0] == numbers[1]
        assert told[0] == next(text for text in told[1:] if "cut short" in text)
        counts.append(numbers[0])
    assert counts == sorted(counts)
    assert 0 < counts[0] < counts[-1] == whole
    with pytest.raises(InputError, match=r"bag .* is empty: it holds no message"):
        list(flight_log.read(truncated(bag, 60, tmp_path / "head.mcap")))


def test_bad_input_is_refused_in_one_sentence(
    records: list[Record], log: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turn = turning(np.full(50, 0.3))
    far = [{**one, "raw": one["raw"]._replace(state=moved(one))} if "raw" in one else one for one in turn]
    lost = [{**one, "raw": one["raw"]._replace(state=unturned(one))} if "raw" in one else one for one in turn]
    huge = write_cfclient(tmp_path / "huge", turn, {"leader": 0, "follower": 0})
    state = next(file for file in (huge / "leader").glob("*.csv") if "stateEstimate.x" in file.read_text())
    head, *rows = state.read_text().splitlines()
    place = head.split(",").index("stateEstimate.x")
    rows = [",".join("1e300" if k == place else one for k, one in enumerate(row.split(","))) for row in rows]
    state.write_text("\n".join([head, *rows]))
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.mcap").write_text("an MCAP file?")
    (tmp_path / "none.mcap").write_bytes(b"")
    (tmp_path / "void.mcap").write_bytes(bag_of_nothing())
    truncated(tmp_path / "void.mcap", 20, tmp_path / "head.mcap")
    (tmp_path / "noise.db3").write_bytes(bytes(range(256)))
    (tmp_path / "one.csv").write_text("Timestamp,pm.vbat\n1,3.9\n")
    half = write_cfclient(tmp_path / "half", turn, {"leader": 0, "follower": 0})
    shutil.rmtree(half / "follower")
    ours = write_cfclient(tmp_path / "ours", turn, {"leader": 0, "follower": 0})
    (ours / "leader" / "flight.csv").write_text("time,phase\n0,fly\n")
    less = write_cfclient(tmp_path / "less", turn, {"leader": 0, "follower": 0})
    next((less / "leader").glob("target*")).unlink()
    two = write_cfclient(tmp_path / "back", turn, {"leader": 0, "follower": 0})
    (two / "leader" / "more.csv").write_text("Timestamp,pm.vbat\n20,3.9\n10,3.9\n")
    short = write_cfclient(tmp_path / "short", turn, {"leader": 0, "follower": 0})
    gyro = next((short / "leader").glob("turning*"))
    gyro.write_text(re.sub(r"^(200,.*),.*$", r"\1", gyro.read_text(), flags=re.MULTILINE))
    cases = [
        (write_bag(tmp_path / "idle", turn, commands=False), "holds 0 drones with poses and setpoints; expected two"),
        (write_bag(tmp_path / "other", turn, pose="Pose"), "found /cf231/cmd_vel_legacy (geometry_msgs/Twist)"),
        (write_bag(tmp_path / "late", turn, late=3 * 10**9), "is stamped 3 s before it was received; expected 0.05 s"),
        (write_bag(tmp_path / "far", far), "expected 0.00 0.30 0.00, as leader and follower are"),
        (
            write_bag(tmp_path / "lost", lost),
            "has 0 good rows of 50; expected two or more, of finite numbers and a length of 1",
        ),
        (tmp_path / "folder", "without .mcap or .db3; expected a rosbag2"),
        (tmp_path / "text.mcap", "begins with b'an MCAP '; expected an MCAP file"),
        (tmp_path / "none.mcap", "is empty; expected an MCAP file"),
        (tmp_path / "void.mcap", "is empty: it holds no message"),
        (tmp_path / "head.mcap", "head.mcap ends, or is damaged, within its header; expected a whole one"),
        (tmp_path / "noise.db3", "cannot be read"),
        (tmp_path / "gone.mcap", "does not exist; expected a rosbag2"),
        (
            tmp_path / "one.csv",
            "an export of ours is not read back; expected its .jsonl or .mcap, or of cfclient the folder",
        ),
        (half, "follower holds no .csv"),
        (ours / "leader", "expected a rosbag2 file or folder, or cfclient's leader and follower"),
        (short, "cannot be used: row 21 has 4 values; expected 5"),
        (ours, "begins with 'time,phase'; expected cfclient's Timestamp"),
        (less, "leader has no sent; expected all numbers of it of ctrltarget.roll"),
        (two, "row 2: the time goes back by 0.01 s"),
        (huge, "position of leader has 0 good rows of 50; expected two or more, of finite numbers up to 10000 m"),
    ]
    for path, reason in cases:
        for main, arguments in (
            (export, [path, tmp_path / "drawn"]),
            (identify.main, [path]),
        ):
            assert call(main, arguments) == 2, path
            errors = capsys.readouterr().err
            assert reason in errors, errors
            assert_one_line(errors)
    assert call(export, [exported, tmp_path / "drawn", "--plant", "crazyflie"]) == 2
    assert "says which rig flew: drop --plant" in capsys.readouterr().err
    assert not (tmp_path / "drawn").exists()


@pytest.mark.parametrize(
    ("rates", "found"), [(lambda _: 0, 0), (lambda _: 2, 2), (lambda _: 4, 4), (lambda number: 3 - (number > 30), 2)]
)
def test_rates_of_another_width_are_refused(rates: Callable[[int], int], found: int, tmp_path: Path, capsys) -> None:
    """A custom topic has the variables that its user named; all programs say which ones are expected."""
    bag = write_bag(tmp_path / "bag", turning(np.full(50, 0.3)), odometry=True, rates=rates)
    assert_refused(bag, rf"/cf(7|231)/gyro has {found} values; expected gyro\.x, gyro\.y, gyro\.z$", tmp_path, capsys)


def test_bags_with_numbers_that_are_none_are_refused(tmp_path: Path, capsys) -> None:
    def later(seconds: float, *drones: str | None) -> list[Record]:
        return [{**one, "t": one["t"] + seconds * (one.get("drone") in drones)} for one in turn]

    turn = turning(np.full(50, 0.3))
    sent = [{**one, "sent": one["sent"] * np.nan} if "sent" in one else one for one in turn]
    bags = {
        "no order": (
            sent,
            r"setpoint of cf(7|231) has 0 good rows of 50; expected two or more, of finite numbers",
        ),
        "one state": (
            [*turn[:2], *turn[2::3]],
            r"position of cf(7|231) has 1 good rows of 1; expected two or more, of finite",
        ),
        "late": (
            later(9, "leader", "follower"),
            r"of cf(7|231) begins at 9\.0 s, .* ends at 0\.5 s; expected them to ov",
        ),
        "late pair": (
            later(9, "follower"),
            r"of cf231 begins at 9\.0 s, .* of cf7 ends at 0\.5 s; expected them to ov",
        ),
    }
    for name, (records, reason) in bags.items():
        assert_refused(write_bag(tmp_path / name, records, odometry=True), reason, tmp_path, capsys)


def assert_refused(path: Path, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All that reads a recording says the one sentence `reason`, a regular expression, and writes nothing."""
    for main, arguments in (
        (export, [path, tmp_path / "drawn"]),
        (identify.main, [path, "--out", tmp_path / "drawn.json"]),
        (export, [path, tmp_path / "drawn.csv"]),
    ):
        assert call(main, arguments) == 2, path
        errors = capsys.readouterr().err
        assert re.search(reason, errors.strip()), errors
        assert_one_line(errors)
    assert not list(tmp_path.glob("drawn*"))


def test_pipes_and_second_recordings_are_refused(records: list[Record], tmp_path: Path, capsys) -> None:
    pipe, twice = tmp_path / "pipe", tmp_path / "twice"
    write_bag(pipe, records)
    os.mkfifo(pipe / "more.mcap")
    assert_refused(pipe, "more.mcap is no regular file", tmp_path, capsys)
    write_cfclient(twice, records, {"leader": 3.0, "follower": 77.0})
    first = next((twice / "leader").glob("*.csv"))
    shutil.copy(first, first.with_name("again.csv"))
    assert_refused(twice, "in another file of", tmp_path, capsys)


def moved(record: Record) -> DroneState:
    """The state in `record`, a leader's far to the left."""
    state = record["raw"].state
    return state._replace(position=state.position + (np.array([4.0, 0, 0]) if record["drone"] == "leader" else 0))


def unturned(record: Record) -> DroneState:
    """The state in `record` with the attitude of a tracker that sees nothing."""
    return record["raw"].state._replace(quaternion=np.zeros(4))


def bag_of_nothing() -> bytes:
    """An MCAP file of ROS 2 that is whole and holds nothing."""
    import io

    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2")
    writer.finish()
    return stream.getvalue()


def test_a_type_of_the_same_name_with_other_fields(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "mjxball_msgs/msg/Setpoint"
    store.register(get_types_from_msg("float64 roll\nfloat64 pitch", kind))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        channel = writer.add_connection("/leader/setpoint", kind, typestore=store)
        writer.write(channel, 10**9, store.serialize_cdr(store.types[kind](1.0, 2.0), kind))
    with pytest.raises(InputError, match=r"Setpoint of /leader/setpoint has another definition .* 'header'"):
        list(flight_log.read(tmp_path / "bag"))
