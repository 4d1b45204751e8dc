"""Motion capture: poses of both drones' bodies, supervised and forwarded to the drones' estimators over our own links.

How it is used: `Mocap(settings, span)` as a context manager; `wait_ready` before anything is connected; `parameters`
and then `feed` for each drone once its link is open; `checks` before flight; `guard` when they passed; `faults` at
every tick. Poses go out in the reader's thread, beside the loop and never through it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjxball.errors import InputError
from mjxball.fly import mocap_supervision as supervision
from mjxball.fly import packets
from mjxball.fly.limits import NAMES
from mjxball.fly.mocap_source import KINDS, MocapError, MocapSettings, Source, wait_until
from mjxball.fly.mocap_supervision import Frame, MocapLimits, Pose, Track, Tracks
from mjxball.fly.packets import Packet
from mjxball.fly.supervisor import Fault
from mjxball.fly.telemetry import Telemetry

LIMITS = MocapLimits()
NOTE_PERIOD = 0.02  # [s] between two poses of a drone in the log
DONGLE = re.compile(r"radio://([^/]+)/")


class PoseLink(Protocol):
    """What forwarding needs of `link.Link`."""

    telemetry: Telemetry

    def pose(self, packet: Packet) -> None:
        """Newest pose, behind any setpoint, without blocking."""


class PoseCheck(NamedTuple):
    """One check before flight and how it went: the fields of `preflight.Check`."""

    name: str
    passed: bool
    found: str


class Mocap:
    """See the module. A context manager."""

    def __init__(self, settings: MocapSettings, span: np.ndarray, limits: MocapLimits = LIMITS):
        """`span` (3,) [m] is leader from follower in body axes."""
        self.settings, self.limits = settings, limits
        self.tracks: Tracks = (Track(), Track())  # replaced as a whole, by the reader's thread alone
        self.sent = [0, 0]
        self._span = span
        self._links: list[PoseLink | None] = [None, None]
        self._note: Callable[..., None] = lambda kind, t=None, **fields: None
        self._noted = [-math.inf, -math.inf]
        self._gap = [False, False]
        self._guarding = False
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
        where, bounds = self._where(), self.limits
        source = self._source
        assert source is not None
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
        fault = self._watch()
        if fault:
            raise MocapError(f"{where} cannot be flown on: {fault}")

    def _where(self) -> str:
        kind, host = self.settings.kind, self.settings.host
        return f"the motion capture ({kind}{' at ' + host if host else ''})"

    def _watch(self) -> str:
        """Why the pair cannot be flown on what comes within `limits.measure`, empty if it can."""
        before, bounds = self.tracks, self.limits
        time.sleep(bounds.measure)
        after = self.tracks
        moved = [dataclasses.replace(new, jumps=new.jumps - old.jumps) for old, new in zip(before, after, strict=True)]
        fault = supervision.standing_fault((moved[0], moved[1]), time.monotonic(), bounds, self._span)
        if fault:
            return fault
        rates = [(new.received - old.received) / bounds.measure for old, new in zip(before, after, strict=True)]
        slow = min(rates)
        return f"its poses come at {slow:.0f} Hz, {bounds.rate:.0f} are needed" if slow < bounds.rate else ""

    # Once a drone's link is open.

    def parameters(self) -> dict[str, float]:
        """What each drone's firmware must be told: Kalman estimator, deviations of poses."""
        position, attitude = self.settings.deviation
        return {"stabilizer.estimator": 2.0, "locSrv.extPosStdDev": position, "locSrv.extQuatStdDev": attitude}

    def log(self, note: Callable[..., None]) -> None:
        """Tell `note`, the log's, of gaps and of what is forwarded."""
        self._note = note

    def feed(self, number: int, link: PoseLink) -> None:
        """Forward the poses of body `number` (0 leader, 1 follower) to `link` from now on."""
        self._links[number] = link

    def checks(self) -> list[PoseCheck]:
        """What must hold of poses and estimates before the motors may turn; takes `limits.measure` seconds."""
        fault, now = self._watch(), time.monotonic()
        found = [PoseCheck("motion capture", not fault, fault or "both bodies in place")]
        for name, track, place in zip(NAMES, self.tracks, self._places(now), strict=True):
            error = math.dist(place, track.last.position) if place is not None and track.last is not None else math.inf
            text = f"{1000 * error:.0f} mm from the drone's estimate"
            found.append(PoseCheck(f"{name} pose", error <= self.limits.disagreement, text))
        return found

    # In flight.

    def guard(self) -> None:
        """From now on a pose far from the drone's own estimate is not sent: before, the estimate followed the poses."""
        self._guarding = True

    def faults(self, now: float) -> list[Fault]:
        """What is wrong with the poses at `now` [s]; never blocks."""
        tracks = self.tracks
        for number, track in enumerate(tracks):
            gap = track.age(now) > self.limits.age
            if gap != self._gap[number]:
                self._gap[number] = gap
                text = track.reason or "none came"
                self._note("gap", drone=NAMES[number], begins=gap, age=track.age(now), text=text if gap else "")
        return supervision.faults(tracks, now, self.limits)

    def take(self, frame: Frame, now: float | None = None) -> None:
        """One frame, in the reader's thread: judge it, send what is fit to be sent."""
        before, now = self.tracks, time.monotonic() if now is None else now
        places = self._places(now) if self._guarding else (None, None)
        after = supervision.follow(before, frame, self.limits, self._span, places)
        self.tracks = after
        for number, (old, new) in enumerate(zip(before, after, strict=True)):
            if new.good is not None and new.good is not old.good:
                self._forward(number, new.good, now)

    def _forward(self, number: int, pose: Pose, now: float) -> None:
        link = self._links[number]
        if link is None:
            return
        link.pose(packets.pose_packet(pose.position, pose.quaternion))
        self.sent[number] += 1
        if now - self._noted[number] >= 0.75 * NOTE_PERIOD:
            self._noted[number] = now
            where: Mapping[str, Any] = {"position": pose.position, "quaternion": pose.quaternion}
            self._note("pose", drone=NAMES[number], age=now - pose.time, **where)

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


