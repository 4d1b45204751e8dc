"""A follower in a process of its own, which sees observations and nothing else, within limits of time."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np

from mjxball.bench import cpu, frames
from mjxball.bench.success import MAX_CPU_TIME
from mjxball.config import Config, to_dict
from mjxball.control.followers import checked_command
from mjxball.control.leader import clip_command
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.errors import InputError
from mjxball.evaluate.followers import MAX_COMMAND

PACKAGE = Path(__file__).parents[2]
# Time that a follower may take by the clock in all: so much, and more for every control step of every flight [s].
PATIENCE, PATIENCE_PER_STEP = 60.0, 2 * MAX_CPU_TIME
WARM_UP, CALLS = 20, 100  # calls before CPU time is measured, and measured ones of a check before the flights
OUTPUT_LINES, LINE = 20, 200  # of what the follower prints: last lines that are kept, and characters of each
# One thread: CPU time is that of the follower's arithmetic, and the order of sums is always the same.
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"),
    "JAX_PLATFORMS": "cpu",
    "PYTHONUNBUFFERED": "1",
}


class RefusalError(InputError):
    """The follower itself says why it does not fly."""


class FollowerProcess:
    """The process of the follower `text`, called `name`; a context manager that ends it.

    Raises InputError with one sentence wherever the follower does not answer as it should. It cannot be used then.
    """

    def __init__(self, name: str, text: str):
        self.name, self._patience, self._made = name, PATIENCE, 0
        self.answered = 0  # control steps of flights so far, each flight's counted
        receive, self._send = os.pipe()
        self._receive, send = os.pipe()
        command = [sys.executable, "-P", "-m", "mjxball.bench.child", str(receive), str(send), text]
        path = os.pathsep.join(filter(None, [str(PACKAGE), os.environ.get("PYTHONPATH")]))
        self._process = subprocess.Popen(
            command,
            env={**os.environ, **ENVIRONMENT, "PYTHONPATH": path},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=(receive, send),
            start_new_session=True,  # a group of its own, which can be ended as a whole
        )
        os.close(receive)
        os.close(send)
        self._selectors = {self._send: selectors.DefaultSelector(), self._receive: selectors.DefaultSelector()}
        for pipe, event in ((self._send, selectors.EVENT_WRITE), (self._receive, selectors.EVENT_READ)):
            os.set_blocking(pipe, False)
            self._selectors[pipe].register(pipe, event)
        self._printed: deque[str] = deque(maxlen=OUTPUT_LINES)
        assert self._process.stdout is not None
        threading.Thread(target=_drain, args=(self._process.stdout, self._printed), daemon=True).start()

    def __enter__(self) -> FollowerProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process and those that it has started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):  # it has ended; macOS: it is a zombie
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe, selector in self._selectors.items():
            selector.close()
            with contextlib.suppress(OSError):
                os.close(pipe)

    @property
    def cpu_time(self) -> float:
        """CPU time of the process so far [s], as the operating system counts it."""
        return cpu.cpu_time(self._process.pid)

    @property
    def own_time(self) -> float:
        """`cpu_time` without that of processes which it has started [s]."""
        return cpu.own_time(self._process.pid)

    def follower(self, config: Config) -> RemoteFollower:
        """The follower made for the nominal plant of `config`; RefusalError if it does not fly that plant."""
        self.ask(frames.LOAD, json.dumps(to_dict(config)).encode(), frames.READY)
        self._made += 1
        return RemoteFollower(self, self._made - 1, config)

    def check_cpu_time(self, config: Config) -> float:
        """Median CPU time of a control step of one flight at rest [s]; InputError if it exceeds `MAX_CPU_TIME`."""
        follower, several = self.follower(config), len(config.plant.followers)
        follower.believed_mass = np.full(1, config.plant.object_mass)
        observation = np.zeros((1, OBSERVATION_SIZE) if several == 1 else (1, several, OBSERVATION_SIZE))
        follower.reset()
        for _ in range(WARM_UP):
            follower(observation)
        taken = []
        for _ in range(0, CALLS, cpu.CALLS):
            begun = self.cpu_time
            for _ in range(cpu.CALLS):
                follower(observation)
            taken.append((self.cpu_time - begun) / cpu.CALLS)
        if (found := float(np.median(taken))) > MAX_CPU_TIME:
            most = f"at most {1e3 * MAX_CPU_TIME:.0f} ms"
            raise InputError(f"follower {self.name} takes {1e3 * found:.0f} ms of CPU time for a control step; {most}")
        return found

    def check_alone(self) -> None:
        """Raise InputError if the follower has started processes, whose CPU time would not count."""
        if cpu.others_of_group(self._process.pid):
            raise InputError(f"follower {self.name} has started another process; it must compute in its own")

    def ask(self, kind: bytes, content: bytes, wanted: bytes, steps: int = 0) -> bytes:
        """Send a frame and return the content of the answer, which must be of the kind `wanted`.

        `steps`: control steps of flights, for which the follower gets more time.
        """
        self._patience += PATIENCE_PER_STEP * steps
        begun = time.monotonic()
        try:
            self._write(frames.frame(kind, content), begun + self._patience)
            found, length = frames.HEAD.unpack(self._read(frames.HEAD.size, begun + self._patience))
            if found not in (wanted, frames.ERROR) or length > frames.MAX_BYTES:
                raise InputError(f"follower {self.name} sent something that is no answer")
            answer = self._read(length, begun + self._patience)
        finally:
            self._patience -= time.monotonic() - begun
        if found == frames.ERROR:
            raise RefusalError(_printable(answer[: frames.MAX_TEXT].decode("utf-8", "replace")))
        self.answered += steps
        return answer

    def _write(self, content: bytes, until: float) -> None:
        view = memoryview(content)
        while view:
            self._wait(self._send, until)
            try:
                view = view[os.write(self._send, view) :]
            except OSError:
                raise self._ended() from None

    def _read(self, count: int, until: float) -> bytes:
        found = bytearray()
        while len(found) < count:
            self._wait(self._receive, until)
            part = os.read(self._receive, min(count - len(found), 2**16))
            if not part:
                raise self._ended()
            found += part
        return bytes(found)

    def _wait(self, pipe: int, until: float) -> None:
        # An end of the pipe may be in a process that the follower has started, when its own has ended.
        while not self._selectors[pipe].select(max(0.0, min(1.0, until - time.monotonic()))):
            if time.monotonic() >= until:
                raise InputError(f"follower {self.name} did not answer in time")
            if self._process.poll() is not None:
                raise self._ended()

    def _ended(self) -> InputError:
        """The error after the process has ended or has closed its pipe."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        code = self._process.poll()
        how = "closed its pipe" if code is None else f"ended its process with code {code}"
        last = f"; it printed: {_printable(self._printed[-1])}" if self._printed else ""
        return InputError(f"follower {self.name} {how}{last}")


