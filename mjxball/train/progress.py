"""The live progress line and the rows of `metrics.csv`."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from mjxball.quiet import import_tensorboard_writer
from mjxball.train.run_directory import CONFIG_FILE, read_metrics, write_rows

EVENTS = "tensorboard"  # directory beside metrics.csv


# steps: environment steps so far; seconds: of training, compilation included, of a resumed run what came before its
# checkpoint too; rate: environment steps per second of all members together, updates included; episode_return: mean
# reward x episode steps, exploring. Then what environment and algorithm report, and episodes that ended before their
# time limit or left the finite range.
COMMON = ("steps", "seconds", "rate", "episode_return")
Row = dict[str, Any]  # by column; the columns of an evaluation are absent between evaluations


def columns(exploring: Sequence[str], algorithm: Sequence[str], evaluated: Sequence[str]) -> list[str]:
    """Columns of `metrics.csv`, from what the environment reports (exploring, evaluated) and the algorithm."""
    found = [*COMMON, *exploring, *algorithm, "terminated", "diverged", "eval_return"]
    return [*found, *(f"eval_{name}" for name in evaluated)]


class Progress:
    """Prints one line that is overwritten on a terminal; appends rows to `metrics.csv` and to TensorBoard's events.

    Of a run that is resumed at `resumed_at` steps, rows beyond are dropped: they will come again. Without a `path`
    nothing is printed or written.
    """

    def __init__(
        self,
        path: Path | None,
        names: Sequence[str],
        total: int,
        resumed_at: int = 0,
        members: int = 1,
        stream: TextIO | None = None,
    ):
        self._names, self._total, self._members = names, total, members
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._start = time.monotonic()
        self._width = 0
        self.before = 0.0  # [s] what the run took before it was resumed
        self._silent = path is None
        if path is None:
            return
        kept = _rows_until(path, names, resumed_at)
        self.before = float(kept[-1]["seconds"]) if kept else 0.0
        write_rows(path, names, kept)
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, names)
        self._events = _events_anew(path, kept)

    def elapsed(self) -> float:
        """Seconds since this object was made."""
        return time.monotonic() - self._start

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
        try:
            self._writer.writerow(row)
            self._file.flush()
        except OSError as error:  # of a full disk it does not say where
            raise OSError(error.errno, error.strerror, self._file.name) from None
        for name, value in row.items():
            if value is not None and name != "steps":
                self._events.add_scalar(name, value, row["steps"])
        left = max(self._total - row["steps"], 0) * self._members / max(row["rate"], 1e-9)
        evaluated = "eval_return" in row
        text = (
            f"{row['steps']:>9,} / {self._total:,} steps  {row['rate'] / 1e3:6.1f} k/s  "
            f"{int(left) // 60}:{int(left) % 60:02d} left  {self._summary(row, evaluated)}"
        )
        if self._live and not evaluated:
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._width = len(text)
        else:
            self.say(text)

    def _summary(self, row: Row, evaluated: bool) -> str:
        """The return and the first metrics behind it, of the evaluation or exploring."""
        chosen = [name for name in self._names if name.startswith("eval_") == evaluated and name not in COMMON]
        shown = chosen[:3] if evaluated else ["episode_return", *chosen[:2]]
        return "  ".join(f"{name.replace('_', ' ')} {_number(row.get(name))}" for name in shown)

    def close(self) -> None:
        """End the line and close the file."""
        if self._silent:
            return
        if self._live and self._width:
            self._stream.write("\n")
        self._file.close()
        self._events.close()


def _events_anew(path: Path, kept: Sequence[Mapping[str, str]]) -> Any:
    """A writer of TensorBoard's events beside `path`, with the rows `kept`: each point once, whoever reads them.

    What is there besides goes: rows that will come again, and others than an earlier process wrote to metrics.csv.
    """
    place = path.with_name(EVENTS)
    for older in place.glob("events.out.tfevents.*"):
        older.unlink()
    events, began = import_tensorboard_writer()(str(place)), path.with_name(CONFIG_FILE)
    start = began.stat().st_mtime if began.exists() else time.time()
    for row in kept:
        numbers = {name: float(text) for name, text in row.items() if text and name != "steps"}
        for name, value in numbers.items():
            events.add_scalar(name, value, int(row["steps"]), walltime=start + numbers["seconds"])
    events.flush()
    return events


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _rows_until(path: Path, names: Sequence[str], steps: int) -> list[dict[str, str]]:
    if not steps or not path.exists():
        return []
    return [row for row in read_metrics(path) if set(row) == set(names) and int(row["steps"]) <= steps]
