"""`python -m mjxfly.mocap_child`: reads a motion capture system and prints what it sees as lines of JSON.

It is a separate process because the package `motioncapture` connects without a time limit while it holds the GIL, waits
for frames without a limit, and parses network data in C++.

Lines: `{"error": TEXT}`; `{"names": [...]}` whenever a body is seen for the first time; `[LEADER, FOLLOWER]` at most
RATE times a second, each null or [time, x, y, z, qw, qx, qy, qz] with the monotonic time of its frame [s].
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

from mjxball.cli import make_parser
from mjxball.reading import parse_json

CONNECT = 20.0  # [s] after which a blocked connection is given up, even if the parent has ended


class Decimation:
    """Drops frames so that on average at most `rate` a second remain."""

    def __init__(self, rate: float):
        self._period, self._due = 1 / rate, -1e9

    def passes(self, now: float) -> bool:
        """True if the frame at `now` [s] is kept."""
        if now < self._due - self._period / 4:  # tolerance: a system with the same rate keeps all frames despite jitter
            return False
        self._due = self._due + self._period if now - self._due < self._period else now + self._period
        return True


class Merger:
    """Collects the newest pose of each wanted body between two lines: some systems send one body per frame."""

    def __init__(self, names: Sequence[str]):
        self._names = names
        self._known: set[str] = set()
        self._newest: list[list[float] | None] = [None, None]

    def take(self, bodies: Any, now: float) -> list[str] | None:
        """Add one frame, a mapping of names to rigid bodies; return all names so far if one is new, else None."""
        for number, name in enumerate(self._names):
            if name in bodies:
                place, turn = bodies[name].position, bodies[name].rotation
                self._newest[number] = [now, *map(float, place), turn.w, turn.x, turn.y, turn.z]
        if self._known.issuperset(bodies):
            return None
        self._known.update(bodies)
        return sorted(self._known)

    @property
    def waits(self) -> bool:
        """True if a wanted body was seen since the last line."""
        return any(self._newest)

    def line(self) -> list[list[float] | None]:
        """Pose of each wanted body, [time, x, y, z, qw, qx, qy, qz] or None, since the last call."""
        newest, self._newest = self._newest, [None, None]
        return newest


def main(arguments: Sequence[str]) -> int:
    """Print frames until standard input ends; return the exit code."""
    parser = make_parser("python -m mjxfly.mocap_child", "Read motion capture; started by mjxfly.")
    parser.add_argument("kind")
    parser.add_argument("rate", type=float)
    parser.add_argument("bodies", nargs=2)
    parser.add_argument("settings", type=parse_json)
    options = parser.parse_args(arguments)
    pipe = os.fdopen(os.dup(1), "wb", buffering=0)
    silence = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):  # the package prints to both
        os.dup2(silence, number)

    def say(what: Any) -> None:
        pipe.write(json.dumps(what).encode() + b"\n")

    with contextlib.suppress(BrokenPipeError):
        try:
            _read(options, say)
        except BrokenPipeError:
            raise
        except Exception as error:  # whatever C++ throws; the parent reports it
            text = str(error).strip() or type(error).__name__
            say({"error": text.splitlines()[0]})
    return 0


def _read(options: Any, say: Any) -> None:
    package = importlib.import_module("motioncapture")
    with contextlib.suppress(AttributeError, ValueError):  # the kernel can end us while the GIL is held
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, CONNECT)
    system = package.connect(options.kind, options.settings)
    with contextlib.suppress(AttributeError, ValueError):
        signal.setitimer(signal.ITIMER_REAL, 0)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    merger, decimation = Merger(options.bodies), Decimation(options.rate)
    while True:
        system.waitForNextFrame()
        now = time.monotonic()
        names = merger.take(system.rigidBodies, now)
        if names is not None:
            say({"names": names})
        if merger.waits and decimation.passes(now):  # VRPN's client returns twice per frame
            say(merger.line())


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
