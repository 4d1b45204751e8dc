"""Files of users and for users: read within bounds, whatever they are; written whole, or not at all."""

from __future__ import annotations

import codecs
import contextlib
import os
import stat
from pathlib import Path

from mjxball.errors import InputError

MAX_BYTES = 16 * 2**20  # of a text; JSON and CSV take some ten times their own length in memory


class MissingFileError(InputError):
    """There is no such file."""


def read_bytes(path: str | os.PathLike[str], kind: str = "", limit: int = MAX_BYTES) -> bytes:
    """The contents of the file `path`, `limit` bytes at most.

    `kind` says in the error what it should be, '' for nothing but its path. Raises MissingFileError, or InputError if
    it cannot be read, is too large, or is no regular file: a pipe would be waited for, a device never ends.
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
    """The same of a text in UTF-8, with line ends as they are, without the byte order mark that some editors write."""
    content = read_bytes(path, kind, limit)
    called = f"{kind}{' ' if kind else ''}{path}"
    if is_utf16(content):
        raise InputError(f"{called} cannot be read: it is UTF-16; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{called} cannot be read: it is not UTF-8, {error.reason}") from None


def is_utf16(content: bytes) -> bool:
    """Whether `content` begins as a text in UTF-16 or UTF-32, with their byte order mark, does."""
    return content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE))


def write_whole(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write `data`, a text in UTF-8, to `path` atomically: whoever reads sees the old file or the whole new one.

    So it is after a loss of power, too. Several may write at once: the last one's file stays. An OSError names `path`.
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
    """The folder for what is kept between runs and can be made again; None for whoever has no home directory."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "mjxball"
    except RuntimeError:
        return None


def _sync_folder(folder: Path) -> None:
    """Have the folder's new entry on disk; where a file system cannot, it is there as soon as it may be."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
