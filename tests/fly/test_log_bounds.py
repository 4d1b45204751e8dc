"""Recordings that say more than they hold: refused in one sentence, in bounded memory, time and temporary room."""

from __future__ import annotations

import sqlite3
import struct
import tempfile
from pathlib import Path

import damage
import pytest

from mjxball.fly import log_import, log_unpack

lz4 = pytest.importorskip("lz4.frame")
zstandard = pytest.importorskip("zstandard")
pytest.importorskip("rosbags")
ZEROS = bytes(2**26)


def zstd_bomb(times: int = 64) -> bytes:
    """Four gigabytes of nothing, in frames of which each tells its size."""
    return zstandard.ZstdCompressor(level=1).compress(ZEROS) * times


def record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


def text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def mcap(compression: bytes, data: bytes, size: int, footer: bool = True) -> bytes:
    """An MCAP file of one chunk that says that it unpacks to `size` bytes."""
    magic = b"\x89MCAP0\r\n"
    chunk = struct.pack("<QQQI", 0, 10, size, 0) + text(compression) + struct.pack("<Q", len(data)) + data
    end = record(0x0F, bytes(4)) + record(0x02, bytes(20)) + magic if footer else b""
    return magic + record(0x01, text(b"ros2") + text(b"")) + record(0x06, chunk) + end


def database(path: Path, sql: str) -> None:
    base = sqlite3.connect(path)
    base.executescript(sql)
    base.commit()
    base.close()


TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
INSERT INTO schema VALUES (3, 'humble');
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT);
INSERT INTO topics VALUES (1, '/record', 'std_msgs/msg/String', 'cdr', '');
"""
STORED = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB{});\n"
ENDLESS = """CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
CREATE VIEW message_definitions AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)
SELECT i AS id, 'x' AS topic_type, 'ros2msg' AS encoding, '' AS encoded_message_definition, '' AS type_description_hash
FROM n; UPDATE schema SET schema_version = 4;
"""
COMPUTED = STORED.format(" AS (zeroblob(1000000000))") + "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1);"


def bombs(place: Path) -> dict[str, Path]:
    """Files of kilobytes, most of which would be gigabytes, or never end."""
    found = {}
    whole = zstd_bomb()
    files = {
        "zstd.mcap": mcap(b"zstd", whole, 64 * len(ZEROS)),
        "cut.mcap": mcap(b"zstd", whole, 64 * len(ZEROS), footer=False),
        "lz4.mcap": mcap(b"lz4", lz4.compress(ZEROS), len(ZEROS)),
        "longest.mcap": mcap(b"", b"", 0)[:-37] + struct.pack("<BQ", 5, 2**32) + bytes(60),
    }
    for name, content in files.items():
        found[name] = place / name
        found[name].write_bytes(content)
    for name, sql in {"endless.db3": ENDLESS, "computed.db3": COMPUTED}.items():
        found[name] = place / name
        database(found[name], TABLES + sql)
    found["message.db3"] = place / "message.db3"
    database(found["message.db3"], TABLES + STORED.format(""))
    base = sqlite3.connect(found["message.db3"])
    base.execute("UPDATE topics SET name = '/header'")
    base.execute("INSERT INTO messages VALUES (1, 1, 1, ?)", [whole])
    base.commit()
    base.close()
    found["folder"] = place / "folder"
    found["folder"].mkdir()
    (found["folder"] / "bag.db3.zstd").write_bytes(zstd_bomb(16))
    laughs = "\n".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 40))
    (found["folder"] / "metadata.yaml").write_text(f"a0: &a0 x\n{laughs}\n")
    return found


def test_bags_that_unpack_to_gigabytes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = tmp_path / "room"
    room.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(room))
    most = 0
    kept = log_unpack.Unpacking.refuse

    def watching(self: log_unpack.Unpacking) -> None:
        nonlocal most
        most = max(most, sum(one.stat().st_size for one in room.rglob("*") if one.is_file()))
        kept(self)

    monkeypatch.setattr(log_unpack.Unpacking, "refuse", watching)
    for name, path in bombs(tmp_path).items():
        if path.is_file():
            assert path.stat().st_size < 600_000, name
        count = damage.Count(name)
        assert damage.measured(lambda path: log_import.read(path, lambda text: None), path, count) == "refused", name
        assert count.memory < 100, name  # [MiB]
    assert 0 < most <= 20 * 2**20
    assert list(room.iterdir()) == []
