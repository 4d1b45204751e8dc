"""Time series from rosbag2 bags, MCAP or SQLite, read by rosbags; of a truncated MCAP file the intact part."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball.errors import InputError, said
from mjxfly.log_sources import HEADER, RECORD, TOPICS, VARIABLES, WIDTHS, Series
from mjxfly.log_unpack import Unpacking, check_tables

MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an MCAP file
BAGS, COMPRESSED = (".mcap", ".db3"), ".zstd"
MAX_CLOCK_OFFSET = 0.05  # [s] largest median difference between stamps and times of receipt
MAX_STAMP_ERROR = 1  # [s] largest difference of one message: a stamp of 0 means that it has none
SHOWN = 6  # topics named in an error message


class Found(NamedTuple):
    """Contents of a bag."""

    lines: bytes  # of our own flight log, empty if there is none
    series: Series
    has: str  # its topics and their types, for messages


def read_bag(path: Path, remark: Callable[[str], None]) -> Found:
    """Read the bag `path`, a file or a folder. Raises InputError if it is none, is empty, or its clocks disagree."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found = _files(path)
    unpacking = Unpacking(path, sum(file.stat().st_size for file in found))
    with tempfile.TemporaryDirectory() as spare, contextlib.ExitStack() as stack:
        try:
            stack.enter_context(unpacking.bounding())
            files = [_intact(_plain(file, Path(spare), unpacking), Path(spare), remark, unpacking) for file in found]
            with AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                return _contents(path, reader, unpacking)
        except InputError:
            raise
        except Exception as error:  # the libraries raise many types
            unpacking.refuse()
            raise InputError(f"bag {path} cannot be read: {said(error)}") from None


def is_bag(path: Path) -> bool:
    """Whether `path` has the suffix of a bag's file, compressed or not."""
    return path.name.removesuffix(COMPRESSED).endswith(BAGS)


def _files(path: Path) -> list[Path]:
    """The file `path`, or the bag files in the folder; metadata.yaml is not needed. Raises InputError without any."""
    if path.is_file():
        return [path]
    inside = [path, *path.iterdir()] if path.is_dir() else [path]
    if odd := [one for one in inside if one.exists() and not one.is_file() and not one.is_dir()]:
        raise InputError(f"bag {odd[0]} is no regular file")
    files = [one for one in path.iterdir() if one.is_file()] if path.is_dir() else []
    found = sorted(filter(is_bag, files))
    if not found:
        what = "is a folder without .mcap or .db3" if path.exists() else "does not exist"
        raise InputError(f"bag {path} {what}; expected a rosbag2 file or folder, or cfclient's leader and follower")
    return found


def _plain(path: Path, spare: Path, unpacking: Unpacking) -> Path:
    """`path`, or its decompressed copy in the folder `spare`."""
    if path.suffix != COMPRESSED:
        return path
    unpacking.copy(path, spare / path.stem)
    return spare / path.stem


def _intact(path: Path, spare: Path, remark: Callable[[str], None], unpacking: Unpacking) -> Path:
    """`path`, or a copy of the intact part in the folder `spare` if it is a truncated MCAP file."""
    if path.suffix == ".db3":
        check_tables(path)
    if path.suffix != ".mcap":
        return path
    with path.open("rb") as stream:
        begin = stream.read(len(MAGIC))
        if begin != MAGIC:
            what = "is empty" if not begin else f"begins with {begin!r}"
            raise InputError(f"bag {path} {what}; expected an MCAP file, which begins with {MAGIC!r}")
    if _has_footer(path):
        return path
    copy = spare / f"whole-{path.name}"
    remark(f"it is cut short, without a footer: {_copy_sound(path, copy, unpacking)} messages are whole")
    return copy


