"""The flight log: its schema is what is written, its one reader refuses or tolerates, a killed writer loses nothing."""

from __future__ import annotations

import ast
import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY, assert_one_line, call, environment
from fly_virtual import VirtualTwin, log_header
from wire import pack_state

import onboard as benchmark
from mjxball import config as configs
from mjxball.control.crazyflie import gains_to_json, pair_gains
from mjxball.control.rotations import turned_about_z
from mjxball.errors import InputError
from mjxball.policy import Policy
from mjxfly import packets, recording
from mjxfly.flight_log import STREAMS, Journal, Tail, read
from mjxfly.limits import FlightSettings
from mjxfly.log import main as draw
from mjxfly.log_schema import KINDS, SCHEMA
from mjxfly.packets import DroneState
from mjxfly.policy_setup import mount_angle
from mjxfly.recording import SILENCE, load, read_recording
from mjxfly.rig import identify
from mjxfly.view.main import main as view

PRESET = configs.preset("flight")
HEADER = {"policy": "nobody", "config": configs.to_dict(PRESET), "gains": gains_to_json(pair_gains(PRESET.autopilot))}
ZEROS = [[0.0] * 4] * 2


def packet(state: DroneState, stamp: int = 0) -> str:
    """The field `raw` of a state."""
    return (b"\x01" + stamp.to_bytes(3, "little") + pack_state(state)).hex()


