"""What a person can do while it flies: keys, Ctrl-C, SIGTERM."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

KILL_KEYS = b" kK"  # the largest key, found without looking
LAND_KEYS = b"lLq\n"


@contextlib.contextmanager
def listening(land: Callable[[], None], interrupt: Callable[[], None], kill: Callable[[], None]) -> Iterator[None]:
    """Call `interrupt` on Ctrl-C, `land` on SIGTERM, a closed terminal and the landing keys, `kill` on the kill keys.

    What Ctrl-C pressed twice means is the caller's. Keys work in a terminal only.
    """
    done = threading.Event()

    def caught(number: int, frame: FrameType | None) -> None:
        (interrupt if number == signal.SIGINT else land)()

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, caught) for number in numbers}
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
    """Standard input with single keys readable, None if it is no terminal."""
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
