"""The twin as a process, and whether this computer is fast enough for it.

The twin reports its lateness 50 times a second. If the reports or the twin are late, a failed rehearsal shows nothing
about links, parameters and controllers; it ends with one sentence that says so. At its end the twin reports the
object's place.
"""

from __future__ import annotations

import collections
import contextlib
import os
import threading
from collections.abc import Sequence
from typing import Any

from mjxball.errors import InputError
from mjxball.reading import parse_json
from mjxfly import clock
from mjxfly.process import Child
from mjxfly.supervisor import Event, Fault

BEAT = 0.02  # [s] between two lines of the twin
LATE = 0.04  # [s] lateness that may explain a fault: a drone counts as lost after 0.1 s
WINDOW = 3.0  # [s] for which lateness counts
LAST = 5.0  # [s] that the twin flies on after its input is closed, until its motors are off


class RehearsalError(InputError):
    """A rehearsal is not valid: this computer is too slow for it, or its twin has failed."""


class Rehearsal(Child):
    """A running twin. A context manager."""

    def __init__(self, flags: Sequence[str]):
        """Start the twin with `flags` and this process's clock. Raises InputError."""
        failure = "the twin did not start; are the ports of --leader and --follower free?"
        command = ["mjxfly.twin", f"--slow={clock.factor()}", *flags]
        super().__init__(command, failure, late=clock.too_slow("the twin was not ready within 30 s"))
        assert self._process.stdout is not None
        self.uris: tuple[str, str] = tuple(parse_json(self.line)["uris"])
        self._pipe = self._process.stdout.fileno()
        self._lateness: collections.deque[tuple[float, float]] = collections.deque()  # time and lateness [s]
        self._newest = clock.now()  # time of the newest line [s]
        self._report: dict[str, Any] = {}  # the twin's last line
        self._ended = threading.Event()
        threading.Thread(target=self._listen, name="rehearsal", daemon=True).start()

    def _listen(self) -> None:
        rest = b""
        with contextlib.suppress(OSError):
            while received := os.read(self._pipe, 4096):
                *lines, rest = (rest + received).split(b"\n")
                for line in lines:
                    self._take(line)
        self._ended.set()

    def _take(self, line: bytes) -> None:
        try:
            message = parse_json(line)
        except ValueError:  # rest of a line that was partly read with the first
            return
        if "behind" not in message:
            self._report = message
            return
        written, now = message["at"], clock.now()
        self._lateness.append((now, max(message["behind"], now - written, written - self._newest - BEAT)))
        self._newest = written
        while self._lateness[0][0] < now - WINDOW:
            self._lateness.popleft()

    def late(self) -> float:
        """Largest lateness of the twin or of its reports within `WINDOW` [s]."""
        return max([clock.now() - self._newest - BEAT, *(late for _, late in list(self._lateness))])

    def rehearsal_error(self, cause: Fault | None = None) -> RehearsalError | None:
        """Error that replaces a fault `cause`, or a failure, if a slow or failed twin may have caused it; else None."""
        if cause is not None and cause.event in (Event.KEY_KILL, Event.INTERRUPT):
            return None
        if cause is not None and cause.event is Event.DEADLINES:
            return RehearsalError(clock.too_slow(cause.detail))
        if self._ended.is_set():
            failure = self._report.get("failure") or "it was killed, or it crashed"
            return RehearsalError(failure if self._report.get("slow") else f"the twin has ended: {failure}")
        late = min(self.late(), WINDOW)
        return RehearsalError(clock.too_slow(f"the twin is up to {late:.2f} s behind")) if late > LATE else None

    def end(self) -> str:
        """Let the twin end; lines on where the object is with its motors off, and on faults never injected."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        self._ended.wait(clock.real(LAST) + 5)
        if "place" not in self._report:
            return "twin: the place of the object is not known"
        x, y, z = self._report["place"]
        motors = "on" if self._report["turning"] else "off"
        late = 1e3 * self._report["most_behind"]
        never = "".join(f"\ntwin: --fault {one} never came: the flight had ended" for one in self._report["never"])
        place = f"the object is at ({x:+z.2f}, {y:+z.2f}, {z:+z.2f}) m from where it stood"
        return f"twin: {place}, motors {motors}; the twin was at most {late:.0f} ms behind{never}"

    def close(self) -> None:
        """Kill the twin."""
        self._process.kill()
        super().close()
