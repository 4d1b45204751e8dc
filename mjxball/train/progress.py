"""The live progress line and the rows of `metrics.csv`."""

from __future__ import annotations

import csv
import sys
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TextIO

from mjxball.quiet import import_tensorboard_writer
from mjxball.train.reading import read_rows

EVENTS = "tensorboard"  # directory beside metrics.csv


@dataclass(frozen=True)
class Row:
    """One row of `metrics.csv`. Evaluation columns are empty between evaluations."""

    steps: int  # environment steps so far
    seconds: float  # of training, compilation included; of a resumed run what came before its checkpoint too
    rate: float  # environment steps per second of all members together, updates included
    episode_return: float  # mean reward x episode steps, exploring policy
    steady_error: float | None  # mean |e_o| later than 8 s into an episode, exploring policy [m]; None: none so old
    alpha: float
    entropy: float  # of the policy [nat]
    critic_loss: float
    policy_loss: float
    terminated: int  # episodes that ended before their time limit
    diverged: int  # worlds that left the finite range
    eval_return: float | None = None  # the same for the averaged policy's mean
    eval_steady_error: float | None = None  # [m]
    eval_peak: float | None = None  # mean over worlds of the largest steady |e_o| [m]
    eval_tilt_error: float | None = None  # rms difference of the roll and pitch commands to the leader's [rad]
    eval_vertical_error: float | None = None  # the same of the vertical accelerations [m/s2]


class Progress:
    """Prints one line that is overwritten on a terminal; appends rows to `metrics.csv` and to TensorBoard's events.

    Of a run that is resumed at `resumed_at` steps, rows beyond are dropped: they will come again. Without a `path`
    nothing is printed or written.
    """

    def __init__(
        self, path: Path | None, total: int, resumed_at: int = 0, members: int = 1, stream: TextIO | None = None
    ):
        self._total, self._members = total, members
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._start = time.monotonic()
        self._width = 0
        self._before = 0.0
        self._silent = path is None
        if path is None:
            return
        kept = _rows_until(path, resumed_at)
        self._before = float(kept[-1]["seconds"]) if kept else 0.0
        names = [item.name for item in fields(Row)]
        partial = path.with_name(f".{path.name}.partial")
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, names)
            writer.writeheader()
            writer.writerows(kept)
        partial.replace(path)
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, names)
        self._events = import_tensorboard_writer()(str(path.with_name(EVENTS)), purge_step=resumed_at or None)

    def elapsed(self) -> float:
        """Seconds since this object was made."""
        return time.monotonic() - self._start

    def seconds(self) -> float:
        """The same, and what the run took before it was resumed."""
        return self._before + self.elapsed()

    def say(self, text: str) -> None:
        """Print a line of its own."""
        if self._silent:
            return
        clear = "\r" + " " * self._width + "\r" if self._live and self._width else ""
        self._width = 0
        print(clear + text, file=self._stream, flush=True)

    def show(self, row: Row) -> None:
        """Record `row` and show it."""
        if self._silent:
            return
        self._writer.writerow(asdict(row))
        self._file.flush()
        for name, value in asdict(row).items():
            if value is not None and name != "steps":
                self._events.add_scalar(name, value, row.steps)
        left = max(self._total - row.steps, 0) * self._members / max(row.rate, 1e-9)
        evaluated = row.eval_return is not None
        metric = (
            f"steady error {_metres(row.eval_steady_error)}, peak {_metres(row.eval_peak)}"
            if evaluated
            else f"steady error {_metres(row.steady_error)} exploring"
        )
        text = (
            f"{row.steps:>9,} / {self._total:,} steps  {row.rate / 1e3:6.1f} k/s  "
            f"{int(left) // 60}:{int(left) % 60:02d} left  return {row.episode_return:9.1f}  {metric}  "
            f"alpha {row.alpha:.3f}"
        )
        if self._live and not evaluated:
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._width = len(text)
        else:
            self.say(text)

    def close(self) -> None:
        """End the line and close the file."""
        if self._silent:
            return
        if self._live and self._width:
            self._stream.write("\n")
        self._file.close()
        self._events.close()


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f} m"


def _rows_until(path: Path, steps: int) -> list[dict[str, str]]:
    if not steps or not path.exists():
        return []
    names = {item.name for item in fields(Row)}
    rows = [row for row in read_rows(path) if set(row) == names and row["steps"].isdecimal()]
    return [row for row in rows if len(row["steps"]) < 20 and int(row["steps"]) <= steps]
