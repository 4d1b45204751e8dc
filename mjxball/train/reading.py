"""JSON and CSV files of a run directory, read as if a stranger had written them: one sentence for whatever is wrong."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from mjxball.errors import InputError

MAX_BYTES = 16 * 2**20  # JSON and CSV take some ten times their own length in memory


def read_json(path: Path, called: str) -> Any:
    """The contents of a JSON file; FileNotFoundError if there is none, InputError if it cannot be read.

    `called` says in the error what the file is, '' for nothing but its path.
    """
    text = _text(path, called)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _refusal(path, called, error) from None


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a header; a row that is cut short or too long is left out.

    FileNotFoundError if there is no such file, InputError if it cannot be read.
    """
    lines = _text(path, "").splitlines()
    try:
        rows = list(csv.DictReader(lines))
    except csv.Error as error:
        raise _refusal(path, "", error) from None
    return [row for row in rows if None not in row and None not in row.values()]


def _text(path: Path, called: str) -> str:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise _refusal(path, called, f"it is larger than {MAX_BYTES >> 20} MiB")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise _refusal(path, called, getattr(error, "strerror", None) or error) from None


def _refusal(path: Path, called: str, why: object) -> InputError:
    words = " ".join(str(why).split())[:200]
    return InputError(f"{called}{' ' if called else ''}{path} cannot be read: {words}")
