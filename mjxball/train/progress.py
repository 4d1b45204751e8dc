"""Progress of a training: the status line at a terminal, and the rows of `metrics.csv`."""

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

# steps: environment steps so far. seconds: time of training and compilation, in a resumed run including the time up to
# its checkpoint. rate: environment steps per second of all members together, updates included. episode_return: mean
# reward x episode steps, exploring. Further columns: metrics of environment and algorithm, and the numbers of episodes
# that were terminated and that diverged.
COMMON = ("steps", "seconds", "rate", "episode_return")
KEYS = "Ctrl-C saves and stops"
Row = dict[str, Any]  # by column; the columns of an evaluation are absent between evaluations
Log = Callable[[Row], Any]
Start = Callable[[str, dict[str, Any]], Log]  # of a user's tracker: (the run's name, its settings by name)


def columns(exploring: Sequence[str], algorithm: Sequence[str], evaluated: Sequence[str]) -> dict[str, str]:
    """Columns of `metrics.csv` with their tags in TensorBoard ('' for `steps`).

    The arguments are names of metrics: the environment's while exploring, the algorithm's, the environment's while
    evaluated.
    """
    names = [*COMMON, *exploring, *algorithm, "terminated", "diverged", "eval_return"]
    tag_of = tags(exploring, algorithm, evaluated)
    return {name: tag_of.get(name, "") for name in (*names, *(f"eval_{name}" for name in evaluated))}


def started(tracker: Start, session: Session) -> Log:
    """The function that the user's `tracker` returns, to be called with every row. Raises InputError if it fails."""
    try:
        log = tracker(session.name, dict(session.settings))
    except FOREIGN as error:  # any error of the user's program
        raise InputError(f"--tracker raised {said(error)}") from error
    if not callable(log):
        raise InputError(f"--tracker must return what is called with every row, not {type(log).__name__}")
    return log


class Progress:
    """Shows a status at a terminal, else a line per row, and appends rows to `metrics.csv` and TensorBoard's events.

    In a run that is resumed at `resumed_at` steps, later rows are dropped, because they will be written again. Without
    a `path` nothing is printed or written.
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
        self._names, self.total, self._members = list(names), total, members
        session = session or Session()
        self._called = session.name
        self._status = Status(stream or sys.stderr)
        self._start = time.monotonic()
        self._doing = "", "", KEYS
        self._latest: tuple[Row, float] | None = None  # the newest row and its time [s]
        self.before = 0.0  # time that the run took before it was resumed [s]
        self.ends: float | None = None  # of a run by the clock: when it ends, a monotonic time [s]
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
        tagged = {name: tag for name, tag in names.items() if tag}
        self._events = Events(path.parent, session, tagged, [_point(row, began) for row in kept])
        self._events.flush()

    def elapsed(self) -> float:
        """Seconds since this object was made."""
        return time.monotonic() - self._start

    def begin(self, doing: str, what: str = "", keys: str = KEYS) -> None:
        """Show `doing` `what` and its duration until there is a row. Without a terminal print it once, if `what`."""
        if self._silent:
            return
        if what and not self._status.live:
            self.say(f"{doing} {what} ...")
        self._doing = doing, what, keys
        self._status.show(self._lines)

    def say(self, text: str) -> None:
        """Print a line above the status."""
        if not self._silent:
            self._status.say(text)

    def show(self, row: Row) -> None:
        """Append `row` to all files and show it."""
        if self._silent:
            return
        try:
            self._writer.writerow(row)
            self._file.flush()
        except OSError as error:  # for a full disk it does not name the file
            raise OSError(error.errno, error.strerror, self._file.name) from None
        self._events.add(Point(row["steps"], row, time.time()))
        self._events.flush()
        self._track(row)
        if not self._status.live or "eval_return" in row:
            self._status.row([f"{row['steps']:>9,} steps", *self._summary(row), *self._speed(row, 0.0)])
        self._latest = row, time.monotonic()
        self._status.show(self._lines)

    def _track(self, row: Row) -> None:
        """Pass `row` to the tracker. After an error it is not called again, and training continues."""
        if self._log is None:
            return
        try:
            self._log({name: value for name, value in row.items() if value is not None})
        except FOREIGN as error:  # any error of the user's program
            self._log = None
            self.say(f"warning: --tracker raised {said(error)}; it gets no more rows")

    def _lines(self) -> list[list[str]]:
        """Current lines of the status, each a list of phrases."""
        if self._latest is None:
            doing, what, keys = self._doing
            return [[f"{doing} {self.elapsed():.0f} s", *([what] if what else [])], [keys, self._called]]
        row, came = self._latest
        steps = f"{row['steps']:,} of {self.total:,} steps"
        return [[*self._speed(row, time.monotonic() - came), steps, self._called], [KEYS, *self._summary(row)]]

    def _speed(self, row: Row, since: float) -> list[str]:
        """Share of the steps or of the time done, time left, and steps per second; `since` the row [s]."""
        if self.ends is None:
            share = min(row["steps"] / self.total, 1.0)
            left = max(self.total - row["steps"], 0) * self._members / max(row["rate"], 1e-9) - since
        else:
            left = max(self.ends - time.monotonic(), 0.0)
            share = 1.0 - left / max(row["seconds"] + since + left, 1e-9)
        minutes, seconds = divmod(max(int(left), 0), 60)
        return [
            f"{share:.0%}",
            f"{minutes}:{seconds:02d} left",
            f"{row['rate'] / 1e3:.1f} k/s",
        ]

    def _summary(self, row: Row) -> list[str]:
        """The return and the next two metrics, of the evaluation if there is one, else exploring."""
        evaluated = "eval_return" in row
        names = [name for name in self._names if name.startswith("eval_") == evaluated and name not in COMMON]
        first, *rest = names[:3] if evaluated else ["episode_return", *names[:2]]
        labels = {first: first} | {name: name.removeprefix("eval_") for name in rest}
        values = {label: row.get(name) for name, label in labels.items()}
        return [f"{label.replace('_', ' ')} {value:.4g}" for label, value in values.items() if value is not None]

    def end_status(self) -> None:
        """Remove the status; later output is printed line by line."""
        self._status.close()

    def close(self) -> None:
        """Remove the status and close the files."""
        self.end_status()
        if self._silent:
            return
        self._file.close()
        self._events.close()


def _point(row: Mapping[str, str], began: float) -> Point:
    """A row of `metrics.csv` as a point; `began` is the wall-clock time of the run's start [s]."""
    values = {name: float(text) for name, text in row.items() if text}
    return Point(int(row["steps"]), values, began + values["seconds"])


def _rows_until(path: Path, names: Sequence[str], steps: int) -> list[dict[str, str]]:
    if not steps or not path.exists():
        return []
    return [row for row in read_metrics(path) if set(row) == set(names) and int(row["steps"]) <= steps]
