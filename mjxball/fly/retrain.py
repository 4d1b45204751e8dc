"""The runner's end of retraining in flight: a process of its own reads the flight's log and hands a policy over.

Whatever becomes of that process, the flight goes on with the policy that it has: a line that is none, a policy that is
unsound or for another rig, one that is late, an end or a silence only lead to a note in the log.
"""

from __future__ import annotations

import math
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from mjxball.errors import InputError
from mjxball.fly.handover import difference
from mjxball.fly.telemetry import Note
from mjxball.policy import Policy
from mjxball.reading import parse_json

MODULE = "mjxball.commands.retrain"
START_LIMIT = 300.0  # [s] in which the process must have compiled its programs
LATE = 10.0  # [s] after the identification from when on a policy is not taken any more
LONGEST_LINE = 2**16


class Retrainer:
    """The process, and what it says. A context manager; `take` neither blocks nor raises."""

    def __init__(self, arguments: list[str], flown: Policy, module: str = MODULE):
        """Start it with the command line `arguments`; `flown` is the policy that it is to improve."""
        self.note: Note = lambda kind, t=None, **fields: None
        self.said: list[dict[str, Any]] = []  # what it said since it was ready
        self._flown = flown
        self._offered: Policy | None = None
        self._identified = -math.inf  # [s]
        self._concluded = False  # a policy was offered, or the process said that there is none
        self._early: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()  # said before it was ready
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        threading.Thread(target=self._listen, name="retrainer", daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=1)
        except subprocess.TimeoutExpired:  # it computes: nothing of it is needed any more
            self._process.kill()
            self._process.wait(timeout=5)

    def wait(self, show: Callable[[str], None], limit: float = START_LIMIT) -> None:
        """Return once it is ready; `show` its progress. Raises InputError with a sentence if it never is."""
        end = time.monotonic() + limit
        while True:
            try:
                message = self._early.get(timeout=max(end - time.monotonic(), 0.0))
            except queue.Empty:
                raise InputError(f"--retrain: the process that retrains was not ready within {limit:g} s") from None
            if message is None or "error" in message:
                raise InputError(f"--retrain: {(message or {}).get('error', 'the process that retrains ended')}")
            if message.get("what") == "ready":
                return
            if "text" in message:
                show(str(message["text"]))

    def take(self) -> Policy | None:
        """A policy that is to take over now, once."""
        offered, self._offered = self._offered, None
        return offered

    def _listen(self) -> None:
        """Every line until the process ends, in a thread of its own."""
        assert self._process.stdout is not None
        stream, ready = self._process.stdout, False
        while line := stream.readline(LONGEST_LINE):
            message = _message(line)
            if not ready:
                ready = message.get("what") == "ready"
                self._early.put(message)
                continue
            try:
                self._heard(message)
            except Exception as error:  # whatever it sends, the flight goes on
                self._tell("failed", str(error))
        self._early.put(None)
        if ready and not self._concluded:
            self._tell("failed", "the process that retrains ended")

    def _heard(self, message: dict[str, Any]) -> None:
        what = message.get("what")
        if what not in ("identified", "kept", "fine-tuned"):
            return
        self._tell(what, str(message.get("text", "")), message.get("numbers"))
        if what == "identified":
            self._identified = time.monotonic()
        self._concluded = self._concluded or what == "kept"
        if what != "fine-tuned":
            return
        policy = Policy.load(Path(str(message.get("policy"))))
        odd = difference(self._flown, policy)
        if odd:
            self._tell("failed", f"the policy has another {odd} in its card")
        elif time.monotonic() - self._identified > LATE:
            self._tell("failed", "the policy came too late")
        else:
            self._offered, self._concluded = policy, True

    def _tell(self, what: str, text: str, numbers: Any = None) -> None:
        self.said.append({"what": what, "text": text, "numbers": numbers})
        self.note("retrain", what=what, text=text, numbers=numbers)


def _message(line: bytes) -> dict[str, Any]:
    try:
        found = parse_json(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
