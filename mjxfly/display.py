"""User interface of a flight: terminal display, live view in a browser, keys and signals."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple, TextIO

import numpy as np

from mjxball.control import rotations
from mjxball.terminal import columns_of, fitted_to, is_live
from mjxfly.limits import NAMES, Limits
from mjxfly.packets import DroneState, Setpoint
from mjxfly.process import Child
from mjxfly.supervisor import ENDED, GUIDED, FlightState, Supervisor

RED, YELLOW, GREEN, PLAIN = "\x1b[1;37;41m", "\x1b[33m", "\x1b[32m", "\x1b[0m"
PERIOD = 0.2  # [s]
KEYS = "keys: l lands, space stops the motors at once"


class View(NamedTuple):
    """Snapshot of a flight for the display, replaced at every tick."""

    time: float  # [s] since the start
    supervisor: Supervisor
    states: list[DroneState]
    ages: list[float]  # of the states [s]
    wanted: tuple[Setpoint, Setpoint]
    late: float  # [s] of the tick
    missed: int  # deadlines in the last second
    carry: str = ""  # instructions to the person who carries the pair in a dry run


def lines(view: View, bounds: Limits, colour: bool = True, columns: int = 120) -> list[str]:
    """`view` as lines that fit a terminal of `columns`; danger is white on red."""
    state = view.supervisor.state
    code = GREEN if state in GUIDED and view.supervisor.cause is None else YELLOW
    code = RED if view.supervisor.cause is not None or state in (FlightState.HOLD, FlightState.KILL) else code
    cause = view.supervisor.cause
    why = f" {cause.event.name} {cause.detail}" if cause else ""
    timing = f"loop {1000 * view.late:5.2f} ms late, {view.missed} missed/s"
    first = [
        (f"{view.time:7.2f} s", ""),
        (f" {state.value.upper()}{why} ", code),
        (timing, RED if view.missed else ""),
    ]
    first += [(f"by hand: {view.carry}", YELLOW)] if view.carry else []
    shown = _wrapped(first, columns, colour)
    for name, drone, age, sent in zip(NAMES, view.states, view.ages, view.wanted, strict=True):
        roll, pitch, yaw = np.degrees(rotations.euler_from_matrix(rotations.matrix_from_quaternion(drone.quaternion)))
        x, y, z = drone.position
        low = drone.battery < bounds.battery + 0.1
        old = age > bounds.state_age / 2
        parts = [
            (f"{name:8} ({x:+z.2f}, {y:+z.2f}, {z:+z.2f}) m", ""),
            (f"roll {roll:+z5.1f} pitch {pitch:+z5.1f} yaw {yaw:+z5.1f}", ""),
            (f"{drone.battery:.2f} V", RED if low else ""),
            (f"state {1000 * age:4.0f} ms" if math.isfinite(age) else "state never", RED if old else ""),
            (f"thrust {sent.thrust:5d}", ""),
        ]
        shown += _wrapped(parts, columns, colour)
    return [*shown, *_wrapped([(KEYS, "")], columns, colour)]


def plain(view: View) -> str:
    """One line with the phase and its cause, for output that cannot be redrawn."""
    cause = view.supervisor.cause
    return f"{view.time:7.2f} s  {view.supervisor.state.value}" + (f": {cause}" if cause else "")


def _wrapped(parts: list[tuple[str, str]], columns: int, colour: bool) -> list[str]:
    """(text, colour) pairs laid out in lines shorter than `columns`: a line that the terminal wraps is not erased."""
    rows: list[list[str]] = [[]]
    width = 0
    pieces = [(text, code) for whole, code in parts for text in _pieces(whole, columns - 1)]
    for text, code in pieces:
        if rows[-1] and width + 2 + len(text) >= columns:
            rows.append([])
        width = len(text) + (width + 2 if rows[-1] else 0)
        rows[-1].append(f"{code}{text}{PLAIN}" if colour else text)
    return ["  ".join(row) for row in rows]


def _pieces(text: str, width: int) -> list[str]:
    return [text] if len(text) <= width else textwrap.wrap(text, width)


class Display:
    """Redraws what `view` returns every `PERIOD`, in a thread. A context manager.

    Without a terminal that can move the cursor up it prints one line per phase.
    """

    def __init__(self, view: Callable[[], View | None], bounds: Limits, stream: TextIO = sys.stdout):
        self._view, self._bounds, self._stream = view, bounds, stream
        self._done = threading.Event()
        self._colour = "NO_COLOR" not in os.environ
        self._draw = self._redraw if is_live(stream) else self._print
        self._thread = threading.Thread(target=self._draw_all, name="display", daemon=True)
        self._rows_shown = 0
        self._phase: object = None

    def __enter__(self) -> Display:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join(timeout=1)

    def _columns(self) -> int:
        """Present width of the terminal, at least 20."""
        return max(columns_of(self._stream), 20)

    def _draw_all(self) -> None:
        while not self._done.wait(PERIOD):
            view = self._view()
            if view is None or (view.supervisor.state in ENDED and self._phase is None):
                continue
            try:
                self._draw(view)
            except (OSError, ValueError):  # a closed terminal
                return

    def _redraw(self, view: View) -> None:
        text = lines(view, self._bounds, self._colour, self._columns())
        up = f"\x1b[{self._rows_shown}A\x1b[J" if self._rows_shown else ""
        self._stream.write(up + "".join(f"{line}\n" for line in text))
        self._stream.flush()
        self._rows_shown, self._phase = len(text), view.supervisor.state

    def _print(self, view: View) -> None:
        phase = view.supervisor.state, view.supervisor.cause
        if phase != self._phase:
            print(fitted_to(self._stream, plain(view)), file=self._stream, flush=True)
        self._phase = phase


def live_view(log: Path, port: int = 0, foxglove: int | None = None) -> Child:
    """A process `python -m mjxfly.view --live` that shows the flight log `log`; its `line` has the page's address.

    `foxglove` is the port for Foxglove, None for none. The process only reads the log, so that a flight never waits for
    it. Raises InputError.
    """
    more = [] if foxglove is None else ["--foxglove", str(foxglove)]
    flags = ["--live", "--attached", "--port", str(port), *more, "--", str(log)]
    also = " and of --foxglove" if more else ""
    return Child(["mjxfly.view", *flags], f"the live view did not start; is the port of --view{also} free?")


KILL_KEYS = b" kK"  # the space bar is found without looking
LAND_KEYS = b"lLq\n"


@contextlib.contextmanager
def listening(land: Callable[[], None], interrupt: Callable[[], None], kill: Callable[[], None]) -> Iterator[None]:
    """Call `interrupt` on Ctrl-C, `land` on SIGTERM, a closed terminal and the landing keys, `kill` on the kill keys.

    The caller handles repeated Ctrl-C. Keys work in a terminal only.
    """
    done = threading.Event()

    def caught(number: int, frame: FrameType | None) -> None:
        (interrupt if number == signal.SIGINT else land)()

    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, caught) for number in signals}
    with _raw_terminal() as terminal:
        if terminal is not None:
            threading.Thread(target=_read, args=(terminal, done, land, kill), daemon=True).start()
        try:
            yield
        finally:
            done.set()
            for number, handler in before.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def _raw_terminal() -> Iterator[int | None]:
    """File descriptor of standard input with single keys readable, None if it is no terminal."""
    try:
        import termios
        import tty
    except ImportError:  # not on Windows
        yield None
        return
    try:
        number = sys.stdin.fileno()
        before = termios.tcgetattr(number)
    except (OSError, ValueError, AttributeError, termios.error):
        yield None
        return
    tty.setcbreak(number)
    try:
        yield number
    finally:
        with contextlib.suppress(OSError, termios.error):  # the terminal may have been closed
            termios.tcsetattr(number, termios.TCSADRAIN, before)


def _read(terminal: int, done: threading.Event, land: Callable[[], None], kill: Callable[[], None]) -> None:
    while not done.is_set():
        readable, _, _ = select.select([terminal], [], [], 0.1)
        pressed = os.read(terminal, 32) if readable else b""
        if readable and not pressed:
            return
        if any(key in KILL_KEYS for key in pressed):
            kill()
        elif any(key in LAND_KEYS for key in pressed):
            land()
