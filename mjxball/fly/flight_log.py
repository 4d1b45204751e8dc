"""The flight log: a file of JSON lines, with one writer and one reader.

Every line has "t", seconds of the monotonic clock, and "kind"; `log_schema` says which kinds there are. `Journal`
writes in a thread of its own and flushes as it goes, so that the log is readable after a kill -9. `Tail` reads a log
that grows, `read` a whole one, `load` the flight in it.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.firmware_gains import PairGains
from mjxball.errors import InputError
from mjxball.fly.command import CURVE_NAMES, CurveName
from mjxball.fly.flown import RECORDS, Flown
from mjxball.fly.limits import NAMES
from mjxball.fly.log_schema import SCHEMA, Record, decode
from mjxball.fly.packets import DroneState

SYNC_PERIOD = 1.0  # [s] between two fsyncs: a killed process loses nothing that was flushed, a power cut this much
CHUNK = 2**20  # bytes read at once
LONGEST_LINE = 2**20  # bytes
SILENCE = 0.1  # [s] between two states of a drone from which on the log has a gap
FROZEN = 0.25  # [s] of equal states from which on an estimator counts as frozen while the laws are in command
GUIDED = "fly"  # the supervisor's state in which both laws fly


class Journal:
    """Takes notes from any thread without ever blocking it. A context manager."""

    def __init__(self, path: Path | None, **header: Any):
        """Open the new file `path` (None: keep nothing); raise OSError if it exists or cannot be written."""
        self._stream = path.open("x", encoding="utf-8") if path else None
        self._queue: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="journal", daemon=True)
        self.failure: str | None = None
        self.note("header", schema=SCHEMA, wall=time.time(), pid=os.getpid(), **header)
        self._thread.start()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        """Add one record of a `kind` in `log_schema.KINDS`; returns at once."""
        if self._stream is not None:
            self._queue.put({"t": time.monotonic() if t is None else t, "kind": kind, **fields})

    def close(self) -> None:
        """Write what waits and close the file."""
        self._queue.put(None)
        self._thread.join(timeout=5)

    def _write_all(self) -> None:
        synced, done = time.monotonic(), False
        while not done:
            records = [self._queue.get()]
            with contextlib.suppress(queue.Empty):
                while True:
                    records.append(self._queue.get_nowait())
            done = None in records
            text = "".join(json.dumps(record, default=_plain) + "\n" for record in records if record is not None)
            try:
                if self._stream is not None and text:
                    self._stream.write(text)
                    self._stream.flush()
                    if time.monotonic() - synced > SYNC_PERIOD:
                        os.fsync(self._stream.fileno())
                        synced = time.monotonic()
            except OSError as error:  # a full disk must not end a flight
                self.failure = error.strerror or str(error)
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()


def _plain(value: Any) -> Any:
    """JSON for NumPy's arrays and numbers."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