class RemoteFollower:
    """A `mjxball.control.followers.Follower` that asks its process. Commands are checked, then clipped as everybody's.

    Set `believed_mass` (n,) [kg] of n flights before a reset. `slowest` is the largest CPU time of a call over the
    number of flights that it answers [s], without the first `WARM_UP` calls after a reset, in which programs compile,
    and without processes that it starts and waits for, which count in the mean of all calls.
    Where the operating system counts coarsely, it is that of `cpu.CALLS` calls and of what the process does meanwhile.
    """

    def __init__(self, process: FollowerProcess, number: int, config: Config):
        self.name, self._number = process.name, frames.NUMBER.pack(number)
        self.believed_mass: np.ndarray = np.zeros(0)
        self.slowest, self._calls, self._begun = 0.0, 0, (0.0, 0)
        self._process, self._limits = process, (config.command.tilt_limit, config.command.vertical_limit)

    def reset(self) -> None:
        """See `Follower.reset`."""
        self.slowest, self._calls = 0.0, 0
        self._process.ask(frames.RESET, self._number + frames.packed(self.believed_mass), frames.READY)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Follower.__call__`; InputError if it sends no command."""
        sent = self._number + frames.packed(observation)
        if self._calls % cpu.CALLS == 0:
            self._begun = self._process.own_time, self._process.answered
        content = self._process.ask(frames.OBSERVATION, sent, frames.COMMAND, len(observation))
        self._count_time()
        command = checked_command(self.name, frames.unpacked(content), observation)
        if not (np.abs(command) <= MAX_COMMAND).all():
            raise InputError(
                f"follower {self.name} answered a number that is not finite, or larger than {MAX_COMMAND:g}"
            )
        return clip_command(command, *self._limits)

    def _count_time(self) -> None:
        self._calls += 1
        if self._calls % cpu.CALLS == 0 and self._calls > WARM_UP:
            begun, answered = self._begun
            taken = (self._process.own_time - begun) / (self._process.answered - answered)
            self.slowest = max(self.slowest, taken)


def _drain(stream: IO[bytes], kept: deque[str]) -> None:
    """Read what the follower prints, so that it never waits, and keep the last lines in `kept`."""
    while line := stream.readline(LINE):
        if text := line.decode("utf-8", "replace").strip():
            kept.append(text)


def _printable(text: str) -> str:
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())[: frames.MAX_TEXT]
