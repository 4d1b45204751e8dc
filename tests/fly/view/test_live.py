"""The live view: a log that grows under an open page, one that is not there yet, one that is none; who may ask."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY, TRANSPORT, assert_one_line, call, environment
from conftest import opened
from fly_policies import untrained
from fly_virtual import VirtualTwin, log_header

from mjxball.view.page import flight_page
from mjxfly.display import live_view
from mjxfly.flight_log import Journal
from mjxfly.limits import FlightSettings
from mjxfly.main import main as fly
from mjxfly.recording import read_recording
from mjxfly.supervisor import FlightState
from mjxfly.twin.physics import make_pair
from mjxfly.view.live import LiveView, Server
from mjxfly.view.live_log import COLUMNS, STEP, LiveLog, columns
from mjxfly.view.main import main
from mjxfly.view.recorded import read_log

LIMIT = 20.0  # [s] that anything may take here on a busy machine


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """The lines of a log of 2 s of free flight in virtual time, as the runner writes it."""
    path, contents = tmp_path_factory.mktemp("log") / "flight.jsonl", untrained("flight")
    with Journal(path, **log_header(contents)) as notes:
        settings = FlightSettings(seconds=2.0, goal=(0.1, 0.0, 0.4))
        world = VirtualTwin(settings, contents=contents, physics=make_pair(contents.metadata), log=notes)
        world.fly_until(FlightState.DONE)
        notes.note("end", code=0)
    return path.read_bytes().splitlines(keepends=True)


def read_all(path: Path) -> LiveLog:
    with contextlib.closing(LiveLog(path)) as log:
        while log.update():
            pass
    return log


def test_rows_are_the_recording(lines: list[bytes], tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"".join(lines))
    log, recording = read_all(path), read_recording(path)
    shown = {name: values.reshape(len(log.rows), -1) for name, values in columns(log.rows).items()}
    time = shown["time"][:, 0]
    assert (log.status.ended, log.status.text, log.status.level) == (
        True,
        "the flight has ended, exit code 0: time up",
        "good",
    )
    np.testing.assert_allclose(np.diff(time), STEP, atol=2e-3)
    # A recording counts from where the motors turned, the view from the first tick.
    first = [json.loads(line)["t"] for line in lines if b'"tick"' in line]
    turned = first[-1] - first[0] - recording.time[-1]
    rows = np.searchsorted(recording.time + turned, time[time > turned + 0.005] - 2e-3)
    for name, wanted in (
        ("position", recording.position),
        ("quaternion", recording.quaternion),
        ("target", recording.target),
        ("thrust", recording.rotor_force.sum(axis=-1)),
        ("follower_command", np.nan_to_num(recording.follower)),
    ):
        np.testing.assert_allclose(shown[name][time > turned + 0.005], wanted[rows], atol=1e-6)  # float32


def test_a_recorded_log_has_the_marks_of_the_live_view(lines: list[bytes], browser: Any, tmp_path: Path) -> None:
    """Counted from where the motors turned, in which phase a recording begins; a good end is green in both."""
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"".join(lines))
    live, recorded = read_all(path).marks, read_log(path)
    assert recorded.marks[0].time == pytest.approx(0.0, abs=1e-6)
    assert [mark[1:] for mark in recorded.marks] == [mark[1:] for mark in live[-len(recorded.marks) :]]
    assert [mark.text for mark in recorded.marks[:-1]] == ["spin", "ramp", "fly", "land", "stop", "done"]
    shifts = [old.time - new.time for old, new in zip(live[-6:-2], recorded.marks[-6:-2], strict=True)]
    np.testing.assert_allclose(shifts, shifts[0], atol=1e-9)
    fly = next(mark for mark in recorded.marks if mark.text == "fly")
    phases = np.array(read_recording(path).phase)
    assert fly.time == pytest.approx(recorded["time"][np.argmax(phases == "fly")], abs=0.011)  # a tick
    page = tmp_path / "page.html"
    page.write_text(flight_page(recorded), encoding="utf-8")
    tab = opened(browser, page, 400)
    assert [mark.text_content() for mark in tab.locator(".marks .phase").all()] == [m.text for m in recorded.marks[:-1]]
    assert tab.locator(".marks .fault").count() == 0
    green = "getComputedStyle(document.querySelector('.marks .end')).backgroundColor === colour('good')"
    assert tab.evaluate(green)
    tab.locator(".marks .phase", has_text="fly").click()
    assert tab.evaluate("player.now") == pytest.approx(fly.time)
    assert tab.inner_text(".now-phase") == "fly"
    tab.close()


def test_a_fault_is_marked_where_it_happened(lines: list[bytes], browser: Any, tmp_path: Path) -> None:
    records = [json.loads(line) for line in lines]
    flying = [number for number, one in enumerate(records) if one.get("state") == "fly"]
    now = records[flying[len(flying) // 2]]["t"]
    fault = {"t": now, "kind": "transition", "before": "fly", "after": "hold", "events": ["STALE: <b>follower</b>"]}
    back = {"t": now + 0.1, "kind": "transition", "before": "hold", "after": "fly", "events": ["RESUMED"]}
    end = {**records[-1], "code": 1}
    path = tmp_path / "log.jsonl"
    path.write_text(
        "".join(json.dumps(one) + "\n" for one in [*records[: flying[-1]], fault, back, *records[flying[-1] : -1], end])
    )
    live, shown = read_all(path), read_log(path)
    start = next(one["t"] for one in records if one["kind"] == "tick")
    (mark,) = [one for one in live.marks if one.kind == "fault"]
    assert (mark.time, mark.text) == (pytest.approx(now - start), "stale: <b>follower</b>")
    assert live.status.level == live.marks[-1].level == "bad"
    assert [one.text for one in shown.marks if one.kind == "fault"] == [mark.text]
    page = tmp_path / "page.html"
    page.write_text(flight_page(shown), encoding="utf-8")
    tab = opened(browser, page, 1300)
    triangle = tab.locator(".marks .fault")
    assert triangle.get_attribute("title").endswith(f"s: {mark.text}")
    axis, place = tab.locator(".marks").bounding_box(), triangle.bounding_box()
    (own,) = [one.time for one in shown.marks if one.kind == "fault"]
    share = (place["x"] + place["width"] / 2 - axis["x"]) / axis["width"]
    assert share == pytest.approx(own / shown["time"][-1], abs=0.005)
    assert tab.locator(".marks .end.bad").count() == 1
    tab.close()


def test_a_clock_that_goes_back_is_told(lines: list[bytes], tmp_path: Path) -> None:
    path, records = tmp_path / "log.jsonl", [json.loads(line) for line in lines]
    middle = records[len(records) // 2]["t"]
    late = [{**one, "t": one["t"] - 3.0 * (one["t"] > middle)} for one in records]
    path.write_text("".join(json.dumps(one) + "\n" for one in late))
    log = read_all(path)
    assert log.status.level == "bad"
    assert "time goes back by" in log.status.text
    assert (np.diff([row[0] for row in log.rows]) > 0).all()


def test_a_log_in_pieces_gives_the_same_rows(lines: list[bytes], tmp_path: Path) -> None:
    """However a line is torn, it counts once it is whole; damaged ones in between do not count at all."""
    whole, pieces = tmp_path / "whole.jsonl", tmp_path / "pieces.jsonl"
    whole.write_bytes(b"".join(lines))
    log = LiveLog(pieces)
    assert not log.update()
    assert log.status.text == "waiting for pieces.jsonl"
    damaged = [b"{torn\n", b"[]\n", b'{"t": 1, "kind": "tick"}\n', b'{"t": 1, "kind": "state", "drone": 7}\n', b"\n"]
    text = b"".join([lines[0], *damaged, *lines[1:]])
    with pieces.open("ab", buffering=0) as stream:
        for start in range(0, len(text), 1777):
            stream.write(text[start : start + 1777])
            log.update()
            good = ("fly", "land: time up", "stop: time up", "done: time up")
            assert log.status.level == ("good" if log.status.text in good or log.status.ended else "busy")
    assert log.rows == read_all(whole).rows
    assert log.status.ended


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (b'{"t": 0.0, "kind": "tick"}\n', "does not begin with a header"),
        (b'{"t": 0.0, "kind": "header", "config": {}}\n', "has schema version"),
        (b"PK\x03\x04\n\x00", "does not begin with a header"),
        (b"x" * (3 << 20), "a line of more than 1 MiB"),
    ],
)
def test_what_is_no_log_is_refused(contents: bytes, message: str, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "log.jsonl").write_bytes(contents)
    assert call(main, ["--live", tmp_path / "log.jsonl"]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert message in errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["log.csv"], "is no flight (.npz), flight log (.jsonl)"),
        (["--live", "."], "is no file"),
        (["--live", "nowhere/log.jsonl"], "does not exist"),
        (["--live", "log.jsonl", "--port", "70000"], "--port must be"),
        (["--live", "log.jsonl", "--out", "page.html"], "--live writes no file"),
        (["--live", "log.jsonl", "--video", "out.gif"], "--live writes no file"),
        (["--live", "log.jsonl", "more.jsonl"], "--live follows one log"),
        (["log.jsonl", "--port", "8000"], "--port is the port of --live"),
        (["--live", "log.jsonl", "--port", "TAKEN"], "cannot be had"),
    ],
)
def test_refusals(arguments: list[str], message: str, tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("t,x\n")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert call(main, [port if argument == "TAKEN" else argument for argument in arguments]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert message in errors


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--view"], "it needs --log FILE"),
        (["--view", "70000", "--log", "new.jsonl"], "it needs --log FILE"),
        (["--view", "--log", "new.mcap"], "--view follows a log of JSON lines"),
        (["--foxglove", "0"], "goes with --view"),
    ],
)
def test_flying_with_a_view_needs_a_log_and_a_port(more: list[str], message: str, capsys: Any) -> None:
    pytest.importorskip("cflib")
    assert call(fly, [TRANSPORT, "--rehearse", *more]) == 2
    assert message in capsys.readouterr().err


@pytest.fixture
def server(lines: list[bytes], tmp_path: Path) -> Iterator[Server]:
    """Serves a log that has ended."""
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"".join(lines))
    view = LiveView(LiveLog(path))
    while view.update():
        pass
    result = Server(0, view)
    threading.Thread(target=result.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    yield result
    result.shutdown()
    result.server_close()


def test_a_second_viewer_on_one_port_is_refused(server: Server, tmp_path: Path, capsys: Any) -> None:
    assert call(main, ["--live", tmp_path / "log.jsonl", "--port", server.server_port]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert f"port {server.server_port} cannot be had" in errors
    assert asked(server, "/")[0] == 200


def asked(server: Server, path: str, method: str = "GET", host: str | None = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=LIMIT)
    connection.request(method, path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_this_machine_alone_is_served(server: Server) -> None:
    assert server.socket.getsockname()[0] == "127.0.0.1"
    with socket.socket() as other:  # another of this machine's addresses: nobody listens
        other.settimeout(LIMIT)
        assert other.connect_ex(("127.0.0.2", server.server_port)) != 0
    assert asked(server, "/")[0] == 200
    for host in ("evil.example", f"evil.example:{server.server_port}", "127.0.0.1"):
        assert asked(server, "/", host=host)[0] == 403


def test_nothing_but_the_page_and_its_rows_is_served(server: Server) -> None:
    rows = f"/rows?token={server.view.token}&after="
    for path, code in (
        ("/log.jsonl", 404),
        ("/../../etc/passwd", 404),
        ("/rows", 409),
        ("/rows?token=guessed&after=0", 409),
        (rows, 400),
        (rows + "-1", 400),
        (rows + "1e3", 400),
        (rows + "9" * 30, 400),
    ):
        assert asked(server, path)[0] == code, path
    assert asked(server, "/", "POST")[0] == 501
    code, body = asked(server, rows + "3")
    answer = json.loads(body)
    assert (code, answer["ended"], answer["rows"]) == (200, True, answer["total"] - 3)
    assert set(answer["arrays"]) == set(COLUMNS)
    assert json.loads(asked(server, rows + "999999")[1])["rows"] == 0


def started(path: Path) -> tuple[subprocess.Popen, str]:
    """The command, and its page's address."""
    command = [sys.executable, "-m", "mjxfly.view", "--live", str(path)]
    surroundings, pipe = {**environment(), "PYTHONPATH": str(REPOSITORY)}, subprocess.PIPE
    process = subprocess.Popen(command, env=surroundings, text=True, stdout=pipe, stderr=pipe)
    line = process.stdout.readline()
    found = re.fullmatch(r"the live view is at (http://127\.0\.0\.1:\d+/), and waits for (.*)\n", line)
    assert found, line + process.stderr.read()
    assert found[2] == str(path)
    return process, found[1]