class Tail:
    """Reads a log while it grows; it need not exist yet. The first record that it gives is the header."""

    def __init__(self, path: Path):
        self.path = path
        self.damaged: list[str] = []  # one sentence for each line that is no record of the schema, without a full stop
        self._stream: BinaryIO | None = None
        self._rest, self._lines, self._begun = b"", 0, False

    def read(self) -> list[Record] | None:
        """The records that were added, a chunk at most; None if nothing was. A torn last line waits for its rest.

        Lines that are no records of the schema are left out. Raises InputError: this is no flight log, or one of
        another schema, or of a firmware whose force curve is not known.
        """
        try:
            added = self._added()
        except OSError as error:
            raise InputError(f"flight log {self.path} cannot be read: {error.strerror or error}") from None
        if not added:
            return None
        *lines, self._rest = (self._rest + added).split(b"\n")
        records = [record for line in lines if (record := self._take(line)) is not None]
        if len(self._rest) > LONGEST_LINE:
            raise InputError(f"{self.path} is not a flight log: it holds a line of more than {LONGEST_LINE >> 20} MiB")
        return records

    def close(self) -> None:
        """Close the log."""
        if self._stream:
            self._stream.close()

    @property
    def torn(self) -> bool:
        """Whether the last line has no end."""
        return bool(self._rest)

    def _added(self) -> bytes:
        if self._stream is None:
            if not self.path.exists():
                return b""
            if not self.path.is_file():  # a pipe or a device would be waited for
                raise InputError(f"{self.path} is not a flight log: it is no file")
            self._stream = self.path.open("rb")
        return self._stream.read(CHUNK)

    def _take(self, line: bytes) -> Record | None:
        self._lines += 1
        try:
            raw = json.loads(line)
        except (ValueError, RecursionError):
            raw = None
        sound = isinstance(raw, dict) and "t" in raw and "kind" in raw
        if not self._begun:
            return self._header(raw if sound else {})
        try:
            if not sound:
                raise ValueError("it is no record")
            record = decode(raw)
        except ValueError as error:
            self.damaged.append(f"line {self._lines} is damaged: {error}")
            return None
        return self._known(record)

    def _header(self, raw: dict[str, Any]) -> Record | None:
        if raw.get("kind") != "header":
            raise InputError(f"{self.path} is not a flight log: it does not begin with a header")
        if raw.get("schema") != SCHEMA:
            found = json.dumps(raw.get("schema", 1))[:20]
            raise InputError(
                f"flight log {self.path} has schema version {found}, this mjxball reads {SCHEMA}: "
                "use the mjxball that wrote it"
            )
        try:
            header = decode(raw)
        except ValueError as error:
            raise InputError(f"flight log {self.path} cannot be read: {error}") from None
        assert header is not None
        self._begun = True
        return self._known(header)

    def _known(self, record: Record | None) -> Record | None:
        """`record` itself, unless what flew cannot be told by it."""
        if record is not None and record["kind"] in ("header", "thrust"):
            curve = record.get("curve", CURVE_NAMES[0])
            if curve not in CURVE_NAMES:
                raise InputError(
                    f"flight log {self.path} is of a firmware with the force curve {curve[:20]!r}, which is not known; "
                    f"this mjxball knows {' and '.join(CURVE_NAMES)}"
                )
        return record


def read(path: Path, remark: Callable[[str], None] | None = None) -> Iterator[Record]:
    """Every record of a whole log, the header first; a torn last one is left out, as is any line that is no record.

    What is left out is told to `remark`. Raises InputError with one sentence if there is no log.
    """
    if not path.exists():
        raise InputError(f"flight log {path} cannot be read: No such file or directory")
    with contextlib.closing(Tail(path)) as tail:
        begun = False
        while (records := tail.read()) is not None:
            begun = begun or bool(records)
            yield from records
        if not begun:
            raise InputError(f"{path} is not a flight log: it {'ends within its header' if tail.torn else 'is empty'}")
        if remark and tail.torn:
            remark("its last line is cut short")
        if remark and tail.damaged:
            more = len(tail.damaged) - 1
            remark(tail.damaged[0] + (f", as are {more} more" if more else ""))


class Outage(NamedTuple):
    """A time in which a drone's states say nothing."""

    drone: str
    frozen: bool  # equal states came; else none
    begin: float  # [s] of the log's clock
    end: float


class FlightLog(NamedTuple):
    """A log that holds a flight, from where its motors are first told to turn to its last tick."""

    path: Path
    policy: str
    config: Config
    curves: tuple[CurveName, CurveName]  # of leader's and follower's firmware
    gains: PairGains  # that they flew with
    records: tuple[Record, ...]  # ticks and states alone, in the order of time; the states in force come first
    outages: tuple[Outage, ...]
    remarks: tuple[str, ...]  # half a sentence each: what a reader should know who relies on it

    def told(self) -> Iterator[str]:
        """The remarks as lines for a terminal."""
        return (f"{self.path.name}: {remark}" for remark in self.remarks)


