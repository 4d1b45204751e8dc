"""Motion capture: poses of both drones' bodies are checked and forwarded to the drones' estimators over their links.

Usage: enter `ready(settings, span)` before connecting; write `parameters` and call `feed` for each drone once its link
is open; run `checks` before flight and set `guarding` when they pass; call `faults` at every tick. A child process
reads the frames, so that its hang or crash does not stop a flight. Poses are sent by the thread that reads the child,
not by the control loop.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import math
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjxball.errors import InputError
from mjxball.reading import parse_json
from mjxfly import clock, packets
from mjxfly import mocap_supervision as supervision
from mjxfly.limits import NAMES, Check
from mjxfly.link import Link
from mjxfly.mocap_supervision import Frame, MocapLimits, Pose, Track, Tracks, pose_of
from mjxfly.process import wait_until
from mjxfly.supervisor import Fault
from mjxfly.telemetry import Note

BUILT = ("vicon", "optitrack", "qualisys", "vrpn", "mock")  # kinds in the package on PyPI
KINDS = (*BUILT, "optitrack_closed_source", "nokov", "motionanalysis", "fzmotion")
LIMITS = MocapLimits()
NOTE_PERIOD = 0.02  # [s] between two poses of a drone in the log
KALMAN = 2  # value of the firmware's parameter stabilizer.estimator


class MocapError(InputError):
    """A motion capture system cannot be read or used for flight; the message is one sentence."""


@dataclass(frozen=True)
class MocapSettings:
    """Motion capture system, rigid bodies, and rate and accuracy of the forwarded poses."""

    kind: str  # one of KINDS
    host: str = ""
    bodies: tuple[str, str] = ("leader", "follower")
    rate: float = 100.0  # of poses to each drone, at most [Hz]
    deviation: tuple[float, float] = (0.01, 0.05)  # standard deviations, position [m] and attitude [rad]
    options: dict[str, str] = field(default_factory=dict)  # further arguments of the package for this kind

    def given(self) -> dict[str, str]:
        """Arguments for the package `motioncapture`. Raises MocapError for a host without an address."""
        host = self.host
        if self.kind == "optitrack":  # the package takes IP addresses only
            try:
                host = socket.gethostbyname(host)
            except OSError:
                raise MocapError(f"--mocap-host {host} has no address") from None
        return {"hostname": host, **self.options}


class Source:
    """Reads frames from a child process in a thread, which calls `take`."""

    def __init__(self, settings: MocapSettings, take: Callable[[Frame], None]):
        """Start the process and the thread. Raises MocapError if the package is missing."""
        if importlib.util.find_spec("motioncapture") is None:
            raise MocapError("motioncapture is not installed; pip install 'mjxball[mocap]'")
        self._take = take
        self.names: list[str] = []  # of all bodies seen so far
        self.failure = ""  # why reading has ended
        self._stopping = False
        arguments = [settings.kind, f"{settings.rate}", *settings.bodies, json.dumps(settings.given())]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mjxfly.mocap_child", "--", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the runner
        )
        self._thread = threading.Thread(target=self._read_all, name="mocap", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Kill the child and end its thread."""
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
            received = os.read(pipe, 65536) if readable else None
            if received == b"":
                self.failure = self.failure or "its reader ended"
                return
            *lines, waiting = (waiting + (received or b"")).split(b"\n")
            for line in lines:
                self._line(parse_json(line))

    def _line(self, what: Any) -> None:
        if isinstance(what, dict):
            self.names = what.get("names", self.names)
            self.failure = what.get("error", self.failure)
            return
        poses = [None if one is None else pose_of(one[0], one[1:]) for one in what]
        self._take((poses[0], poses[1]))


