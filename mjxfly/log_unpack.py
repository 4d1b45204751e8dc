"""Bounds on the decompressed size of a bag: the libraries trust its sizes, and kilobytes may expand to gigabytes."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from mjxball.errors import InputError

MAX_RATIO, MIN_LIMIT = 100, 16 * 2**20  # largest decompressed size over a bag's own; least such limit [bytes]
MAX_COPIED = 2**32  # [bytes] of decompressed copies on disk
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # first bytes of zstd data
CHUNK = 2**20  # [bytes] unpacked at once
MAX_TEXT = 2**20  # largest size of all message definitions [characters]; the parser reads about 50 000 a second

Unpack = Callable[[bytes], bytes]


class Unpacking:
    """Decompresses parts of the bag `path` of `size` bytes and bounds the total size of the results."""

    def __init__(self, path: Path, size: int):
        self._path, self._limit = path, max(MIN_LIMIT, MAX_RATIO * size)
        self._left, self._copied, self._defined = self._limit, 0, 0

    def refuse(self) -> None:
        """Raise InputError if a limit is exceeded. Every method that decompresses calls it."""
        if self._left < 0 or self._copied > MAX_COPIED:
            most = min(self._limit, MAX_COPIED) if self._copied > MAX_COPIED else self._limit
            raise InputError(
                f"bag {self._path} unpacks to more than {most >> 20} MiB; expected at most {MAX_RATIO} times its own "
                f"size, or {MIN_LIMIT >> 20} MiB"
            )

    def plain(self, data: bytes) -> bytes:
        """`data`, which is counted against the limit."""
        self._left -= len(data)
        self.refuse()
        return data

    def zstd(self, data: bytes) -> bytes:
        """The decompressed frames `data`."""
        return b"".join(self._pieces(io.BytesIO(data)))

    def message(self, data: bytes) -> bytes:
        """`data`, decompressed if the recorder compressed single messages; no CDR message begins like zstd data."""
        return self.zstd(data) if data[: len(ZSTD_MAGIC)] == ZSTD_MAGIC else data

    def lz4(self, data: bytes) -> bytes:
        """The decompressed frame `data`. Raises ValueError if it is incomplete."""
        import lz4.frame

        frame, parts = lz4.frame.LZ4FrameDecompressor(), list[bytes]()
        while not frame.eof:
            parts.append(self.plain(frame.decompress(data, max_length=CHUNK)))
            data = b""
            if frame.needs_input and not parts[-1]:
                raise ValueError("a chunk is cut short")
        return b"".join(parts)

    def copy(self, source: Path, target: Path) -> None:
        """Decompress the file `source` into the new file `target`."""
        with source.open("rb") as packed, target.open("xb") as stream:
            for piece in self._pieces(packed):
                self._copied += stream.write(piece)
                self.refuse()

    def records(self, stream: BinaryIO, size: int) -> Iterator[Any]:
        """Records of the MCAP file `stream` of `size` bytes, and those in its chunks. Raises what `mcap` raises."""
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size).records:
            if isinstance(record, Chunk):
                data = self._by_name()[record.compression](record.data)
                yield from breakup_chunk(dataclasses.replace(record, compression="", data=data), validate_crc=True)
            else:
                yield record

    @contextlib.contextmanager
    def bounding(self) -> Iterator[None]:
        """Make rosbags decompress and parse within the limits; it has no settings for that, so functions are replaced.

        QoS profiles of a bag are not parsed: they are YAML, which may expand without bounds, and are not needed.
        """
        from rosbags.highlevel import anyreader
        from rosbags.rosbag2 import storage_mcap, storage_sqlite3

        chunks = {name: _sized(unpack) for name, unpack in self._by_name().items()}
        ours: list[tuple[Any, str, Any]] = [(storage_mcap, "DECOMPRESSORS", chunks)]
        ours += [(module, "parse_qos", lambda _: []) for module in (storage_mcap, storage_sqlite3)]
        ours += [
            (anyreader, name, self._defining(getattr(anyreader, name)))
            for name in ("get_types_from_msg", "get_types_from_idl")
        ]
        with contextlib.ExitStack() as stack:
            for module, name, value in ours:
                stack.callback(setattr, module, name, getattr(module, name))
                setattr(module, name, value)
            yield

    def _defining(self, parse: Callable[..., Any]) -> Callable[..., Any]:
        """`parse`, a parser of message definitions, limited to `MAX_TEXT` characters in total."""

        def counted(text: str, *given: Any) -> Any:
            self._defined += len(text)
            if self._defined > MAX_TEXT:
                raise InputError(
                    f"bag {self._path} defines its messages in more than {MAX_TEXT >> 20} MiB; expected those of ROS 2"
                )
            return parse(text, *given)

        return counted

    def _by_name(self) -> dict[str, Unpack]:
        """Decompressors of chunks by name of the compression."""
        return {"": self.plain, "zstd": self.zstd, "lz4": self.lz4}

    def _pieces(self, packed: Any) -> Iterator[bytes]:
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True, closefd=False) as stream:
            while piece := stream.read(CHUNK):
                yield self.plain(piece)


def _sized(unpack: Unpack) -> Callable[[bytes, int], bytes]:
    """`unpack` with the signature that rosbags expects; the stated size of the chunk is ignored."""
    return lambda data, _: unpack(data)


def check_tables(path: Path) -> None:
    """Raise InputError if the SQLite file `path` has views, virtual tables or generated columns, which may be huge."""
    with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as base:
        try:
            found = base.execute(
                "SELECT type, lower(sql) FROM sqlite_master WHERE type IN ('view', 'table')"
            ).fetchall()
            computed = [sql for kind, sql in found if kind == "view" or " virtual " in sql or " as " in sql]
            if not computed:
                return
        except (sqlite3.Error, TypeError) as error:
            raise InputError(f"bag {path} cannot be read: {error}") from None
    raise InputError(
        f"bag {path} computes what it holds, by {computed[0][:60]!r}; expected tables as rosbag2 writes them"
    )
