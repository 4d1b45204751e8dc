"""The live view as a child process, so that it shares neither interpreter lock nor priority with the control loop."""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys
from pathlib import Path

from mjxball.errors import InputError


class Spectator:
    """A running `python -m mjxball.view --live`. A context manager; `line` says where its page is.

    Nothing waits for it while flying: it reads the log and nobody reads what it writes. It ends with this process.
    """

    def __init__(self, log: Path, port: int = 0, start_limit: float = 30.0):
        """Start it for the flight log `log`, before the flight. Raises InputError if it does not start."""
        flags = ["--live", "--attached", "--port", str(port)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mjxball.view", *flags, "--", str(log)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C lands the flight, and that is worth seeing
            text=True,
        )
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], start_limit)
        self.line = self._process.stdout.readline().strip() if readable else ""
        if not self.line:
            self.close()
            raise InputError("the live view did not start; is the port of --view free?")

    def __enter__(self) -> Spectator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it, once an open page has the rest of the flight."""
        try:
            with contextlib.suppress(OSError, ValueError):
                self._process.communicate(timeout=5)  # closes its input, which ends it
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate(timeout=5)
