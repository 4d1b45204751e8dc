"""Reading of users' files within bounds, and atomic writing."""

from __future__ import annotations

import codecs
import contextlib
import os
import stat
from pathlib import Path

from mjxball.errors import InputError

MAX_BYTES = 16 * 2**20  # of a text; parsed JSON and CSV take about ten times as much memory


class MissingFileError(InputError):
    """The file does not exist."""


def read_bytes(path: str | os.PathLike[str], kind: str = "", limit: int = MAX_BYTES) -> bytes:
    """The contents of the file `path`, at most `limit` bytes.

    `kind` describes the file in errors; with '' these contain the path alone. Raises MissingFileError, or InputError if
    the file cannot be read, is too large, or is not regular: reading a pipe may block, and a device may never end.
    """
    called = f"{kind}{' ' if kind else ''}{path}"
    try:
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{called} is a directory")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{called} is not a regular file")
        if status.st_size > limit:
            most = f"{limit >> 20} MiB" if limit >= 2**20 else f"{limit >> 10} KiB"
            raise InputError(f"{called} cannot be read: it is larger than {most}")
        with open(path, "rb") as stream:
            return stream.read(status.st_size)
    except InputError:
        raise
    except FileNotFoundError:
        raise MissingFileError(f"{called} does not exist") from None
    except OSError as error:
        raise InputError(f"{called} cannot be read: {error.strerror or error}") from None
    except ValueError:  # a null character
        raise InputError(f"{kind or 'the file'} {str(path)!r} has an impossible name") from None


def read_text(path: str | os.PathLike[str], kind: str = "", limit: int = MAX_BYTES) -> str:
    """`read_bytes`, decoded from UTF-8. Line ends are unchanged, and a byte order mark is dropped."""
    content = read_bytes(path, kind, limit)
    called = f"{kind}{' ' if kind else ''}{path}"
    if is_utf16(content):
        raise InputError(f"{called} cannot be read: it is UTF-16; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{called} cannot be read: it is not UTF-8, {error.reason}") from None


def is_utf16(content: bytes) -> bool:
    """Whether `content` begins with a byte order mark of UTF-16 or UTF-32."""
    return content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE))


def write_atomically(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write `data`, text as UTF-8, to `path` atomically: readers see the old file or the complete new one.

    This holds after a loss of power too. Of simultaneous writes, the last one remains. An OSError names `path`.
    """
    target = Path(path)
    content = data.encode() if isinstance(data, str) else data
    partial = target.with_name(f".{target.name[:100]}.{os.urandom(6).hex()}.partial")
    try:
        with partial.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(target)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise type(error)(error.errno, error.strerror or str(error), str(target)) from None
    _sync_folder(target.parent)


def user_cache() -> Path | None:
    """Folder for files that can be regenerated; None for a user without a home directory."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "mjxball"
    except RuntimeError:
        return None


def _sync_folder(folder: Path) -> None:
    """Flush the folder's entries to disk, if the file system supports that."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
