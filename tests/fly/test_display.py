"""What the person at the keyboard sees and can do."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import environment

from mjxfly.display import RED, Display, View, lines
from mjxfly.limits import Limits
from mjxfly.packets import ZERO, DroneState
from mjxfly.supervisor import Event, Fault, FlightState, Supervisor

LIMITS = Limits()


def view(
    state: FlightState = FlightState.FLY, cause: Fault | None = None, battery: float = 4.0, age: float = 0.01
) -> View:
    drone = DroneState(np.array([0.1, -0.2, 0.3]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), 0, battery)
    return View(1.0, Supervisor(state, 0.0, cause), [drone] * 2, [age] * 2, (ZERO, ZERO), 0.0, 0)


def test_a_good_flight_has_no_red() -> None:
    shown = "\n".join(lines(view(), LIMITS))
    assert RED not in shown
    assert "FLY" in shown
    assert "leader" in shown
    assert "follower" in shown
    assert "+0.30" in shown


@pytest.mark.parametrize(
    "danger",
    [
        view(FlightState.HOLD),
        view(FlightState.LAND, Fault(Event.BATTERY, "leader at 3.1 V")),
        view(battery=3.25),
        view(age=0.09),
        view(age=float("inf")),
    ],
)
def test_danger_is_red(danger: View) -> None:
    assert RED in "\n".join(lines(danger, LIMITS))


def test_without_colour_there_are_no_escapes() -> None:
    assert "\x1b" not in "\n".join(lines(view(FlightState.HOLD, Fault(Event.STALE), age=1.0), LIMITS, colour=False))


@pytest.mark.parametrize("columns", [20, 40, 60, 80, 104, 105, 200])
def test_no_line_is_wider_than_the_terminal(columns: int) -> None:
    """A terminal breaks a line that is too long, and what is redrawn over it smears."""
    cause = Fault(Event.ESTIMATOR, "the leader's height is +12 cm from where the follower and the roll put it")
    wide = view(FlightState.DESCEND, cause)
    shown = lines(wide, LIMITS, False, columns)
    assert max(map(len, shown)) < columns
    words = " ".join(lines(wide, LIMITS, False, 500)).split()
    assert " ".join(shown).split() == words  # nothing is lost
    coloured = lines(wide, LIMITS, True, columns)
    assert [re.sub(r"\x1b\[[\d;]*m", "", line) for line in coloured] == shown


@pytest.mark.clock
def test_what_is_redrawn_covers_what_was_drawn() -> None:
    """In a terminal of 60 columns, by a terminal's own rules for long lines and the cursor."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 60, 0, 0))
    with os.fdopen(theirs, "w") as stream, Display(view, LIMITS, stream):
        time.sleep(0.75)
    data = os.read(ours, 1 << 16).decode()
    os.close(ours)
    drawn = data.split("\x1b[J")
    assert len(drawn) > 1  # it was redrawn
    for before in drawn[:-1]:
        text, _, up = before.rpartition("\x1b[")
        assert int(up.removesuffix("A")) == text.count("\n")
        assert max(len(re.sub(r"\x1b\[[\d;]*m", "", line).rstrip("\r")) for line in text.split("\n")) < 60


@pytest.mark.clock
def test_what_cannot_go_back_a_line_gets_one_a_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    views = (
        [view(FlightState.RAMP)] * 2
        + [view()] * 2
        + [view(FlightState.LAND, Fault(Event.BATTERY, "leader at 3.1 V"))] * 20
    )
    stream = io.StringIO()
    with Display(lambda: views.pop(0) if len(views) > 1 else views[0], LIMITS, stream):
        time.sleep(1.6)
    assert stream.getvalue().splitlines() == [
        "   1.00 s  ramp",
        "   1.00 s  fly",
        "   1.00 s  land: battery: leader at 3.1 V",
    ]
    monkeypatch.setenv("TERM", "dumb")
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w") as terminal, Display(view, LIMITS, terminal):
        time.sleep(0.75)
    assert os.read(ours, 1 << 16) == b"   1.00 s  fly\r\n"
    os.close(ours)


def test_the_keys_are_shown() -> None:
    assert "l lands, space stops the motors" in lines(view(), LIMITS, False)[-1]


SCRIPT = """
import sys, time
from mjxfly.display import listening
heard = []
with listening(*(lambda word=word: heard.append(word) for word in ("land", "interrupt", "kill"))):
    print("ready", flush=True)
    end = time.monotonic() + 20
    while len(heard) < 3 and time.monotonic() < end:
        time.sleep(0.01)
print("heard", *heard, flush=True)
"""


def read_until(number: int, wanted: bytes, seconds: float = 20) -> bytes:
    end, data = time.monotonic() + seconds, b""
    while wanted not in data and time.monotonic() < end:
        data += os.read(number, 1024)
    return data


@pytest.mark.clock
@pytest.mark.parametrize("signals", [(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)])
def test_signals_land_without_a_terminal(signals: tuple[signal.Signals, ...]) -> None:
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", SCRIPT], env=environment(), text=True, **pipes) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        for number in signals:
            child.send_signal(number)
            time.sleep(0.1)
        assert child.stdout.readline() == "heard interrupt land land\n"


@pytest.mark.clock
def test_keys_in_a_terminal(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdin=theirs, stdout=theirs, env=environment()):
        os.close(theirs)
        assert b"ready" in read_until(ours, b"ready")
        for key in (b"x", b" ", b"l", b"k"):
            os.write(ours, key)
            time.sleep(0.3)
        assert b"heard kill land kill" in read_until(ours, b"heard kill land kill")
    os.close(ours)
