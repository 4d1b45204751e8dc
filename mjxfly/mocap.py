"""Motion capture: poses of both drones' bodies, supervised and forwarded to the drones' estimators over our own links.

How it is used: `ready(settings, span)` as a context manager, before anything is connected; `parameters` and then `feed`
for each drone once its link is open; `checks` before flight; `guarding` when they passed; `faults` at every tick.
Frames come from a child process that may hang or crash without hurting a flight; poses go out in the thread that reads
it, not through the control loop.
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

BUILT = ("vicon", "optitrack", "qualisys", "vrpn", "mock")  # what the package on PyPI was built with
KINDS = (*BUILT, "optitrack_closed_source", "nokov", "motionanalysis", "fzmotion")
LIMITS = MocapLimits()
NOTE_PERIOD = 0.02  # [s] between two poses of a drone in the log
KALMAN = 2  # of the firmware's parameter stabilizer.estimator


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
    """The child process and the thread that reads it, in which `take` is called."""

    def __init__(self, settings: MocapSettings, take: Callable[[Frame], None]):
        """Start both. Raises MocapError if the package is missing."""
        if importlib.util.find_spec("motioncapture") is None:
            raise MocapError("motioncapture is not installed; pip install 'mjxball[mocap]'")
        self._take = take
        self.names: list[str] = []  # of all bodies that were seen
        self.failure = ""  # why no more frames will come
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
    """See the module. A context manager."""

    def __init__(self, settings: MocapSettings, span: np.ndarray, limits: MocapLimits = LIMITS):
        """`span` (3,) [m] is leader from follower in body axes."""
        self.settings, self.limits = settings, limits
        self.tracks: Tracks = (Track(), Track())  # replaced as a whole, by the reader's thread alone
        self._span = span
        self._links: list[Link | None] = [None, None]
        self.note: Note = lambda kind, t=None, **fields: None  # the log's, of gaps and of what is forwarded
        self._halted = False
        self.guarding = False  # a pose far from the drone's own estimate is not sent; before, the estimate follows it
        self._noted = [-math.inf, -math.inf]
        self._gap = [False, False]
        self._source: Source | None = None

    def __enter__(self) -> Mocap:
        """Begin to read. Raises MocapError without the package."""
        self._source = Source(self.settings, self.take)
        return self

    def __exit__(self, *_: object) -> None:
        if self._source is not None:
            self._source.close()

    # Before the drones are connected.

    def wait_ready(self) -> None:
        """Return once both bodies stand where they may be flown from. Raises MocapError, within about 6 s."""
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
        """Why the pair cannot be flown on what comes within `limits.measure`, empty if it can."""
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
        """Parameters that each drone's firmware needs: Kalman estimator, deviations of poses."""
        position, attitude = self.settings.deviation
        return {"stabilizer.estimator": KALMAN, "locSrv.extPosStdDev": position, "locSrv.extQuatStdDev": attitude}

    def feed(self, number: int, link: Link) -> None:
        """Forward the poses of body `number` (0 leader, 1 follower) to `link` from now on."""
        self._links[number] = link

    def checks(self) -> list[Check]:
        """What must hold of poses and estimates before the motors may turn; takes `limits.measure` seconds."""
        fault, now = self._watch(), clock.now()
        found = [Check("motion capture", not fault, fault or "both bodies in place")]
        for name, track, place in zip(NAMES, self.tracks, self._places(now), strict=True):
            error = math.dist(place, track.last.position) if place is not None and track.last is not None else math.inf
            text = f"{1000 * error:.0f} mm from the drone's estimate"
            found.append(Check(f"{name} pose", error <= self.limits.disagreement, text))
        return found

    # In flight.

    def faults(self, now: float) -> list[Fault]:
        """What is wrong with the poses at `now` [s]; never blocks."""
        tracks = self.tracks
        for number, track in enumerate(tracks):
            gap = track.age(now) > self.limits.age
            if gap != self._gap[number]:
                self._gap[number] = gap
                text = track.reason or "none came"
                self.note("gap", drone=NAMES[number], begins=gap, age=track.age(now), text=text if gap else "")
        return supervision.faults(tracks, now, self.limits)

    def halt(self) -> None:
        """Send no more poses: they are in wrong axes, and without any an estimator knows its attitude for longer."""
        self._halted = True

    def take(self, frame: Frame, now: float | None = None) -> None:
        """One frame, in the reader's thread: check it, send what is fit to be sent."""
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
        """Where each drone's estimator has it [m], None if that is not known or old."""
        places: list[Sequence[float] | None] = []
        for link in self._links:
            newest = None if link is None else link.telemetry.newest
            young = newest is not None and now - newest.arrival <= self.limits.age
            places.append(tuple(map(float, newest.state.position)) if newest is not None and young else None)
        return places


@contextlib.contextmanager
def ready(settings: MocapSettings, span: np.ndarray, limits: MocapLimits = LIMITS) -> Iterator[Mocap]:
    """A `Mocap` that may be flown on. Raises MocapError."""
    with Mocap(settings, span, limits) as mocap:
        mocap.wait_ready()
        yield mocap