def test_a_page_follows_a_log(lines: list[bytes], browser: Any, tmp_path: Path) -> None:
    """From before there is a log to its end; whoever looks back is left alone; Ctrl-C ends the command."""
    path, errors, hosts = tmp_path / "log.jsonl", [], set()
    process, address = started(path)
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    tab.set_default_timeout(1000 * LIMIT)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("request", lambda request: hosts.add(re.sub(r"(?<=\w/).*", "", request.url)))

    def shows(status: str) -> None:
        tab.wait_for_function("text => document.getElementById('status').textContent.includes(text)", arg=status)

    def newest(written: list[bytes]) -> float:
        """What `player.now` should be."""
        ticks = [json.loads(line)["t"] for line in written if b'"kind": "tick"' in line]
        return ticks[-1] - ticks[0]

    try:
        tab.goto(address)
        shows("waiting for log.jsonl")
        with path.open("ab", buffering=0) as stream:
            stream.write(lines[0])
            shows("connecting and checking")
            flying = [i for i, line in enumerate(lines) if b'"state": "fly"' in line]
            half = flying[len(flying) // 2]  # the log pauses in the middle of free flight
            stream.write(b"".join(lines[1:half]) + lines[half][:40])
            tab.wait_for_function("time => player && player.now > time", arg=newest(lines[:half]) - 1.5 * STEP)
            assert float(tab.inner_text("#time").split()[0]) <= newest(lines[:half]) + 0.005
            shows("fly")
            shows("nothing new for")
            tab.evaluate("player.seek(0.5)")
            stream.write(lines[half][40:] + b"".join(lines[half + 1 :]))
        shows("the flight has ended, exit code 0: time up")
        assert tab.inner_text("#time") == "0.50 s"
        live = [mark.inner_text() for mark in tab.locator(".marks .phase").all()]
        assert live[-5:] == ["ramp", "fly", "land", "stop", "done"]
        assert tab.locator(".marks .end.good").get_attribute("title").endswith("exit code 0: time up")
        tab.click("#newest")
        assert tab.evaluate("player.now") == pytest.approx(newest(lines), abs=1.5 * STEP)
        assert {"Battery [V]", "Lateness of the loop [ms]"} <= set(tab.locator(".plot h3").all_inner_texts())
        assert not tab.is_visible(".now-cg")  # nobody measures it
        assert "exit code 0: time up" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT) == 0
        assert process.stderr.read() == ""
        assert errors == []
        assert hosts <= {address, "data:,"}
    finally:
        tab.close()
        process.kill()
        process.communicate()


