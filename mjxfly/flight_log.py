"""The flight log: a file of JSON lines, with one writer and one reader.

Every line has "t", seconds of the monotonic clock, and "kind", one of `log_schema.KINDS`. `Journal` writes in a
separate thread and flushes after each batch, so that the log is readable after a kill -9. `Tail` reads a growing log,
`read` a whole one or a recording of another program (`log_import`); `recording` turns the records into arrays.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.files import is_utf16
from mjxball.reading import parse_json, time_fault
from mjxfly import clock, log_import
from mjxfly.log_schema import SCHEMA, Record, decode
from mjxfly.setpoints import CURVE_NAMES

SYNC_PERIOD = 1.0  # [s] between two fsyncs: a killed process loses nothing that was flushed, a power cut this much
CHUNK = 2**20  # bytes read at once
LONGEST_LINE = 2**20  # bytes
STREAMS = ("tick", "state", "health")  # periodic kinds, one stream per drone, whose times must increase


class Journal:
    """Writes the flight log. Any thread may add records without blocking. A context manager."""

    def __init__(self, path: Path | None, **header: Any):
        """Create the file `path` (None: keep nothing). Raises OSError if it exists or cannot be written.

        A file that ends in .mcap is written by a separate process, `log_export`.
        """
        self._recorder = _start_recorder(path) if path and path.suffix == ".mcap" else None
        if self._recorder is not None:
            self._stream = self._recorder.stdin
        else:
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
        """Queue one record of a `kind` in `log_schema.KINDS`; returns at once."""
        if self._stream is not None:
            self._queue.put({"t": clock.now() if t is None else t, "kind": kind, **fields})

    def close(self) -> None:
        """Write the queued records and close the file."""
        self._queue.put(None)
        self._thread.join(timeout=5)
        if self._recorder is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._recorder.wait(timeout=5)

    def _write_all(self) -> None:
        synced, done = time.monotonic(), False
        while not done:
            records = [self._queue.get()]
            with contextlib.suppress(queue.Empty):
                while True:
                    records.append(self._queue.get_nowait())
            done = None in records
            text = "".join(json.dumps(record, default=_to_json) + "\n" for record in records if record is not None)
            try:
                if self._stream is not None and text:
                    self._stream.write(text)
                    self._stream.flush()
                    if self._recorder is None and time.monotonic() - synced > SYNC_PERIOD:
                        os.fsync(self._stream.fileno())
                        synced = time.monotonic()
            except OSError as error:  # a full disk must not end a flight
                self.failure = error.strerror or str(error)
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()


def _start_recorder(path: Path) -> subprocess.Popen[str]:
    """A process that writes the lines on its input as the MCAP file `path`. It ends with its input, not by Ctrl-C."""
    with path.open("xb") as file:
        command = [sys.executable, "-m", "mjxfly.log_export"]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=file, start_new_session=True, encoding="utf-8")


def _to_json(value: Any) -> Any:
    """NumPy arrays and scalars as Python values for JSON."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