def load(path: Path) -> FlightLog:
    """The flight in the whole log `path`. Raises InputError with one sentence if there is none."""
    remarks: list[str] = []
    header, *records = read(path, remarks.append)
    settings = header.get("settings")
    if isinstance(settings, dict) and settings.get("dry_run") is True:
        raise InputError(f"flight log {path} holds no flight: it is of a dry run")
    rows = sorted((one for one in records if one["kind"] in ("tick", "state")), key=lambda one: float(one["t"]))
    turning = [one["t"] for one in rows if one["kind"] == "tick" and one["sent"][:, 3].max() > 0]
    if not turning:
        why = f"; {remarks[-1]}" if remarks else ""
        raise InputError(f"flight log {path} holds no flight: no motor was ever told to turn{why}")
    last = max(one["t"] for one in rows if one["kind"] == "tick")
    before = _newest_before(rows, turning[0])
    flown = (*before, *(one for one in rows if turning[0] <= one["t"] <= last))
    for drone in NAMES:
        if not any(one["kind"] == "state" and one["drone"] == drone for one in flown):
            raise InputError(f"flight log {path} holds no flight: it has no state of the {drone}")
    if not any(one["kind"] == "end" for one in records):
        remarks.append("it has no end: the runner was killed, or the log was cut")
    found = _outages(flown, turning[-1])
    remarks += [_sentence(gap, turning[0]) for gap in found]
    with_what = Flown.of(header)
    for one in records:
        with_what = with_what.after(one, header["config"]) if one["kind"] in RECORDS else with_what
    policy = header["policy"][:80]
    return FlightLog(path, policy, header["config"], *with_what, flown, found, tuple(remarks))


def outages(drone: str, time: np.ndarray, states: np.ndarray, end: float) -> list[Outage]:
    """Where the rows of `states` (S, n) at `time` (S,) leave a gap, or do not change for long, until `end`."""
    edges = np.append(time, max(end, time[-1]))
    gaps = [(edges[k], edges[k + 1]) for k in np.flatnonzero(np.diff(edges) > SILENCE)]
    changes = np.flatnonzero((np.diff(states, axis=0) != 0).any(axis=1)) + 1
    runs = zip([0, *changes], [*(changes - 1), len(time) - 1], strict=True)
    kept = [(time[a], min(time[b], end)) for a, b in runs if min(time[b], end) - time[a] > FROZEN]
    return [
        Outage(drone, frozen, float(begin), float(over))
        for frozen, spans in ((False, gaps), (True, kept))
        for begin, over in spans
    ]


def numbers(state: DroneState) -> np.ndarray:
    """(13,) position, velocity, quaternion (w, x, y, z), body rates."""
    return np.concatenate([state.position, state.velocity, state.quaternion, state.rates])


def _outages(rows: tuple[Record, ...], stopped: float) -> tuple[Outage, ...]:
    """Gaps until the motors have `stopped`; equal states while the laws are in command, since a pair may rest."""
    guided = [one["t"] for one in rows if one["kind"] == "tick" and one["state"] == GUIDED]
    found = []
    for drone in NAMES:
        own = [one for one in rows if one["kind"] == "state" and one["drone"] == drone]
        time, states = np.array([one["t"] for one in own]), np.array([numbers(one["raw"].state) for one in own])
        found += [gap for gap in outages(drone, time, states, stopped) if not gap.frozen]
        if guided and (within := (time >= guided[0]) & (time <= guided[-1])).any():
            found += [gap for gap in outages(drone, time[within], states[within], guided[-1]) if gap.frozen]
    return tuple(sorted(found, key=lambda gap: gap.begin))


def _newest_before(rows: list[Record], time: float) -> list[Record]:
    """Each drone's last state before `time`."""
    newest = {one["drone"]: one for one in rows if one["kind"] == "state" and one["t"] < time}
    return sorted(newest.values(), key=lambda one: float(one["t"]))


def _sentence(gap: Outage, start: float) -> str:
    what = f"the {gap.drone}'s estimate is frozen" if gap.frozen else f"there is no state of the {gap.drone}"
    return f"{what} for {gap.end - gap.begin:.2f} s from {max(gap.begin - start, 0.0):.1f} s on"
