"""Support: small recordings most of which would be gigabytes, or never end, by the name of file or folder."""

from __future__ import annotations

import functools
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

ZEROS = 2**26  # bytes


@functools.cache
def zstd_bomb(times: int = 64) -> bytes:
    """Gigabytes of nothing, in frames of which each tells its size."""
    import zstandard

    return zstandard.ZstdCompressor(level=1).compress(bytes(ZEROS)) * times


def lz4_bomb() -> bytes:
    """The same in lz4, which does not shrink it as much."""
    import lz4.frame

    return lz4.frame.compress(bytes(ZEROS))


def record(code: int, content: bytes) -> bytes:
    """A record of MCAP."""
    return struct.pack("<BQ", code, len(content)) + content


def text(content: bytes) -> bytes:
    """A text of MCAP."""
    return struct.pack("<I", len(content)) + content


def laughs(name: str) -> bytes:
    """A map of MCAP of one text: YAML of 9^39 words."""
    lines = [f"- &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}" for k in range(1, 40)]
    return text(name.encode()) + text("\n".join(["- &a0 {x: 1}", *lines]).encode())


def channel(metadata: bytes, definition: bytes) -> bytes:
    """An MCAP file of one channel and a message."""
    schema = struct.pack("<H", 1) + text(b"a/msg/B") + text(b"ros2msg") + text(definition)
    topic = struct.pack("<HH", 1, 1) + text(b"/a") + text(b"cdr") + text(metadata)
    inside = record(0x03, schema) + record(0x04, topic) + record(0x05, struct.pack("<HIQQ", 1, 0, 1, 1) + bytes(12))
    return mcap(b"", inside, len(inside))


def mcap(compression: bytes, data: bytes, size: int, footer: bool = True) -> bytes:
    """An MCAP file of one chunk that says that it unpacks to `size` bytes."""
    magic = b"\x89MCAP0\r\n"
    chunk = struct.pack("<QQQI", 0, 10, size, 0) + text(compression) + struct.pack("<Q", len(data)) + data
    end = record(0x0F, bytes(4)) + record(0x02, bytes(20)) + magic if footer else b""
    return magic + record(0x01, text(b"ros2") + text(b"")) + record(0x06, chunk) + end


TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
INSERT INTO schema VALUES (3, 'humble');
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT);
INSERT INTO topics VALUES (1, '/header', 'std_msgs/msg/String', 'cdr', '');
"""
STORED = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB{});"
ENDLESS = f"""{STORED.format("")}
CREATE VIEW message_definitions AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)
SELECT i AS id, 'x' AS topic_type, 'ros2msg' AS encoding, '' AS encoded_message_definition, '' AS type_description_hash
FROM n; UPDATE schema SET schema_version = 4;
"""
COMPUTED = f"{STORED.format(' AS (zeroblob(1000000000))')} INSERT INTO messages(topic_id, timestamp) VALUES (1, 1);"


def database(path: Path, sql: str, *values: bytes) -> None:
    """The new SQLite file `path` made by `sql`, and a message of each of the `values`."""
    base = sqlite3.connect(path)
    base.executescript(TABLES + sql)
    for number, value in enumerate(values):
        base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", [number, value])
    base.commit()
    base.close()


def folder(path: Path) -> None:
    """A bag's folder whose file was compressed, with YAML of 9^39 words."""
    path.mkdir()
    (path / "bag.db3.zstd").write_bytes(zstd_bomb(16))
    (path / "metadata.yaml").write_bytes(laughs("x"))


def cfclient(content: bytes) -> Callable[[Path], None]:
    """Folders of cfclient of which one file is `content`."""

    def make(path: Path) -> None:
        for name in ("leader", "follower"):
            (path / name).mkdir(parents=True)
            (path / name / "block.csv").write_bytes(content)

    return make


BOMBS: dict[str, Callable[[Path], object]] = {
    "zstd.mcap": lambda path: path.write_bytes(mcap(b"zstd", zstd_bomb(), 64 * ZEROS)),
    "cut.mcap": lambda path: path.write_bytes(mcap(b"zstd", zstd_bomb(), 64 * ZEROS, footer=False)),
    "lz4.mcap": lambda path: path.write_bytes(mcap(b"lz4", lz4_bomb(), ZEROS)),
    "long.mcap": lambda path: path.write_bytes(mcap(b"", b"", 0)[:-37] + struct.pack("<BQ", 5, 2**32) + bytes(60)),
    "laughs.mcap": lambda path: path.write_bytes(channel(laughs("offered_qos_profiles"), b"float64 x")),
    "defined.mcap": lambda path: path.write_bytes(channel(b"", b"float64 x\n" * 300_000)),
    "endless.db3": lambda path: database(path, ENDLESS),
    "computed.db3": lambda path: database(path, COMPUTED),
    "message.db3": lambda path: database(path, STORED.format(""), zstd_bomb()),
    "folder": folder,
    "nothing": cfclient(b"Timestamp,x\n" + b"\0\n" * 10**6),
    "wide": cfclient(b"Timestamp" + b",a" * 200_000),
    "long": cfclient(b"Timestamp,x\n" + b"\0" * 2**24),
}
