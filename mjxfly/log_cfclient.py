"""Time series of two drones from log blocks that cfclient wrote as CSV."""

from __future__ import annotations

import contextlib
import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from mjxball.errors import InputError
from mjxball.files import read_text
from mjxball.reading import following
from mjxfly.limits import NAMES
from mjxfly.log_consistency import known
from mjxfly.log_sources import VARIABLES, WIDTHS, Samples, Series

MAX_FILE_BYTES = 64 * 2**20  # some hours of a log block
MOST_COLUMNS = 100  # the variables of a log block fit a packet


def read_cfclient(path: Path, remark: Callable[[str], None]) -> Series:
    """Series by drone and quantity from the folders `leader` and `follower` in `path`, with CSV files of cfclient.

    Times [s] of each drone are on its own clock; missing values are NaN. Raises InputError if files are missing or
    damaged.
    """
    return {name: _joined(path / name, _columns(path / name, remark)) for name in NAMES}


def _columns(folder: Path, remark: Callable[[str], None]) -> dict[str, Samples]:
    files = sorted(file for file in folder.glob("*.csv") if file.is_file())
    if not files:
        raise InputError(f"{folder} holds no .csv; expected the files that cfclient wrote of this drone")
    found: dict[str, Samples] = {}
    for file in files:
        own = _read_csv(file, remark)
        if twice := sorted(own.keys() & found.keys()):
            raise InputError(f"{twice[0]} stands in {file} and in another file of {folder}; expected one recording")
        found |= own
    return found


def _read_csv(file: Path, remark: Callable[[str], None]) -> dict[str, Samples]:
    with contextlib.suppress(csv.Error):
        reader = csv.reader(io.StringIO(read_text(file, "", MAX_FILE_BYTES), newline=""))
        head = next(reader, [])
        if head[:1] != ["Timestamp"]:
            raise InputError(f"{file} begins with {','.join(head)[:40]!r}; expected cfclient's Timestamp and variables")
        if len(head) > MOST_COLUMNS:
            raise InputError(f"{file} has {len(head):,} columns; expected {MOST_COLUMNS} or less, of a log block")
        if twice := [name for name in head if head.count(name) > 1]:
            raise InputError(f"{file} has two columns {twice[0]}; expected one")
        try:
            table = np.fromiter(_values(reader, len(head)), float).reshape(-1, len(head))
            kept = following((1e-3 * table[:, 0]).tolist())
            if len(kept) < 2:
                raise ValueError("it holds fewer than two rows")
            if lost := len(table) - len(kept):
                remark(
                    f"{file.name} of the {file.parent.name} has {lost} of {len(table)} rows whose time does not follow"
                )
            table = table[kept]
            time = 1e-3 * table[:, 0]
        except ValueError as error:
            raise InputError(f"{file} cannot be used: {error}") from None
        return {name: (time, column[:, None]) for name, column in zip(head[1:], table.T[1:], strict=True)}
    raise InputError(f"{file} is no text; expected cfclient's CSV")


def _values(rows: Iterable[list[str]], width: int) -> Iterator[float]:
    """All values of `rows`, NaN if empty, without an incomplete last row. Raises ValueError for another bad row."""
    fault = ""
    for number, row in enumerate(rows, start=1):
        if not fault and len(row) == width:
            yield from (float(one or math.nan) for one in row)
            continue
        if fault or len(row) > width:
            raise ValueError(fault or f"row {number} has {len(row)} values; expected {width}")
        fault = f"row {number} has {len(row)} values; expected {width}"


def _joined(folder: Path, columns: dict[str, Samples]) -> dict[str, Samples]:
    """Quantities of which all components were logged, interpolated to the times of the first one."""
    parts: dict[tuple[str, int], Samples] = {}
    for name, one in VARIABLES.items():
        if name in columns:
            parts[one.quantity, one.place] = columns[name][0], one.factor * columns[name][1]
    joined = {}
    for quantity, width in WIDTHS.items():
        own = [parts[quantity, place] for place in range(width) if (quantity, place) in parts]
        if len(own) == width:
            time = own[0][0]
            if any(one[0][0] >= time[-1] or one[0][-1] <= time[0] for one in own):
                raise InputError(f"{folder} has numbers of one {quantity} from different times; expected one recording")
            joined[quantity] = time, np.column_stack([_at(time, *one) for one in own])
    return joined


def _at(time: np.ndarray, rows: np.ndarray, column: np.ndarray) -> np.ndarray:
    """(n,) `column` (m, 1), sampled at times `rows` (m,), interpolated to `time` (n,); NaN in gaps."""
    there = np.isfinite(column[:, 0])
    if not there.any():
        return np.full(len(time), np.nan)
    found = np.interp(time, rows[there], column[there, 0])
    return np.where(known(time, rows[there]), found, np.nan)
