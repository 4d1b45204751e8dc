"""The command line: refusals, a rehearsal from end to end, a dry run, and Ctrl-C."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest
from command_line import REPOSITORY, TRANSPORT, assert_one_line, call, environment, run
from conftest import too_busy
from tables import rows

from mjxfly import flight_log
from mjxfly.main import main

pytest.importorskip("cflib")
URIS = ("--leader", "udp://127.0.0.1:19850", "--follower", "udp://127.0.0.1:19851")
REFUSALS = [
    ([TRANSPORT], "--leader URI is needed"),
    ([TRANSPORT, "--leader", "udp://127.0.0.1:19850"], "--follower URI is needed"),
    ([TRANSPORT, "--leader", "udp://127.0.0.1:1", "--follower", "udp://127.0.0.1:1"], "same drone"),
    ([TRANSPORT, "--leader", "http://x", "--follower", "udp://127.0.0.1:1"], "no URI such as"),
    ([TRANSPORT, "--leader", "udp://127.0.0.1:99999", "--follower", "udp://127.0.0.1:1"], "no URI such as"),
    ([TRANSPORT, "--rehearse", "--leader", "radio://0/80/2M/E7E7E7E7E7"], "udp://127.0.0.1:PORT only"),
    (["nowhere.npz", *URIS], "does not exist"),
    ([TRANSPORT, *URIS, "--seconds", "-1"], "--seconds must be"),
    ([TRANSPORT, *URIS, "--seconds", "nan"], "--seconds: takes a number"),
    ([TRANSPORT, *URIS, "--hover", "70000"], "--hover must be"),
    ([TRANSPORT, *URIS, "--mass", "0"], "--mass must be"),
    ([TRANSPORT, *URIS, "--goal", "0", "0", "inf"], "--goal: takes a number"),
    ([TRANSPORT, *URIS, "--goal", "1.4", "0", "0.4"], "beyond the fence"),
    ([TRANSPORT, *URIS, "--log", TRANSPORT], "choose another name"),
    ([TRANSPORT, *URIS, "--log", "flight.parquet"], "must end in .jsonl or .mcap"),
    ([TRANSPORT, *URIS, "--log", "flight.MCAP"], "must end in .jsonl or .mcap"),
    ([TRANSPORT, *URIS, "--log", "/no/such/place/log.jsonl"], "does not exist"),
    ([TRANSPORT, *URIS, "--loss", "0.1"], "--loss is for --rehearse only"),
    ([TRANSPORT, *URIS, "--slow", "2"], "--slow is for --rehearse only"),
    ([TRANSPORT, "--rehearse", "--slow", "0.5"], "--slow must be 1 to 100"),
    ([TRANSPORT, "--rehearse", "--loss", "2"], "--loss must be 0 to 1"),
    ([TRANSPORT, "--rehearse", "--fault", "rain:leader@1"], "no KIND:DRONE@S"),
    ([TRANSPORT, "--rehearse", "--fault", "crash:both@1"], "no KIND:DRONE@S"),
    ([TRANSPORT, *URIS, "--battery", "9"], "--battery must be 2.5 to 4.2"),
    ([TRANSPORT, *URIS, "--gains", "/no/such/gains.json"], "does not exist"),
    ([TRANSPORT, *URIS, "--thrust", "guess"], "invalid choice"),
    ([], "FOLLOWER"),
]


@rows("arguments, reason", REFUSALS)
def test_refusals(arguments: list[object], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(main, arguments) == 2
    errors = capsys.readouterr().err
    assert reason in errors
    assert_one_line(errors)


@rows(
    ("text", "near"),
    [
        ("[1]", ""),
        ("{", ""),
        ('{"leader": {}}', ""),
        ('{"leader": {}, "follower": 1}', ""),
        ('{"leder": {}, "follower": {}}', "leader"),
        ('{"roll_kp": 6}', "pid_attitude.roll_kp"),
        ('{"pid_attitud.roll_kp": 6}', "pid_attitude.roll_kp"),
        ('{"a": 1}', ""),
        ('{"a.b": "x"}', ""),
        ('{"a.b": true}', ""),
        ('{"a.b": NaN}', ""),
    ],
)
def test_gain_files_that_are_none(text: str, near: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gains.json"
    path.write_text(text)
    assert call(main, [TRANSPORT, *URIS, "--gains", path]) == 2
    errors = capsys.readouterr().err
    assert str(path) in errors
    assert ("did you mean" in errors) == bool(near)
    assert near in errors


def test_an_install_that_cannot_write_mcap_is_refused(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """Found out by the process that writes it, it was a flight without a log."""
    for missing in ("mcap_ros2", "mcap.writer"):
        with monkeypatch.context() as changed:
            for name in [one for one in sys.modules if one.startswith("mcap")]:
                changed.delitem(sys.modules, name)
            changed.setitem(sys.modules, missing, None)
            assert call(main, [TRANSPORT, *URIS, "--log", "flight.mcap"]) == 2
            assert "pip install 'mjxball[fly]'" in capsys.readouterr().err


@pytest.mark.slow
def test_nothing_heavy_is_imported(tmp_path: Path) -> None:
    modules = [
        "main",
        "link",
        "session",
        "watchdog",
        "display",
        "rehearsal",
        "warm_up",
        "twin.server",
        "twin.physics",
        "process",
    ]
    imports = ", ".join(f"mjxfly.{name}" for name in modules)
    heavy = ("jax", "jaxlib", "mujoco", "flax", "brax", "cflib")
    script = f"import sys, {imports}; print([name for name in {heavy!r} if name in sys.modules])"
    done = run(["-c", f"import sys; sys.path.insert(0, {str(REPOSITORY)!r}); {script}"], tmp_path)
    assert done.stdout.strip() == "[]", done.stderr


def test_a_flight_has_one_clock() -> None:
    """Runner, watchdog and twin of a rehearsal slow down together."""
    others = {"clock.py", "flight_log.py", "log_export.py", "live.py", "mocap_child.py"}  # of files and cameras
    asked = {
        str(path.relative_to(REPOSITORY))
        for path in (REPOSITORY / "mjxfly").rglob("*.py")
        if path.name not in others and re.search(r"\btime\.(monotonic|perf_counter|sleep)\(", path.read_text("utf-8"))
    }
    assert asked == set()


class Ended(NamedTuple):
    """How a flight of the command line ended."""

    code: int
    out: str
    err: str
    records: list[dict]

    def states(self) -> list[str]:
        return [record["after"] for record in self.records if record["kind"] == "transition"]

    def ticks(self, state: str) -> list[dict]:
        return [record for record in self.records if record["kind"] == "tick" and record["state"] == state]


@pytest.mark.slow
def test_a_flight_with_no_name_for_its_log_gets_one(tmp_path: Path) -> None:
    """Refused here, since nobody answers; a rehearsal leaves no file behind that was not asked for."""
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for one in silent:
            one.bind(("127.0.0.1", 0))
        ports = [one.getsockname()[1] for one in silent]
    uris = ["--leader", f"udp://127.0.0.1:{ports[0]}", "--follower", f"udp://127.0.0.1:{ports[1]}"]
    done = run(["-m", "mjxfly", TRANSPORT, *uris], tmp_path)
    logs = list(tmp_path.iterdir())
    assert done.returncode == 2, done.stderr
    assert done.stdout.splitlines() == [
        f"{TRANSPORT.name} was made for another plant: two Crazyflies of 70 g fly it",
        f"log: {logs[0].name}",
    ]
    assert next(flight_log.read(logs[0]))["kind"] == "header"


KINDS = {
    "rehearsed": ["--seconds", "2", "--gains", "gains.json", "--loss", "0.1", "--delay", "0.01", "--jitter", "0.005"],
    "dry": ["--seconds", "1", "--dry-run", "--fault", "sag:leader@0"],  # which waits for a motor to turn
    "interrupted": ["--seconds", "60"],
    "terminated": ["--seconds", "60", "--thrust", "paper", "--hover", "47000"],
}
SIGNALS = {"interrupted": signal.SIGINT, "terminated": signal.SIGTERM}


def started(name: str, place: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "mjxfly", TRANSPORT, "--rehearse", "--log", f"{name}.jsonl", *KINDS[name]]
    surroundings = {**environment(), "PYTHONPATH": str(REPOSITORY)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([str(part) for part in command], cwd=place, env=surroundings, text=True, **pipes)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ended]:
    """Four flights, two at a time, each with a twin of its own: rehearsed with gains, dry, interrupted, terminated."""
    place = tmp_path_factory.mktemp("flights")
    gains = {"pid_attitude.roll_kp": 4.5, "pid_rate.roll_kd": 3.0}
    (place / "gains.json").write_text(json.dumps({"leader": gains, "follower": {**gains, "pid_rate.roll_ki": 0.0}}))
    ended = {}
    for names in (("rehearsed", "interrupted"), ("dry", "terminated")):
        running = {name: started(name, place) for name in names}
        try:
            for name in names:
                log, process = place / f"{name}.jsonl", running[name]
                if name in SIGNALS and reaches(log, "fly", process):
                    process.send_signal(SIGNALS[name])
            for name, process in running.items():
                out, err = process.communicate(timeout=60)
                ended[name] = Ended(process.returncode, out, err, list(flight_log.read(place / f"{name}.jsonl")))
                landed(ended[name])
        finally:
            for process in running.values():
                process.kill()
                process.communicate()
    return ended


def reaches(log: Path, state: str, process: subprocess.Popen) -> bool:
    """True once the log says that `state` was entered, false if the flight ends before."""
    while process.poll() is None:
        if log.exists() and f'"after": "{state}"' in log.read_text(encoding="utf-8"):
            return True
        time.sleep(0.05)
    return False


def landed(flight: Ended) -> None:
    """The flight must have ended safely; a machine too busy to fly it, which rightly aborts, tries all again."""
    assert flight.err == ""
    assert flight.states()[-2:] == ["stop", "done"]
    assert not flight.ticks("done")[-1]["sent"].any()
    events = {event.split(":")[0] for record in flight.records for event in record.get("events", [])}
    if events & {"DEADLINES", "STALE", "REFUSED"}:
        too_busy(f"{sorted(events)}")


NORMAL = ["arm", "spin", "ramp", "fly", "land", "stop", "done"]


@pytest.mark.alone
def test_a_rehearsal(flights: dict[str, Ended]) -> None:
    flight = flights["rehearsed"]
    assert (flight.code, flight.states()) == (0, NORMAL), flight.out
    parameters = [record for record in flight.records if record["kind"] == "parameter"]
    written = {(record["drone"], record["name"]): record["value"] for record in parameters}
    for drone in ("leader", "follower"):
        assert written[drone, "pid_attitude.roll_kp"] == 4.5
        assert written[drone, "pid_rate.roll_kd"] == 3.0
    assert [drone for drone, name in written if name == "pid_rate.roll_ki"] == ["follower"]
    ticks = flight.ticks("fly")
    first, last = ticks[0]["t"], ticks[-1]["t"]
    came = sum(record["kind"] == "state" and first < record["t"] < last for record in flight.records)
    assert 0.8 < came / (2 * len(ticks)) < 0.97  # a tenth was lost
    errors = [abs(value) for value in flight.ticks("fly")[-1]["observation"][12:15]]
    assert max(errors) < 0.1  # the pair has gone where it was sent


@pytest.mark.alone
def test_the_log_holds_everything(flights: dict[str, Ended]) -> None:
    flight = flights["rehearsed"]
    kinds = {record["kind"] for record in flight.records}
    assert {"header", "connected", "parameter", "check", "state", "transition", "tick", "end"} <= kinds
    tick = flight.ticks("fly")[-1]
    assert len(tick["observation"]) == 18
    assert len(tick["leader"]) == len(tick["follower"]) == 3
    assert len(tick["sent"]) == len(tick["ages"]) == 2
    assert all(record["raw"].state.battery > 3 for record in flight.records if record["kind"] == "state")


@pytest.mark.alone
def test_a_dry_run(flights: dict[str, Ended]) -> None:
    flight = flights["dry"]
    assert (flight.code, flight.states()) == (0, NORMAL)
    assert "would have sent" in flight.out
    assert "sag:leader@0 never came" in flight.out.splitlines()[-1]
    assert any(tick["sent"][0][3] > 10000 for tick in flight.ticks("fly"))
    assert max(tick["observation"][2] for tick in flight.ticks("fly")[1:]) < 0.01  # nothing has lifted


@pytest.mark.alone
@pytest.mark.parametrize("name", list(SIGNALS))
def test_signals_land(flights: dict[str, Ended], name: str) -> None:
    flight = flights[name]
    assert (flight.code, flight.states()) == (0, NORMAL)
    assert any("INTERRUPT: asked for on the laptop" in record.get("events", []) for record in flight.records)