def _has_footer(path: Path) -> bool:
    """Whether the MCAP file `path` has its closing magic bytes."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MAGIC)))
        return size > len(MAGIC) and stream.read() == MAGIC


def _copy_sound(path: Path, copy: Path, unpacking: Unpacking) -> int:
    """Copy the part of the MCAP file `path` before the first damage to the new file `copy`; return the message count.

    Raises InputError if the header is damaged.
    """
    from mcap.records import Channel, Header, Message, Schema
    from mcap.writer import Writer

    count, schemas, channels, begun = 0, {0: 0}, dict[int, int](), False
    with path.open("rb") as stream, copy.open("xb") as target:
        writer = Writer(target)
        with contextlib.suppress(Exception):  # of the first damaged record
            for one in unpacking.records(stream, path.stat().st_size):
                if isinstance(one, Header):
                    writer.start(one.profile)
                    begun = True
                elif isinstance(one, Schema):
                    schemas[one.id] = writer.register_schema(one.name, one.encoding, one.data)
                elif isinstance(one, Channel):
                    kind = schemas[one.schema_id]
                    channels[one.id] = writer.register_channel(one.topic, one.message_encoding, kind, one.metadata)
                elif isinstance(one, Message):
                    writer.add_message(channels[one.channel_id], one.log_time, one.data, one.publish_time)
                    count += 1
        unpacking.refuse()
        if not begun:
            raise InputError(f"bag {path} ends, or is damaged, within its header; expected a whole one, and messages")
        writer.finish()
    return count


def _contents(path: Path, reader: Any, unpacking: Unpacking) -> Found:
    """Read all known topics of an open bag. Raises InputError if it is empty or its clocks disagree."""
    topics = {one.topic: one.msgtype.replace("/msg/", "/") for one in reader.connections}
    has = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())[:SHOWN])
    if reader.message_count == 0:
        raise InputError(f"bag {path} is empty: it holds no message; expected those of a flight")
    if f"/{HEADER}" in topics:
        # A bag is sorted by time, and the header need not be its earliest line.
        lines = [
            part[RECORD] for name in (HEADER, RECORD) for *_, part in _messages(path, reader, unpacking, {f"/{name}"})
        ]
        return Found(b"".join(line + b"\n" for line in lines), {}, has)
    found: dict[tuple[str, str, str], tuple[list[float], list[Any]]] = {}
    apart: dict[str, list[float]] = {}
    wanted = {topic for topic, kind in topics.items() if (one := TOPICS.get(_last_part(topic))) and one.type == kind}
    for topic, received, drone, header, values in _messages(path, reader, unpacking, wanted):
        now = received if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
        apart.setdefault(topic, []).append((received - now) * 1e-9)
        stamped = abs(received - now) <= MAX_STAMP_ERROR * 10**9
        for quantity, row in values.items():
            _check_width(path, topic, quantity, len(row))
            times, rows = found.setdefault((drone, quantity, topic), ([], []))
            times.append(((now if stamped else received) - reader.start_time) * 1e-9)
            rows.append(row if stamped else (np.nan,) * len(row))
    _check_clocks(path, apart)
    return Found(b"", _densest(found), has)


def _last_part(topic: str) -> str:
    return topic.rpartition("/")[2]


def _messages(
    path: Path, reader: Any, unpacking: Unpacking, topics: set[str]
) -> Iterator[tuple[str, int, str, Any, dict[str, Any]]]:
    """(topic, time of receipt [ns], drone, header or None, values by quantity) of all messages on `topics`."""
    wanted = [one for one in reader.connections if one.topic in topics]
    for connection, received, raw in reader.messages(wanted) if wanted else ():
        topic = connection.topic
        known, message = TOPICS[_last_part(topic)], reader.deserialize(unpacking.message(raw), connection.msgtype)
        try:
            parts = list(known.take(message))
        except AttributeError as error:
            raise InputError(
                f"bag {path}: {known.type} of {topic} has another definition than expected: {error}"
            ) from None
        for drone, header, values in parts:
            yield topic, received, drone or _last_part(topic.rpartition("/")[0]), header, values


def _check_width(path: Path, topic: str, quantity: str, found: int) -> None:
    if found != WIDTHS[quantity]:
        variables = [name for name, one in VARIABLES.items() if one.quantity == quantity]
        own = [name for name in variables if name.startswith(f"{_last_part(topic)}.")]
        raise InputError(f"bag {path}: {topic} has {found} values; expected {', '.join(own)}")


def _check_clocks(path: Path, apart: dict[str, list[float]]) -> None:
    for topic, differences in apart.items():
        usual = float(np.median(differences))
        if abs(usual) > MAX_CLOCK_OFFSET:
            raise InputError(
                f"bag {path} is of two clocks: {topic} is stamped {usual:.3g} s before it was received; expected "
                f"{MAX_CLOCK_OFFSET:g} s or less, of a recorder on the machine that stamps, or of synchronised clocks"
            )


def _densest(found: dict[tuple[str, str, str], tuple[list[float], list[Any]]]) -> Series:
    """Series by drone and quantity, sorted by time: of several topics with one quantity that with the most messages.

    A topic with zeros only was not measured and is used if there is no other.
    """
    series: Series = {}
    for (drone, quantity, _), (times, rows) in sorted(
        found.items(), key=lambda one: (np.any(one[1][1]), len(one[1][0]))
    ):
        order, first = np.unique(np.array(times), return_index=True)
        series.setdefault(drone, {})[quantity] = order, np.array(rows, float)[first]
    return series
