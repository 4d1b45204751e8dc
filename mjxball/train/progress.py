"""The live status of a training and the rows of `metrics.csv`."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from mjxball.errors import FOREIGN, InputError, said
from mjxball.terminal import Status
from mjxball.train.events import Events, Point, Session, tags
from mjxball.train.run_directory import CONFIG_FILE, read_metrics, write_rows

# steps: environment steps so far; seconds: of training, compilation included, of a resumed run what came before its
# checkpoint too; rate: environment steps per second of all members together, updates included; episode_return: mean
# reward x episode steps, exploring. Then what environment and algorithm report, and episodes that ended before their
# time limit or left the finite range.
COMMON = ("steps", "seconds", "rate", "episode_return")
KEYS = "Ctrl-C saves and stops"
Row = dict[str, Any]  # by column; the columns of an evaluation are absent between evaluations
Log = Callable[[Row], Any]
Start = Callable[[str, dict[str, Any]], Log]  # of a user's tracker: (the run's name, its settings by name)


def columns(exploring: Sequence[str], algorithm: Sequence[str], evaluated: Sequence[str]) -> dict[str, str]:
    """Columns of `metrics.csv`, from what the environment reports (exploring, evaluated) and the algorithm.

    Each with its tag in TensorBoard, '' of `steps`.
    """
    found = [*COMMON, *exploring, *algorithm, "terminated", "diverged", "eval_return"]
    known = tags(exploring, algorithm, evaluated)
    return {name: known.get(name, "") for name in (*found, *(f"eval_{name}" for name in evaluated))}


def started(tracker: Start, session: Session) -> Log:
    """What is called with every row. Raises InputError if there is none."""
    try:
        log = tracker(session.name, dict(session.settings))
    except FOREIGN as error:  # whatever another's program raises
        raise InputError(f"--tracker raised {said(error)}") from error
    if not callable(log):
        raise InputError(f"--tracker must return what is called with every row, not {type(log).__name__}")
    return log


class Progress:
    """Shows a status at a terminal, else a line a row; appends rows to `metrics.csv` and to TensorBoard's events.

    Of a run that is resumed at `resumed_at` steps, rows beyond are dropped: they will come again. Without a `path`
    nothing is printed or written.
    """

    def __init__(
        self,
        path: Path | None,
        names: Mapping[str, str],
        total: int,
        resumed_at: int = 0,
        members: int = 1,
        stream: TextIO | None = None,
        session: Session | None = None,
        tracker: Log | None = None,
    ):
        """`names`: see `columns`. `tracker` is called with every row."""
        self._names, self._total, self._members = list(names), total, members
        session = session or Session()
        self._called = session.name
        self._status = Status(stream or sys.stderr)
        self._start = time.monotonic()
        self._doing = "", "", KEYS
        self._latest: tuple[Row, float] | None = None  # and when it came
        self.before = 0.0  # [s] what the run took before it was resumed
        self._silent, self._log = path is None, tracker
        if path is None:
            return
        kept = _rows_until(path, self._names, resumed_at)
        self.before = float(kept[-1]["seconds"]) if kept else 0.0
        write_rows(path, self._names, kept)
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, self._names)
        config = path.with_name(CONFIG_FILE)
        began = config.stat().st_mtime if config.exists() else time.time()
        told = {name: tag for name, tag in names.items() if tag}
        self._events = Events(path.parent, session, told, [_point(row, began) for row in kept])
        self._events.flush()

    def elapsed(self) -> float:
        """Seconds since this object was made."""
        return time.monotonic() - self._start

    def begin(self, doing: str, what: str = "", keys: str = KEYS) -> None:
        """Show what is done until there is a row, and how long it has taken; without a terminal say it, if `what`."""
        if self._silent:
            return
        if what and not self._status.live:
            self.say(f"{doing} {what} ...")
        self._doing = doing, what, keys
        self._status.show(self._lines)

    def say(self, text: str) -> None:
        """Print a line of its own."""
        if not self._silent:
            self._status.say(text)

    def show(self, row: Row) -> None:
        """Record `row` and show it."""
        if self._silent:
            return
        try:
            self._writer.writerow(row)
            self._file.flush()
        except OSError as error:  # of a full disk it does not say where
            raise OSError(error.errno, error.strerror, self._file.name) from None
        self._events.add(Point(row["steps"], row, time.time()))
        self._events.flush()
        self._track(row)
        if not self._status.live or "eval_return" in row:
            self._status.row([f"{row['steps']:>9,} steps", *self._summary(row), *self._speed(row, 0.0)])
        self._latest = row, time.monotonic()
        self._status.show(self._lines)

    def _track(self, row: Row) -> None:
        """Tell the tracker; one that fails is told no more, and the training goes on."""
        if self._log is None:
            return
        try:
            self._log({name: value for name, value in row.items() if value is not None})
        except FOREIGN as error:  # whatever another's program raises
            self._log = None
            self.say(f"warning: --tracker raised {said(error)}; it is told no more rows")

    def _lines(self) -> list[list[str]]:
        """What a terminal shows now."""
        if self._latest is None:
            doing, what, keys = self._doing
            return [[f"{doing} {self.elapsed():.0f} s", *([what] if what else [])], [keys, self._called]]
        row, came = self._latest
        steps = f"{row['steps']:,} of {self._total:,} steps"
        return [[*self._speed(row, time.monotonic() - came), steps, self._called], [KEYS, *self._summary(row)]]

    def _speed(self, row: Row, since: float) -> list[str]:
        """Share of the steps that are done, time left, and steps per second."""
        left = max(self._total - row["steps"], 0) * self._members / max(row["rate"], 1e-9) - since
        minutes, seconds = divmod(max(int(left), 0), 60)
        return [
            f"{min(row['steps'] / self._total, 1.0):.0%}",
            f"{minutes}:{seconds:02d} left",
            f"{row['rate'] / 1e3:.1f} k/s",
        ]

    def _summary(self, row: Row) -> list[str]:
        """The return and the first metrics behind it, of the evaluation or exploring, as far as there are any yet."""
        evaluated = "eval_return" in row
        chosen = [name for name in self._names if name.startswith("eval_") == evaluated and name not in COMMON]
        first, *rest = chosen[:3] if evaluated else ["episode_return", *chosen[:2]]
        said = {first: first} | {name: name.removeprefix("eval_") for name in rest}
        found = {text: row.get(name) for name, text in said.items()}
        return [f"{text.replace('_', ' ')} {value:.4g}" for text, value in found.items() if value is not None]

    def end_status(self) -> None:
        """Take the status away: what comes is said line by line."""
        self._status.close()

    def close(self) -> None:
        """Take the status away and close the files."""
        self.end_status()
        if self._silent:
            return
        self._file.close()
        self._events.close()


def _point(row: Mapping[str, str], began: float) -> Point:
    """A row of `metrics.csv` of a run that began then [s]."""
    numbers = {name: float(text) for name, text in row.items() if text}
    return Point(int(row["steps"]), numbers, began + numbers["seconds"])


def _rows_until(path: Path, names: Sequence[str], steps: int) -> list[dict[str, str]]:
    if not steps or not path.exists():
        return []
    return [row for row in read_metrics(path) if set(row) == set(names) and int(row["steps"]) <= steps]