def drone(x: float, rates: float = 0.0) -> DroneState:
    return DroneState(np.array([x, 0, 0]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.full(3, rates), 3, 3.9)


def write(path: Path, seconds: float = 2.0, **header: Any) -> list[bytes]:
    """A log of a second of ramp and `seconds` under both controllers, every state another; its lines."""
    with Journal(path, **{**HEADER, **header}) as log:
        for number in range(round(100 * (1 + seconds))):
            for name, x in (("leader", 0.15), ("follower", -0.15)):
                log.note("state", number / 100, drone=name, raw=packet(drone(x, 0.001 * number), 10 * number))
            phase = "ramp" if number < 100 else "fly"
            log.note("tick", number / 100 + 0.001, state=phase, goal=(0, 0, 0.4), sent=[[0.0, 0.0, 0.0, 46000]] * 2)
        log.note("end", code=0)
    return path.read_bytes().splitlines(keepends=True)


def test_what_is_noted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    state = DroneState(
        np.array([0.1, -2, 3]), np.array([1, 0, 0.5]), np.array([1.0, 0, 0, 0]), np.array([0.1, 0.2, 0.3]), 25, 3.71
    )
    with Journal(path, **HEADER) as log:
        log.note(
            "tick", 1.25, state="fly", goal=np.array([0.1, 0, 1 / 3]), sent=(packets.ZERO,) * 2, ages=[0.01, np.inf]
        )
        log.note("state", 1.5, drone="follower", raw=packet(state, 0xABCDEF))
    header, tick, seen = read(path)
    assert (header["schema"], header["policy"], header["config"]) == (SCHEMA, "nobody", PRESET)
    assert header["gains"] == pair_gains(PRESET.autopilot)
    assert (tick["t"], tick["kind"], tick["state"]) == (1.25, "tick", "fly")
    np.testing.assert_array_equal(tick["goal"], [0.1, 0, 1 / 3])
    np.testing.assert_array_equal(tick["sent"], np.zeros((2, 4)))
    np.testing.assert_array_equal(tick["ages"], [0.01, np.inf])
    assert (seen["drone"], seen["raw"].stamp, seen["raw"].state.info) == ("follower", 0xABCDEF, 25)
    np.testing.assert_allclose(
        recording.numbers(seen["raw"].state), recording.numbers(state), atol=1e-9
    )  # whole millimetres and milliradians
    assert seen["raw"].state.battery == pytest.approx(3.71)


def note_calls() -> list[tuple[str, str, set[str], bool]]:
    """(place, kind, fields, whether there may be more) of every record that the package writes, by its syntax."""
    found = []
    for path in sorted((REPOSITORY / "mjxfly").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or not isinstance(node.func, (ast.Attribute, ast.Name)):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
            if name not in ("note", "_note") or not (node.args and isinstance(node.args[0], ast.Constant)):
                continue
            fields = {one.arg for one in node.keywords if one.arg} - {"t"}
            place = f"{path.relative_to(REPOSITORY)}:{node.lineno}"
            found.append((place, node.args[0].value, fields, any(one.arg is None for one in node.keywords)))
    return found


def test_the_package_writes_what_the_schema_says() -> None:
    """A record that the table lacks is one line to add there; a kind that nobody writes is one to take away."""
    calls = note_calls()
    assert len(calls) > 10
    for place, kind, fields, more in calls:
        assert kind in KINDS, f"{place}: add {kind!r} to log_schema.KINDS"
        known = KINDS[kind].fields
        assert fields <= known.keys(), f"{place}: add {fields - known.keys()} to {kind!r} in log_schema.KINDS"
        missing = {name for name, field in known.items() if field.required} - fields
        assert more or not missing, f"{place}: {kind!r} lacks {missing}"
    assert KINDS.keys() == {kind for _, kind, _, _ in calls}


def test_the_state_of_a_gru_is_recorded(tmp_path: Path) -> None:
    """Tick by tick what the policy remembers after the observation beside it, to the log's decimals."""
    contents = benchmark.recurrent()
    # It moves nothing, and what it remembers follows the flight.
    contents = dataclasses.replace(contents, weights=(*contents.weights[:-1], 0 * contents.weights[-1]))
    contents = dataclasses.replace(contents, biases=(*contents.biases[:-1], 0 * contents.biases[-1]))
    path = tmp_path / "flight.jsonl"
    with Journal(path, **log_header(contents)) as log:
        assert VirtualTwin(FlightSettings(seconds=3.0), contents=contents, log=log).run() == "done"
        log.note("end", code=0)
    recording, policy = read_recording(path), Policy(contents, "again")
    angle = mount_angle(contents.metadata)
    guided = np.isfinite(recording.observation).all(axis=1)
    assert guided.sum() > 100
    assert np.isnan(recording.hidden[~guided]).all()
    remembered = []
    for seen in recording.observation[guided]:
        policy(turned_about_z(seen, -angle))
        assert policy.hidden is not None
        remembered.append(policy.hidden)
    assert recording.hidden.shape[1] == contents.metadata["recurrent_units"] == len(remembered[0])
    np.testing.assert_allclose(recording.hidden[guided], remembered, atol=2e-4)
    assert np.std(remembered, axis=0).max() > 0.01


def test_a_log_is_read_whatever_its_length(tmp_path: Path) -> None:
    """Cut anywhere: the whole records before the cut, or one sentence; the flight in it, or one sentence."""
    path = tmp_path / "flight.jsonl"
    lines = write(path)
    first, whole = len(lines[0]), b"".join(lines)
    half, last = len(whole) // 2, len(whole) - len(lines[-1])
    for length in (0, 1, first - 1, first, first + 9, *range(half, half + 100, 7), *range(last, last + 30, 4)):
        path.write_bytes(whole[:length])
        if length < first:
            with pytest.raises(InputError, match=r"ends within its header|is empty"):
                list(read(path))
            continue
        remarks: list[str] = []
        assert len(list(read(path, remarks.append))) == whole[:length].count(b"\n")
        assert remarks == ([] if whole[length - 1 : length] == b"\n" else ["its last line is cut short"])
        if length < half:
            with pytest.raises(InputError, match="holds no flight"):
                load(path)
        else:
            assert any("it has no end" in remark for remark in load(path).remarks)


DAMAGE = (
    b"\x00\xff\xfe", b"", b"{}", b"[1]", b"null", b'{"t": 1}', b"[" * 100_000, b'{"t": 1, "kind": "tick"}',
    b'{"t": NaN, "kind": "end", "code": 0}', b'{"t": 1, "kind": "state", "drone": 7, "raw": "00"}',
    b'{"t": 1, "kind": "state", "drone": "leader", "raw": "00"}',
)  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_lines_that_are_no_records_are_left_out_and_told(tmp_path: Path, damage: bytes) -> None:
    path, remarks = tmp_path / "flight.jsonl", []
    lines = write(path)
    path.write_bytes(b"".join([lines[0], damage + b"\n", *lines[1:]]))
    assert len(list(read(path, remarks.append))) == len(lines)
    assert len(remarks) == 1
    assert remarks[0].startswith("line 2 is damaged: ")
    assert load(path).remarks == tuple(f"{path.name}: {remark}" for remark in remarks)


def test_what_newer_programs_add_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    with Journal(path, **HEADER, more=1) as log:
        log.note("pose of the moon", anything={"x": 1})
        log.note("link", drone="leader", text="gone", since=[1, 2])
    header, link = read(path)
    assert header["more"] == 1
    assert link["since"] == [1, 2]


def test_a_tail_gives_each_record_once(tmp_path: Path) -> None:
    whole, path = tmp_path / "whole.jsonl", tmp_path / "flight.jsonl"
    text = b"".join(write(whole, 0.2))
    tail, found = Tail(path), []
    assert tail.read() is None
    with path.open("ab", buffering=0) as stream:
        for start in range(0, len(text), 777):
            stream.write(text[start : start + 777])
            found += tail.read() or []
            assert tail.read() is None
    tail.close()
    assert [(one["t"], one["kind"]) for one in found] == [(one["t"], one["kind"]) for one in read(whole)]


def changed(**fields: Any) -> Callable[[list[bytes]], list[bytes]]:
    """The log with another header."""
    return lambda lines: [json.dumps({**json.loads(lines[0]), **fields}).encode() + b"\n", *lines[1:]]


def without(*kinds: str) -> Callable[[list[bytes]], list[bytes]]:
    return lambda lines: [line for line in lines if json.loads(line)["kind"] not in kinds]


def shifted(after: float, by: float) -> Callable[[list[bytes]], list[bytes]]:
    """The log whose clock jumps by `by` at the time `after`."""

    def change(lines: list[bytes]) -> list[bytes]:
        found = [json.loads(line) for line in lines]
        late = [{**one, "t": one["t"] + by * (one["t"] > after and one["kind"] in STREAMS)} for one in found]
        return [json.dumps(one).encode() + b"\n" for one in late]

    return change


OLD = {**HEADER, "t": 0.0, "kind": "header", "format": 1}
REFUSED: dict[str, tuple[Callable[[list[bytes]], list[bytes]], str]] = {
    "newer": (changed(schema=SCHEMA + 1), f"has schema version {SCHEMA + 1}, this mjxball reads {SCHEMA}"),
    "older": (lambda lines: [json.dumps(OLD).encode() + b"\n", *lines[1:]], "has schema version 1, this mjxball"),
    "odd version": (changed(schema="two"), 'has schema version "two", this mjxball'),
    "empty": (lambda lines: [], "it is empty"),
    "text": (lambda lines: [b"nothing\n"], "does not begin with a header"),
    "bytes": (lambda lines: [b"PK\x03\x04\n\x00"], "does not begin with a header"),
    "a long line": (lambda lines: [b"x" * (3 << 20)], "line of more than 1 MiB"),
    "no header": (lambda lines: lines[1:], "does not begin with a header"),
    "cut in the header": (lambda lines: [lines[0][:70]], "ends within its header"),
    "cut before take-off": (lambda lines: [*lines[:2], lines[2][:9]], "holds no flight: no setpoint"),
    "no config": (changed(config={}), "the config of its header"),
    "odd config": (changed(config=3), "the config of its header"),
    "odd gains": (changed(gains=["x"]), "the gains of its header"),
    "no time": (changed(t="now"), "the t of its header"),
    "never flew": (without("tick"), "no setpoint in it turns a motor"),
    "no states": (without("state"), "no state of the leader"),
    "a clock that jumps back": (shifted(1.2, -0.3), "the time goes back by 0.29 s in its tick: cut it there"),
    "a clock that jumps back by a lot": (shifted(1.2, -3.0), "the time goes back by 2.99 s in its tick"),
    "two logs in one": (lambda lines: [*lines, *lines], "begins another log: cut it there"),
    "a dry run": (changed(settings={"dry_run": True}), "a dry run"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_every_program_refuses_in_the_same_sentence(name: str, tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "flight.jsonl"
    damage, reason = REFUSED[name]
    path.write_bytes(b"".join(damage(write(tmp_path / "whole.jsonl", 0.5))))
    said = []
    for main, arguments in (
        (draw, [path, tmp_path / "figures"]),
        (view, [path, "--out", tmp_path / "page.html"]),
        (identify.main, [path, "--out", tmp_path / "plant.json"]),
    ):
        assert call(main, arguments) == 2
        captured = capsys.readouterr()
        assert_one_line(captured.err)
        said.append(captured.err.partition(": ")[2])
    assert reason in said[0]
    assert len(set(said)) == 1, said
    assert {one.name for one in tmp_path.iterdir()} == {"flight.jsonl", "whole.jsonl"}


def test_gaps_and_frozen_estimates_are_told(tmp_path: Path) -> None:
    """Half a second of one drone lost, 0.6 s of the other repeated with fresh stamps; to rest in the ramp is sound."""
    path = tmp_path / "flight.jsonl"
    lines, kept = write(path, 3.0), []
    for line in lines:
        record = json.loads(line)
        if record["kind"] == "state" and record["drone"] == "leader" and 1.5 <= record["t"] < 1.995:
            continue
        if record["kind"] == "state" and record["drone"] == "follower" and 2.2 < record["t"] <= 2.795:
            record["raw"] = packet(drone(-0.15, 0.22), round(1000 * record["t"]))
        if record["kind"] == "state" and record["t"] < 0.9:
            record["raw"] = packet(drone(0.15 if record["drone"] == "leader" else -0.15), round(1000 * record["t"]))
        kept.append(json.dumps(record) + "\n")
    path.write_text("".join(kept))
    log = load(path)
    silent, frozen = log.outages
    assert (silent.drone, silent.frozen, frozen.drone, frozen.frozen) == ("leader", False, "follower", True)
    assert (silent.begin, silent.end) == pytest.approx((1.49, 2.0))  # between the states at either side
    assert (frozen.begin, frozen.end) == pytest.approx((2.2, 2.79))
    for remark, known in zip(log.remarks, ("no state of the leader for 0.51 s", "frozen for 0.59 s"), strict=True):
        assert known in remark
    assert silent.end - silent.begin > SILENCE
    assert recording.outages("leader", np.arange(9) * 0.01, np.arange(9)[:, None], 1.0)[0].end == 1.0  # to the end


def test_records_that_stand_twice_count_once_and_are_told(tmp_path: Path) -> None:
    lines = write(tmp_path / "whole.jsonl", 0.5)
    path = tmp_path / "twice.jsonl"
    path.write_bytes(b"".join([*lines[:40], *lines[37:40], *lines[40:]]))  # both states and the tick of one moment
    whole, found = load(tmp_path / "whole.jsonl"), load(path)
    assert [(one["kind"], one["t"]) for one in found.records] == [(one["kind"], one["t"]) for one in whole.records]
    assert whole.remarks == ()
    (remark,) = found.remarks
    assert "a time stands twice" in remark
    assert "2 more" in remark


def test_missing_ticks_and_another_rate_are_told(tmp_path: Path) -> None:
    lines = write(tmp_path / "whole.jsonl", 1.0)
    holey = [line for line in lines if not (b'"tick"' in line and 1.2 < json.loads(line)["t"] < 1.5)]
    path = tmp_path / "holey.jsonl"
    path.write_bytes(b"".join(holey))
    (remark,) = load(path).remarks
    assert "nothing for 0.31 s from 1.19 s on" in remark  # ticks at 1.191 and 1.501 s
    every = [json.loads(line) for line in lines]
    slow = [{**one, "t": one["t"] * (3.0 if one["kind"] in STREAMS else 1.0)} for one in every]
    path = tmp_path / "slow.jsonl"
    path.write_text("".join(json.dumps(one) + "\n" for one in slow))
    (remark,) = load(path).remarks
    assert "30 ms apart, and the policy's are 10 ms" in remark


def test_it_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        Journal(path)
    assert path.read_text() == "mine"


def test_without_a_file_nothing_is_kept() -> None:
    with Journal(None) as log:
        log.note("tick")
    assert log.failure is None


SCRIPT = """
import json, sys, time
from pathlib import Path
from mjxfly.flight_log import Journal
log = Journal(Path(sys.argv[1]), policy="nobody", config=json.loads(sys.argv[2]), gains={})
number = 0
while True:
    log.note("warning", text="x" * 500, number=number)
    number += 1
    if number == 50:
        print("go", flush=True)
    time.sleep(0.001)
"""


@pytest.mark.slow
def test_it_is_readable_after_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    command = [sys.executable, "-c", SCRIPT, path, json.dumps(HEADER["config"])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment()) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"go\n"
        time.sleep(0.3)
        writer.kill()
    numbers = [record["number"] for record in read(path) if record["kind"] == "warning"]
    assert numbers == list(range(len(numbers)))  # none is missing in between
    assert len(numbers) >= 50


def test_a_full_disk_does_not_end_the_flight() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    log = Journal(None)
    log._stream = full.open("w", encoding="utf-8")
    log.note("tick")
    log.close()
    assert log.failure
