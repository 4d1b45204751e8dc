"""metrics.csv and TensorBoard's events of a run that was killed and goes on."""

from __future__ import annotations

import contextlib
import csv
import io
import struct
from collections import Counter
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event

from mjxball.train.progress import EVENTS, Progress
from mjxball.train.run_directory import METRICS, read_rows

NAMES = ("steps", "seconds", "rate", "episode_return", "eval_return")


def points(run: Path) -> Counter[tuple[str, int, float]]:
    """(name, step, value) of every point in all event files, as TensorBoard or a script reads them."""
    found: Counter[tuple[str, int, float]] = Counter()
    for path in (run / EVENTS).iterdir():
        content, at = path.read_bytes(), 0
        while at < len(content):
            (size,) = struct.unpack_from("<Q", content, at)
            event = Event.FromString(content[at + 12 : at + 12 + size])
            found.update((one.tag, event.step, one.simple_value) for one in event.summary.value)
            at += size + 16
    return found


def row(steps: int) -> dict[str, float]:
    return {"steps": steps, "seconds": steps / 100, "rate": 8.0, "episode_return": -float(steps)}


def test_after_a_kill_and_a_resume_every_point_stands_once(tmp_path: Path) -> None:
    """Checkpoint at 200 steps, rows to 400, killed, resumed: 300 and 400 come again, with other values."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for run in (whole, killed):
        run.mkdir()
        first = Progress(run / METRICS, NAMES, 500, stream=io.StringIO())
        for steps in (100, 200, 300, 400):
            first.show(row(steps) | ({"eval_return": -1.0} if steps == 200 else {}))
        first.close()
    for resumed_at in (200, 200):  # killed once more before its first row
        again = Progress(killed / METRICS, NAMES, 500, resumed_at, stream=io.StringIO())
        assert again.before == 2.0
    for steps in (300, 400):
        again.show(row(steps))
    again.close()
    assert points(killed) == points(whole)
    assert set(points(whole).values()) == {1}
    assert len(points(whole)) == 4 * 3 + 1
    assert read_rows(killed / METRICS) == read_rows(whole / METRICS)


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    """`/dev/full` takes no byte."""
    progress = Progress(tmp_path / METRICS, NAMES, 500, stream=io.StringIO())
    progress._file.close()
    progress._file = open("/dev/full", "a")  # noqa: SIM115
    progress._writer = csv.DictWriter(progress._file, NAMES)
    with pytest.raises(OSError, match="No space") as failed:
        progress.show(row(100))
    assert failed.value.filename == "/dev/full"
    with contextlib.suppress(OSError):
        progress._file.close()