class Tail:
    """Reads a log while it grows; the file need not exist yet. The first record returned is the header."""

    def __init__(self, path: Path, stream: BinaryIO | None = None):
        """Read the file `path`, or the open `stream`; messages then call it `path`."""
        self.path = path
        self.lines: list[bytes] = []  # of the records returned last
        self.damaged: list[str] = []  # a message for each line that is not a record of the schema
        self._stream = stream
        self.misplaced: str | None = None  # message on the first record whose time goes back
        self._rest, self._lines, self._begun = b"", 0, False
        self._times: dict[tuple[str, Any], float] = {}  # [s] of the newest record of every stream

    def read(self) -> list[Record] | None:
        """New records, from at most `CHUNK` bytes; None if the file has not grown. An incomplete last line is kept.

        Lines that are not records of the schema are skipped, and so are streamed records whose time does not increase.
        Raises InputError if this is no flight log, or has another schema or an unknown force curve.
        """
        try:
            added = self._added()
        except OSError as error:
            raise InputError(f"flight log {self.path} cannot be read: {error.strerror or error}") from None
        self.lines = []
        if not added:
            return None
        *lines, self._rest = (self._rest + added).split(b"\n")
        found = [(line, record) for line in lines if (record := self._take(line)) is not None]
        self.lines, records = [line for line, _ in found], [record for _, record in found]
        if len(self._rest) > LONGEST_LINE:
            raise InputError(f"{self.path} is not a flight log: it holds a line of more than {LONGEST_LINE >> 20} MiB")
        return records

    def close(self) -> None:
        """Close the log."""
        if self._stream:
            self._stream.close()

    @property
    def torn(self) -> bool:
        """Whether the last line is incomplete."""
        return bool(self._rest)

    def _added(self) -> bytes:
        if self._stream is None:
            if not self.path.exists():
                return b""
            if not self.path.is_file():  # reading a pipe or a device would block
                raise InputError(f"{self.path} is not a flight log: it is no file")
            self._stream = self.path.open("rb")
        return self._stream.read(CHUNK)

    def _take(self, line: bytes) -> Record | None:
        self._lines += 1
        try:
            raw = parse_json(line)
        except (ValueError, RecursionError):
            raw = None
        sound = isinstance(raw, dict) and "t" in raw and "kind" in raw
        if not self._begun:
            if is_utf16(line):
                raise InputError(f"{self.path} is not a flight log: it is UTF-16; save it as UTF-8")
            return self._header(raw if sound else {})
        try:
            if not sound:
                raise ValueError("it is no record")
            record = decode(raw)
        except ValueError as error:
            self.damaged.append(f"line {self._lines} is damaged: {error}")
            return None
        return None if record is None or self._is_out_of_order(record) else self._checked(record)

    def _is_out_of_order(self, record: Record) -> bool:
        """Whether `record` is out of order in its stream. Each stream is written in order, by one thread."""
        if record["kind"] == "header":
            self.misplaced = self.misplaced or f"line {self._lines} begins another log"
            return True
        if record["kind"] not in STREAMS:
            return False
        stream, now = (record["kind"], record.get("drone")), record["t"]
        fault = time_fault(self._times.get(stream, -math.inf), now)
        if fault is None:
            self._times[stream] = now
            return False
        said = f"line {self._lines}: {fault} in its {' '.join(filter(None, stream[::-1]))}"
        self.damaged.append(said)
        if now < self._times.get(stream, now):
            self.misplaced = self.misplaced or said
        return True

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
        self._begun = True
        return self._checked(header)

    def _checked(self, record: Record | None) -> Record | None:
        """`record` itself. Raises InputError if it names an unknown force curve."""
        named = record if record is not None and record["kind"] in ("header", "thrust") else {}
        curve = named.get("curve", CURVE_NAMES[0])
        if curve not in CURVE_NAMES:
            raise InputError(
                f"flight log {self.path} is of a firmware with the force curve {curve[:20]!r}, which is not known; "
                f"this mjxball knows {' and '.join(CURVE_NAMES)}"
            )
        return record


def read(path: Path, remark: Callable[[str], None] | None = None, assumed: Config | None = None) -> Iterator[Record]:
    """Every record of a whole log, the header first, without damaged lines, an incomplete last line and duplicates.

    `remark` is called with a note on what was skipped. A recording of another program, which `log_import` reads, is
    taken to be of the rig and gains of `assumed`. Raises InputError with one sentence if there is no log, or if its
    clock goes back, since the time of the rest is then unknown.
    """
    if not log_import.is_foreign(path):
        yield from (record for _, record in read_lines(path, remark))
        return
    found = log_import.read(path, remark or (lambda _: None), assumed)
    if isinstance(found, bytes):
        yield from (record for _, record in read_lines(path, remark, io.BytesIO(found)))
    else:
        yield from found


def read_lines(
    path: Path, remark: Callable[[str], None] | None = None, stream: BinaryIO | None = None
) -> Iterator[tuple[bytes, Record]]:
    """(line, record) for every record of the log in the file `path`, or in `stream`; see `read`."""
    if stream is None and not path.exists():
        raise InputError(f"flight log {path} cannot be read: No such file or directory")
    with contextlib.closing(Tail(path, stream)) as tail:
        begun = False
        while (records := tail.read()) is not None:
            begun = begun or bool(records)
            if tail.misplaced:
                raise InputError(
                    f"flight log {path} cannot be placed in time, {tail.misplaced}: cut it there, into two logs"
                )
            yield from zip(tail.lines, records, strict=True)
        if not begun:
            raise InputError(f"{path} is not a flight log: it {'ends within its header' if tail.torn else 'is empty'}")
        if remark and tail.torn:
            remark("its last line is cut short")
        if remark and tail.damaged:
            more = len(tail.damaged) - 1
            remark(tail.damaged[0] + (f", as are {more} more" if more else ""))