def test_a_log_that_turns_out_to_be_none(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    process, _ = started(path)
    path.write_text("nothing\n")
    _, errors = process.communicate(timeout=LIMIT)
    assert process.returncode == 2
    assert_one_line(errors)
    assert "does not begin with a header" in errors


def test_a_flight_starts_and_ends_its_view(
    lines: list[bytes], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A view that cannot have its port says so itself, and no flight begins."""
    path = tmp_path / "log.jsonl"
    with live_view(path) as page_process:
        address = re.fullmatch(r"the live view is at (http://127\.0\.0\.1:(\d+)/), and waits for .*", page_process.line)
        path.write_bytes(b"".join(lines))
        with urllib.request.urlopen(address[1], timeout=LIMIT) as page:
            assert page.status == 200
        with pytest.raises(SystemExit) as ended:
            live_view(path, int(address[2]))
        assert ended.value.code == 2
        errors = capfd.readouterr().err
        assert_one_line(errors)
        assert address[2] in errors
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", int(address[2])), LIMIT)


def test_a_feed_outlives_what_is_not_finite(lines: list[bytes], tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    ticks = [json.loads(line) for line in lines if b'"kind": "tick"' in line]
    bad = {**ticks[-1], "t": ticks[-1]["t"] + 1, "goal": [float("nan")] * 3}
    path.write_bytes(b"".join(lines[:-1]) + json.dumps(bad).encode() + b"\n")
    before = len(read_all(path).rows)
    path.write_bytes(b"".join(lines[:-1]))
    assert len(read_all(path).rows) == before > 10


def test_a_fault_is_told(lines: list[bytes], tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    fault = {"t": 1.0, "kind": "transition", "before": "fly", "after": "descend", "events": ["FENCE: leader left"]}
    path.write_bytes(lines[0] + json.dumps(fault).encode() + b"\n")
    log = read_all(path)
    assert (log.status.text, log.status.level, log.status.ended) == ("descend: fence: leader left", "bad", False)