class Mocap:
    """Checks and forwards the poses of both bodies, see the module. A context manager."""

    def __init__(self, settings: MocapSettings, span: np.ndarray, limits: MocapLimits = LIMITS):
        """`span` (3,) [m] is the leader's position relative to the follower in body axes."""
        self.settings, self.limits = settings, limits
        self.tracks: Tracks = (Track(), Track())  # replaced as a whole, by the reader's thread alone
        self._span = span
        self._links: list[Link | None] = [None, None]
        self.note: Note = lambda kind, t=None, **fields: None  # logs gaps and forwarded poses
        self._halted = False
        self.guarding = False  # drop poses far from the drone's estimate, which must have converged to them before
        self._noted = [-math.inf, -math.inf]
        self._gap = [False, False]
        self._source: Source | None = None

    def __enter__(self) -> Mocap:
        """Start reading. Raises MocapError if the package is missing."""
        self._source = Source(self.settings, self.take)
        return self

    def __exit__(self, *_: object) -> None:
        if self._source is not None:
            self._source.close()

    # Before the drones are connected.

    def wait_ready(self) -> None:
        """Wait until both bodies are seen and their poses fit a standing pair. Raises MocapError within about 6 s."""
        source, bounds, host = self._source, self.limits, self.settings.host
        assert source is not None
        where = f"the motion capture ({self.settings.kind}{' at ' + host if host else ''})"
        wait_until(lambda: bool(source.names or source.failure), bounds.answer)
        wait_until(lambda: all(track.received for track in self.tracks) or not source.names, bounds.appear)
        if source.failure:
            raise MocapError(f"{where} cannot be read: {source.failure}")
        if not source.names:
            raise MocapError(f"{where} does not answer with any body within {bounds.answer:g} s")
        for name, track in zip(self.settings.bodies, self.tracks, strict=True):
            if not track.received and name in source.names:
                raise MocapError(f"{where} sends numbers for {name} that are no pose in metres with a unit quaternion")
            if not track.received:
                known = ", ".join(source.names)
                raise MocapError(f"{where} sends no body named {name}, or does not see it; it sends: {known}")
        if fault := self._watch():
            raise MocapError(f"{where} cannot be flown on: {fault}")

    def _watch(self) -> str:
        """Fault of the poses of a standing pair within `limits.measure` seconds, empty if there is none."""
        before, bounds = self.tracks, self.limits
        clock.sleep(bounds.measure)
        both = list(zip(before, self.tracks, strict=True))
        one, other = (dataclasses.replace(new, jumps=new.jumps - old.jumps) for old, new in both)
        fault = supervision.standing_fault((one, other), clock.now(), bounds, self._span)
        if fault:
            return fault
        slow = min((new.received - old.received) / bounds.measure for old, new in both)
        return f"its poses come at {slow:.0f} Hz, {bounds.rate:.0f} are needed" if slow < bounds.rate else ""

    # Once a drone's link is open.

    def parameters(self) -> dict[str, float]:
        """Firmware parameters for each drone: Kalman estimator, standard deviations of the poses."""
        position, attitude = self.settings.deviation
        return {"stabilizer.estimator": KALMAN, "locSrv.extPosStdDev": position, "locSrv.extQuatStdDev": attitude}

    def feed(self, number: int, link: Link) -> None:
        """Forward the poses of body `number` (0 leader, 1 follower) to `link` from now on."""
        self._links[number] = link

    def checks(self) -> list[Check]:
        """Preflight checks of poses and estimates; takes `limits.measure` seconds."""
        fault, now = self._watch(), clock.now()
        found = [Check("motion capture", not fault, fault or "both bodies in place")]
        for name, track, place in zip(NAMES, self.tracks, self._places(now), strict=True):
            error = math.dist(place, track.last.position) if place is not None and track.last is not None else math.inf
            text = f"{1000 * error:.0f} mm from the drone's estimate"
            found.append(Check(f"{name} pose", error <= self.limits.disagreement, text))
        return found

    # In flight.

    def faults(self, now: float) -> list[Fault]:
        """Faults of the poses at `now` [s]; logs beginnings and ends of gaps. Never blocks."""
        tracks = self.tracks
        for number, track in enumerate(tracks):
            gap = track.age(now) > self.limits.age
            if gap != self._gap[number]:
                self._gap[number] = gap
                text = track.reason or "none came"
                self.note("gap", drone=NAMES[number], begins=gap, age=track.age(now), text=text if gap else "")
        return supervision.faults(tracks, now, self.limits)

    def halt(self) -> None:
        """Stop forwarding poses that are in wrong axes: without them an estimator keeps its attitude for longer."""
        self._halted = True

    def take(self, frame: Frame, now: float | None = None) -> None:
        """Check one frame and forward its valid poses, in the reader's thread."""
        before, now = self.tracks, clock.now() if now is None else now
        places = self._places(now) if self.guarding else (None, None)
        after = supervision.follow(before, frame, self.limits, self._span, places)
        self.tracks = after
        for number, (old, new) in enumerate(zip(before, after, strict=True)):
            if new.good is not None and new.good is not old.good:
                self._forward(number, new.good, now)

    def _forward(self, number: int, pose: Pose, now: float) -> None:
        if (link := self._links[number]) is None or self._halted:
            return
        link.pose(packets.pose_packet(pose.position, pose.quaternion))
        if now - self._noted[number] >= 0.75 * NOTE_PERIOD:
            self._noted[number] = now
            age, where = now - pose.time, pose.position
            self.note("pose", drone=NAMES[number], age=age, position=where, quaternion=pose.quaternion)

    def _places(self, now: float) -> list[Sequence[float] | None]:
        """Position of each drone by its own estimator (3,) [m], None if there is no recent one."""
        places: list[Sequence[float] | None] = []
        for link in self._links:
            newest = None if link is None else link.telemetry.newest
            young = newest is not None and now - newest.arrival <= self.limits.age
            places.append(tuple(map(float, newest.state.position)) if newest is not None and young else None)
        return places


@contextlib.contextmanager
def ready(settings: MocapSettings, span: np.ndarray, limits: MocapLimits = LIMITS) -> Iterator[Mocap]:
    """A `Mocap` after `wait_ready`. Raises MocapError."""
    with Mocap(settings, span, limits) as mocap:
        mocap.wait_ready()
        yield mocap
