"""Frames of a motion capture system, from a child process that may hang or crash without hurting a flight."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mjxball.errors import InputError
from mjxball.fly.mocap_supervision import Frame, clean

BUILT = ("vicon", "optitrack", "qualisys", "vrpn", "mock")  # what the package on PyPI was built with
KINDS = (*BUILT, "optitrack_closed_source", "nokov", "motionanalysis", "fzmotion")
INSTALL = "motioncapture is not installed; pip install 'mjxball[mocap]'"


class MocapError(InputError):
    """A motion capture system that cannot be had or flown on, in one sentence."""


@dataclass(frozen=True)
class MocapSettings:
    """Which system, which bodies, and how their poses are used."""

    kind: str  # one of KINDS
    host: str = ""
    bodies: tuple[str, str] = ("leader", "follower")
    rate: float = 100.0  # of poses to each drone, at most [Hz]
    deviation: tuple[float, float] = (0.01, 0.05)  # standard deviations, position [m] and attitude [rad]
    options: dict[str, str] = field(default_factory=dict)  # more of what the package takes for this kind

    def given(self) -> dict[str, str]:
        """What the package is given. Raises MocapError for a host without an address."""
        host = self.host
        if self.kind == "optitrack":  # the package takes numbers only
            try:
                host = socket.gethostbyname(host)
            except OSError:
                raise MocapError(f"--mocap-host {host} has no address") from None
        return {"hostname": host, **self.options}


class Source:
    """The child process and the thread that reads it. A context manager; `take` is called in that thread."""

    def __init__(self, settings: MocapSettings, take: Callable[[Frame], None]):
        """Start both. Raises MocapError if the package is missing."""
        if importlib.util.find_spec("motioncapture") is None:
            raise MocapError(INSTALL)
        self._take = take
        self.names: list[str] = []  # of all bodies that were seen
        self.failure = ""  # why no more frames will come
        self.frames = self.damaged = 0
        self._stopping = False
        arguments = [settings.kind, f"{settings.rate}", *settings.bodies, json.dumps(settings.given())]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mjxball.fly.mocap_child", "--", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the runner
        )
        self._thread = threading.Thread(target=self._read_all, name="mocap", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int:
        """Of the child."""
        return self._process.pid

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the child and its thread."""
        self._stopping = True
        self._process.kill()  # it may be deep inside a call that never returns
        self._process.wait(timeout=5)
        self._thread.join(timeout=5)
        for stream in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                assert stream is not None
                stream.close()

    def _read_all(self) -> None:
        assert self._process.stdout is not None
        pipe, waiting = self._process.stdout.fileno(), b""
        while not self._stopping:
            readable, _, _ = select.select([pipe], [], [], 0.1)
            if not readable:
                continue
            received = os.read(pipe, 65536)
            if not received:
                self.failure = self.failure or "its reader ended"
                return
            *lines, waiting = (waiting + received).split(b"\n")
            for line in lines:
                self._line(json.loads(line))

    def _line(self, what: Any) -> None:
        if isinstance(what, dict):
            self.names = what.get("names", self.names)
            self.failure = what.get("error", self.failure)
            return
        poses = [None if one is None else clean(one[0], one[1:]) for one in what]
        self.damaged += sum(one is not None and pose is None for one, pose in zip(what, poses, strict=True))
        self.frames += 1
        self._take((poses[0], poses[1]))


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    """True once `condition` holds, false if it does not within `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True