# The command line.


def add_flags(parser: argparse.ArgumentParser) -> None:
    """The flags of motion capture."""
    parser.add_argument("--mocap", choices=KINDS, metavar="KIND", help=f"forward poses from: {', '.join(KINDS)}")
    parser.add_argument("--mocap-host", metavar="HOST", help="--mocap: its server; optitrack: as numbers")
    parser.add_argument("--bodies", nargs=2, metavar=("LEADER", "FOLLOWER"), help="--mocap: names of the rigid bodies")
    parser.add_argument("--mocap-rate", type=float, metavar="HZ", help="--mocap: poses to each drone, 50 to 100")
    parser.add_argument(
        "--mocap-std", type=float, nargs=2, metavar=("M", "RAD"), help="--mocap: deviations told the estimators"
    )
    parser.add_argument(
        "--mocap-option", action="append", default=[], metavar="KEY=VALUE", help="--mocap: more, such as port=22222"
    )


def settings_of(options: argparse.Namespace) -> MocapSettings | None:
    """What the flags ask for, None without --mocap. Raises InputError for anything unsound."""
    others = ("mocap_host", "bodies", "mocap_rate", "mocap_std", "mocap_option")
    if options.mocap is None:
        for name in others:
            if getattr(options, name):
                raise InputError(f"--{name.replace('_', '-')} needs --mocap KIND")
        return None
    if options.rehearse:
        raise InputError("--mocap is for drones that the cameras see: leave it out with --rehearse")
    if options.mocap_host is None and options.mocap != "mock":
        raise InputError(f"--mocap {options.mocap} needs --mocap-host HOST")
    if options.bodies is None:
        raise InputError("--mocap needs --bodies LEADER FOLLOWER, the names of the two rigid bodies")
    if options.bodies[0] == options.bodies[1]:
        raise InputError("--bodies names one body for both drones")
    rate = options.mocap_rate or default_rate((options.leader, options.follower))
    if not 50 <= rate <= 100:
        raise InputError(f"--mocap-rate must be 50 to 100, not {rate:g}")
    deviation = tuple(options.mocap_std or MocapSettings.deviation)
    if not all(1e-4 <= value <= 1 for value in deviation):
        raise InputError("--mocap-std must be two numbers of 0.0001 to 1")
    pairs = [text.partition("=") for text in options.mocap_option]
    for text, (key, sign, _) in zip(options.mocap_option, pairs, strict=True):
        if not key or not sign:
            raise InputError(f"--mocap-option {text} is no KEY=VALUE")
    more = {key: value for key, _, value in pairs}
    bodies = (options.bodies[0], options.bodies[1])
    return MocapSettings(options.mocap, options.mocap_host or "", bodies, rate, (deviation[0], deviation[1]), more)


def default_rate(uris: Sequence[str | None]) -> float:
    """Poses a second to each drone: 100, and 50 where both share one dongle, which 400 packets a second would fill."""
    dongles = [DONGLE.match(uri or "") for uri in uris]
    shared = dongles[0] and dongles[1] and dongles[0][1] == dongles[1][1]
    return 50.0 if shared else 100.0


__all__ = ["Mocap", "MocapError", "MocapSettings", "add_flags", "ready", "settings_of"]
