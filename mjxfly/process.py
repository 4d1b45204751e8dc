"""Threads and processes: timing and priority of the control loop, waiting with a limit, child processes."""

from __future__ import annotations

import collections
import contextlib
import os
import select
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

from mjxball.errors import InputError
from mjxfly import clock


@dataclass(frozen=True)
class Timing:
    """Lateness of the loop's ticks against their deadlines [s]."""

    ticks: int
    missed: int  # deadlines that passed during the previous tick
    median: float
    p99: float
    largest: float


class Metronome:
    """Wakes once per period. A late tick does not shift later ones; skipped deadlines are counted."""

    def __init__(self, period: float):
        self.period = period
        self.missed = 0
        self._late: list[float] = []
        self._misses: collections.deque[float] = collections.deque()
        self.lateness = self.gap = 0.0  # lateness of the last tick, time between the last two [s]
        self.start()

    def start(self) -> None:
        """Set the first deadline to one period from now."""
        self._before = clock.now()
        self._deadline = self._before + self.period

    def wait(self) -> float:
        """Sleep until the next deadline; return the time after it [s]."""
        while (left := self._deadline - clock.now()) > 0:
            clock.sleep(left)
        now = clock.now()
        self.lateness = now - self._deadline
        self._late.append(self.lateness)
        passed = int(self.lateness / self.period)
        self.missed += passed
        self._misses.extend([now] * min(passed, 100))
        self._deadline += (passed + 1) * self.period
        self.gap, self._before = now - self._before, now
        return now

    def missed_lately(self, now: float) -> int:
        """Deadlines missed in the last second."""
        while self._misses and now - self._misses[0] > 1:
            self._misses.popleft()
        return len(self._misses)

    def timing(self) -> Timing:
        """Statistics of all ticks so far."""
        late = sorted(self._late) or [0.0]
        return Timing(len(self._late), self.missed, late[len(late) // 2], late[int(0.99 * (len(late) - 1))], late[-1])


REAL_TIME = 5  # priority among real-time threads, low: those of the kernel come first


@contextlib.contextmanager
def urgent(above: int = 0) -> Iterator[str]:
    """Raise the priority of this thread, and of threads and processes that it starts, if the system allows it.

    `above` adds to the real-time priority. Yields what was granted: "real time" (root, or a limit on rtprio), a better
    nice value, or "nothing".
    """
    granted, undo = "nothing", contextlib.ExitStack()
    with contextlib.suppress(OSError, AttributeError):
        before = (os.sched_getscheduler(0), os.sched_getparam(0))
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(REAL_TIME + above))
        granted = "real time"
        undo.callback(os.sched_setscheduler, 0, *before)
    if granted == "nothing":
        with contextlib.suppress(OSError):
            granted = f"nice {os.nice(-10)}"
            undo.callback(os.nice, 10)
    try:
        yield granted
    finally:
        with contextlib.suppress(OSError):
            undo.close()


def bounded(action: Callable[[], Any], seconds: float) -> bool:
    """Run `action` in a thread; false if it has not returned after `seconds` and is left running.

    Some calls of cflib wait without limit, and some of its callbacks can deadlock.
    """
    thread = threading.Thread(target=action, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


def together(actions: Sequence[Callable[[], None]]) -> None:
    """Run all `actions` in parallel; raise the first error after all have ended."""
    errors: list[Exception] = []

    def guarded(action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:  # carried over to the caller's thread
            errors.append(error)

    threads = [threading.Thread(target=guarded, args=(action,), daemon=True) for action in actions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    """Wait until `condition` holds; false if it does not within `seconds`."""
    end = clock.now() + seconds
    while not condition():
        if clock.now() > end:
            return False
        clock.sleep(0.01)
    return True


class Child:
    """A process `python -m MODULE ...` that prints one line when it is ready and ends when its standard input closes.

    A context manager. Ctrl-C is not sent to it: it must serve the flight until that has landed.
    """

    def __init__(self, arguments: Sequence[str], failure: str, start_limit: float = 30.0, late: str = ""):
        """Start it. Raises InputError with the sentence `failure` if it ends, or is not ready within `start_limit` [s].

        `late` replaces `failure` in the second case. If the child refuses its input (code 2), this process exits too.
        """
        self._process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            text=True,
        )
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], start_limit)
        self.line = self._process.stdout.readline().strip() if readable else ""
        if not self.line:
            self.close()
            if self._process.returncode == 2:  # bad input, on which it has printed a message
                sys.exit(2)
            raise InputError(failure if readable else late or failure)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its input and wait for it to end; kill it after 5 s."""
        try:
            with contextlib.suppress(OSError, ValueError):
                self._process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate(timeout=5)
