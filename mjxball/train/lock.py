"""One training at a time in a run directory: a lock file that names its holder.

The kernel's lock ends with its process, so that on one machine nothing has to be cleaned up. Between machines that
share a directory such locks may be missing, as on NFS mounted with `nolock`: there the file's age counts, which its
holder renews.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjxball.errors import InputError
from mjxball.reading import parse_json
from mjxball.terminal import warn

LOCK = ".lock"  # in the run directory
RENEWED = 10.0  # [s] between two renewals
STALE = 45.0  # [s] after which a lock of another machine that was not renewed is nobody's
_held = set[Path]()  # lock files of this process
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextlib.contextmanager
def held(run: Path) -> Iterator[None]:
    """Hold the run directory `run`, which is made, for this process.

    Raises InputError, which names the holder, if another process does, or if the directory cannot be written.
    """
    made = [place for place in (run, *run.parents) if not place.exists()]
    try:
        run.mkdir(parents=True, exist_ok=True)
        handle = _acquire(run / LOCK)
    except OSError as error:
        raise InputError(f"run directory {run} cannot be written: {error.strerror or error}") from None
    _held.add(run / LOCK)
    over = threading.Event()
    renewal = threading.Thread(target=_renew, args=(handle, over), daemon=True)
    renewal.start()
    try:
        yield
    finally:
        over.set()
        renewal.join()
        drop()  # while it is locked: who waits for it sees that it is another file
        os.close(handle)
        with contextlib.suppress(OSError):
            for place in made:  # those that nothing was written to
                place.rmdir()


def check_free(run: Path) -> None:
    """Raise InputError, which names the holder, if another process holds `run`. Makes nothing."""
    if run / LOCK in _held:
        return
    with contextlib.suppress(OSError):
        handle = os.open(run / LOCK, os.O_RDWR | os.O_CLOEXEC)
        try:
            _lock(handle, run / LOCK)
        finally:
            os.close(handle)  # and with it the lock


def drop() -> None:
    """Remove this process's lock files; for who ends the process at once."""
    for path in list(_held):
        _held.discard(path)
        with contextlib.suppress(OSError):
            path.unlink()


def _acquire(path: Path) -> int:
    """The locked file `path`, which names this process. Raises InputError if it is another's, and OSError."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            if not _lock(handle, path):
                continue
            holder = _holder(handle)
            if holder.get("boot") not in (None, _boot()) and (left := STALE - _age(handle, path)) > 0:
                raise _in_use(path, holder, f"; if that has ended, wait {left:.0f} s")
            os.ftruncate(handle, 0)
            os.pwrite(handle, json.dumps(_this_process()).encode(), 0)
            os.fsync(handle)
            kept, handle = handle, -1
            return kept
        finally:
            if handle >= 0:
                os.close(handle)


def _lock(handle: int, path: Path) -> bool:
    """Lock the file; False if it is not `path` any more. Raises InputError if another process has it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _in_use(path, _holder(handle)) from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        if _age(handle, path) < STALE and _holder(handle).get("pid") is not None:
            raise _in_use(path, _holder(handle), f"; if that has ended, wait {STALE:.0f} s") from None
        text = f"warning: the file system of {path.parent} has no locks: start no other training there"
        warn(text)
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:  # its holder has just ended
        return False


def _in_use(path: Path, holder: dict[str, Any], more: str = "") -> InputError:
    known = "another process"
    if holder:
        known = f"process {holder.get('pid')} on {holder.get('host')}, since {holder.get('since')}"
    return InputError(f"run directory {path.parent} is in use by {known}{more}")


def _holder(handle: int) -> dict[str, Any]:
    """What the file says of its holder; nothing if it is being written."""
    try:
        found = parse_json(os.pread(handle, 4096, 0))
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _age(handle: int, path: Path) -> float:
    """Time since the file was renewed, by the clock of whoever keeps it [s]."""
    renewed = os.fstat(handle).st_mtime
    probe = path.with_name(f"{path.name}.{os.urandom(6).hex()}")
    with contextlib.suppress(OSError):
        probe.touch()
        try:
            return probe.stat().st_mtime - renewed
        finally:
            probe.unlink()
    return time.time() - renewed


def _renew(handle: int, over: threading.Event) -> None:
    while not over.wait(RENEWED):
        with contextlib.suppress(OSError):
            os.utime(handle)


def _this_process() -> dict[str, Any]:
    since = time.strftime("%Y-%m-%d %H:%M:%S %z")
    return {"host": socket.gethostname(), "pid": os.getpid(), "since": since, "boot": _boot()}


def _boot() -> str:
    """Which start of which machine this is: its processes see each other's locks."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return socket.gethostname()
