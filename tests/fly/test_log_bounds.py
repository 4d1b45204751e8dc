"""Recordings that say more than they hold: refused in one sentence, in bounded memory, time and temporary room."""

from __future__ import annotations

import tempfile
from pathlib import Path

import damage
import pytest
from recording_bombs import BOMBS

from mjxfly import log_import, log_unpack

for needed in ("lz4.frame", "zstandard", "rosbags"):
    pytest.importorskip(needed)


def test_recordings_that_would_be_gigabytes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = tmp_path / "room"
    room.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(room))
    most, kept = 0, log_unpack.Unpacking.refuse

    def watching(self: log_unpack.Unpacking) -> None:
        nonlocal most
        most = max(most, sum(one.stat().st_size for one in room.rglob("*") if one.is_file()))
        kept(self)

    monkeypatch.setattr(log_unpack.Unpacking, "refuse", watching)
    for name, make in BOMBS.items():
        count = damage.Count(name)
        make(tmp_path / name)
        assert (
            damage.measured(lambda path: log_import.read(path, lambda text: None), tmp_path / name, count) == "refused"
        )
        assert count.memory < 150, name  # [MiB]
    assert 0 < most <= 20 * 2**20
    assert list(room.iterdir()) == []
