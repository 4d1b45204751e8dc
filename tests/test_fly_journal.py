"""The flight log survives what kills its writer."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import environment

from mjxball.fly import journal
from mjxball.fly.journal import Journal


def test_what_is_noted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    with Journal(path, policy="transport") as log:
        log.note("tick", 1.25, state=np.array([0.1, 1 / 3]), sent=(1, 2), name=np.float32(0.5))
    records = list(journal.read(path))
    assert [record["kind"] for record in records] == ["header", "tick"]
    assert records[0]["policy"] == "transport"
    assert records[0]["format"] == journal.FORMAT
    assert records[1] == {"t": 1.25, "kind": "tick", "state": [0.1, 1 / 3], "sent": [1, 2], "name": 0.5}


def test_a_torn_last_record_is_skipped_at_every_length(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    with Journal(path) as log:
        for number in range(5):
            log.note("tick", float(number), value=number)
    whole = path.read_bytes()
    last = whole.rstrip(b"\n").rfind(b"\n") + 1
    for length in range(last, len(whole)):
        path.write_bytes(whole[:length])
        assert [record["value"] for record in journal.read(path) if record["kind"] == "tick"] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "damage", [b"\x00\xff\xfe", b"{}\n", b"[1]\n", b"null\n", b'{"t": 1}\n', b"[" * 100_000 + b"\n"]
)
def test_lines_that_are_no_records_are_skipped(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "flight.jsonl"
    good = json.dumps({"t": 0.0, "kind": "tick"}).encode() + b"\n"
    path.write_bytes(good + damage.rstrip(b"\n") + b"\n" + good)
    assert [record["kind"] for record in journal.read(path)] == ["tick", "tick"]


def test_it_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        Journal(path)
    assert path.read_text() == "mine"


def test_without_a_file_nothing_is_kept() -> None:
    with Journal(None) as log:
        log.note("tick")
    assert log.failure is None


SCRIPT = """
import sys, time
from pathlib import Path
from mjxball.fly.journal import Journal
log = Journal(Path(sys.argv[1]))
number = 0
while True:
    log.note("tick", number=number, pad="x" * 500)
    number += 1
    if number == 50:
        print("go", flush=True)
    time.sleep(0.001)
"""


def test_it_is_readable_after_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    with subprocess.Popen([sys.executable, "-c", SCRIPT, path], stdout=subprocess.PIPE, env=environment()) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"go\n"
        time.sleep(0.3)
        writer.kill()
    numbers = [record["number"] for record in journal.read(path) if record["kind"] == "tick"]
    assert numbers == list(range(len(numbers)))  # none is missing in between
    assert len(numbers) >= 50


def test_a_full_disk_does_not_end_the_flight() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    log = Journal(None)
    log._stream = full.open("w", encoding="utf-8")
    log.note("tick")
    log.close()
    assert log.failure
