"""Lock of a run directory: one training at a time. The kernel releases it when its process ends."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from mjxball.errors import InputError
from mjxball.reading import parse_json
from mjxball.running import before_quitting

LOCK = ".lock"  # in the run directory
_held = set[Path]()  # lock files of this process


@contextlib.contextmanager
def held(run: Path) -> Iterator[None]:
    """Lock the run directory `run`, which is created if needed, for this process.

    Raises InputError, which names the holder, if another process holds it, or if the directory cannot be written.
    """
    created = [place for place in (run, *run.parents) if not place.exists()]
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock = _acquired(run / LOCK)
        holder = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%Y-%m-%d %H:%M:%S %z")}
        (run / LOCK).write_text(json.dumps(holder), encoding="ascii")
    except OSError as error:
        raise InputError(f"run directory {run} cannot be written: {error.strerror or error}") from None
    _held.add(run / LOCK)

    def leave() -> None:
        drop()  # before the release, so that a process waiting for the lock notices that the file is gone
        with contextlib.suppress(OSError):
            for place in created:  # removes empty directories only
                place.rmdir()

    before_quitting.append(leave)
    try:
        yield
    finally:
        before_quitting.remove(leave)
        leave()
        lock.release()


def check_free(run: Path) -> None:
    """Raise InputError, which names the holder, if another process holds `run`. Creates no file."""
    if run / LOCK not in _held and (run / LOCK).exists():
        with contextlib.suppress(OSError):
            _acquired(run / LOCK).release()


def drop() -> None:
    """Remove the lock files of this process, before an exit that skips `finally`."""
    for path in list(_held):
        _held.discard(path)
        with contextlib.suppress(OSError):
            path.unlink()


def _acquired(path: Path) -> FileLock:
    """The acquired lock of the file `path`. Raises InputError if another process has it, or OSError."""
    lock = FileLock(path, mode=0o666, blocking=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(f"run directory {path.parent} is in use by {_holder(path)}") from None
    return lock


def _holder(path: Path) -> str:
    """Description of the process that holds the lock, from its file, which may be incomplete."""
    try:
        holder = parse_json(path.read_text(encoding="ascii"))
        return f"process {holder['pid']} on {holder['host']}, since {holder['since']}"
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        return "another process"
