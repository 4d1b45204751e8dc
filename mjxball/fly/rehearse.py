"""The twin as a child process, so that a rehearsal shares no interpreter lock with the control loop."""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from mjxball.errors import InputError

START_LIMIT = 30.0  # [s]


class Rehearsal:
    """A running twin. A context manager; `uris` are leader and follower."""

    def __init__(self, policy: Path, ports: Sequence[int] = (0, 0), more: Sequence[str] = ()):
        """Start the twin of the rig that `policy` was made for, with `more` options; InputError if it does not."""
        arguments = ["--ports", *map(str, ports), "--policy", str(policy), *more]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mjxball.fly.twin", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            text=True,
        )
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], START_LIMIT)
        line = self._process.stdout.readline() if readable else ""
        if not line:
            self.close()
            raise InputError("the twin did not start; are the ports of --leader and --follower free?")
        leader, follower = json.loads(line)["uris"]
        self.uris: tuple[str, str] = (leader, follower)

    def __enter__(self) -> Rehearsal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the twin."""
        try:
            self._process.communicate(timeout=5)  # closes its input, which ends it
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate(timeout=5)
