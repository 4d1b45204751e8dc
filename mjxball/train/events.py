"""TensorBoard's files of a training: one run for all members and one for each, named after preset and seed."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mjxball import config as configs
from mjxball.algorithms import ALGORITHMS
from mjxball.config import Config
from mjxball.quiet import import_tensorboard

EVENTS = "tensorboard"  # directory beside metrics.csv, with a subdirectory for each run
EVALUATION = "evaluation/"


class Point(NamedTuple):
    """Values of one row."""

    step: int
    values: Mapping[str, float | None]  # by column of metrics.csv or members.csv
    at: float  # wall-clock time [s]


class Session(NamedTuple):
    """A run's name in TensorBoard and its hyper-parameters."""

    name: str = "run"
    settings: Mapping[str, Any] = {}


def session(config: Config, seed: int, members: int, origin: Mapping[str, Any]) -> Session:
    """Session of `members` followers with seeds from `seed` on, such as `transport-seed3` or `transport-seeds3-10`."""
    algorithm = (origin.get("extensions") or {}).get("algorithm") or "sac"
    others = {name for name in ALGORITHMS if name != algorithm}
    used = {path: value for path, value, _ in configs.leaves(config) if path.partition(".")[0] not in others}
    plain = {path: configs.to_text(value) if isinstance(value, tuple) else value for path, value in used.items()}
    name = f"{config.preset}-seed{seed}" if members == 1 else f"{config.preset}-seeds{seed}-{seed + members - 1}"
    return Session(name, {"algorithm": algorithm, "physics": origin["physics"], "seed": seed, **plain})


def tags(exploring: Sequence[str], algorithm: Sequence[str], evaluated: Sequence[str]) -> dict[str, str]:
    """TensorBoard's tag, group/name, of every column of metrics.csv; the arguments are those of `progress.columns`."""
    groups = {
        "speed/": ("seconds", "rate"),
        "exploring/": ("episode_return", *exploring, "terminated", "diverged"),
        "update/": algorithm,
        EVALUATION: ("eval_return", *(f"eval_{name}" for name in evaluated)),
    }
    return {name: group + name.removeprefix("eval_") for group, names in groups.items() for name in names}


class Events:
    """The events file of one run, which replaces those of earlier processes."""

    def __init__(self, run: Path, session: Session, named: Mapping[str, str], points: Iterable[Point] = ()):
        """`named`: tag of each column; a column without one, and a value that is empty or not finite, is left out."""
        directory = run / EVENTS / session.name
        directory.mkdir(parents=True, exist_ok=True)
        for older in directory.glob("events.out.tfevents.*"):
            older.unlink()
        self._parts, self._tags = import_tensorboard(), named
        host = socket.gethostname()
        path = directory / f"events.out.tfevents.{time.time():.6f}.{host}"
        self._file = self._parts.record_writer.RecordWriter(str(path))
        self._write(time.time(), file_version="brain.Event:2")
        goals = dict.fromkeys(tag for tag in named.values() if tag.startswith(EVALUATION))
        for summary in self._parts.summary.hparams(dict(session.settings), goals) if session.settings else ():
            self._write(time.time(), summary=summary)
        for point in points:
            self.add(point)

    def add(self, point: Point) -> None:
        """Add the values of one step."""
        for name, value in point.values.items():
            if name in self._tags and value is not None and math.isfinite(value):
                summary = self._parts.summary.scalar(self._tags[name], value)
                self._write(point.at, step=point.step, summary=summary)

    def flush(self) -> None:
        """Write everything to disk, for a TensorBoard that is watching."""
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, at: float, **contents: Any) -> None:
        event = self._parts.proto.event_pb2.Event(wall_time=at, **contents)
        self._file.write(event.SerializeToString())
