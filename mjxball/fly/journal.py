"""The flight log: one file of JSON lines, written and flushed by a thread of its own, readable after a kill -9.

Every line has "t", seconds of the monotonic clock, and "kind". The first is the header with the wall clock.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

FORMAT = 1
SYNC_PERIOD = 1.0  # [s] between two fsyncs: a killed process loses nothing that was flushed, a power cut this much


class Journal:
    """Takes notes from any thread without ever blocking it. A context manager."""

    def __init__(self, path: Path | None, **header: Any):
        """Open the new file `path` (None: keep nothing); raise OSError if it exists or cannot be written."""
        self._stream = path.open("x", encoding="utf-8") if path else None
        self._queue: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="journal", daemon=True)
        self.failure: str | None = None
        self.note("header", format=FORMAT, wall=time.time(), pid=os.getpid(), **header)
        self._thread.start()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        """Add one record; returns at once."""
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


def read(path: Path) -> Iterator[dict[str, Any]]:
    """Every whole record of a flight log; a torn last one, or any line that is no record, is skipped."""
    with path.open("rb") as stream:
        for line in stream:
            if not line.endswith(b"\n"):
                return
            with contextlib.suppress(ValueError, RecursionError):
                record = json.loads(line)
                if isinstance(record, dict) and "t" in record and "kind" in record:
                    yield record
