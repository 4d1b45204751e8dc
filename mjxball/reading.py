"""Checks of files from outside: JSON without repeated keys, numbers of usable size, increasing times.

Standard library only.
"""

from __future__ import annotations

import bisect
import difflib
import itertools
import json
import math
import statistics
import tomllib
from collections.abc import Iterable, Sequence
from typing import Any, TypeGuard

LONGEST_NAME = 60  # characters of a key that a sentence shows
GAP = 5.0  # median steps; a longer one is a gap of a recording
STRAY = 0.1  # largest share of rows whose time does not increase
MAX_SIZE, MIN_SIZE = 1e12, 1e-30  # of a number other than 0; products beyond are infinite or 0 in float32
MOST_DIGITS = 20  # of a whole number of 64 bits; Python takes thousands, which no float holds


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text. Raises ValueError, also for a key that an object has twice; RecursionError if too deep.

    The standard does not say which of two equal keys counts, and Python silently takes the last. Whole numbers of more
    than 20 digits become infinity, as 1e400 does in Python, so that the check of that value can name it.
    """
    return json.loads(text, object_pairs_hook=_once, parse_int=_whole)


def parse_toml(text: str) -> dict[str, Any]:
    """The values of a TOML text, with whole numbers as in `parse_json`. Raises ValueError or RecursionError."""
    return {name: _bounded(value) for name, value in tomllib.loads(text).items()}


def _bounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _bounded(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_bounded(one) for one in value]
    return _whole(str(value)) if type(value) is int else value


def is_number(value: Any, most: float = MAX_SIZE) -> TypeGuard[float]:
    """Whether `value` is an int or float (no bool) that is 0, or from `MIN_SIZE` to `most` in size."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return value == 0 or MIN_SIZE <= abs(value) <= most


def shown(value: Any) -> str:
    """`value` of a file or a command line as error messages show it, shortened."""
    text = repr(value)
    return text if len(text) <= LONGEST_NAME else f"{text[:LONGEST_NAME]}..."


def near(name: str, known: Iterable[str], cutoff: float = 0.8) -> str:
    """' (did you mean X?)' with the `known` name X most similar to `name`; empty if none is."""
    return "".join(f" (did you mean {one}?)" for one in difflib.get_close_matches(name, list(known), 1, cutoff))


def _whole(digits: str) -> float:
    if len(digits) <= MOST_DIGITS:
        return int(digits)
    return -math.inf if digits[0] == "-" else math.inf


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        name = next(name for number, name in enumerate(names) if name in names[:number])
        raise ValueError(f"the key {name[:LONGEST_NAME]!r} stands twice in one object")
    return found


def time_fault(before: float, after: float) -> str | None:
    """A phrase if the time `after` [s] is not finite or not later than `before` [s], else None."""
    if not math.isfinite(after):
        return "a time is not finite"
    if after < before:
        return f"the time goes back by {before - after:.3g} s"
    return "a time stands twice" if after == before else None


def following(times: Sequence[float]) -> list[int]:
    """Indices of a longest subsequence of rows with increasing `times` [s].

    Other rows are left out: some writers mark missing samples by such times. Raises ValueError with a phrase if they
    are more than a tenth.
    """
    ends: list[float] = []  # [n]: the earliest last time of an increasing series of n + 1 rows
    rows: list[int] = []  # [n]: the row with that time
    before: list[int] = []  # the row before each row in its series, -1: none
    for number, now in enumerate(times):
        place = bisect.bisect_left(ends, now) if math.isfinite(now) else 0
        before.append(rows[place - 1] if place else -1)
        if math.isfinite(now) and (place == len(ends) or now < ends[place]):
            ends[place : place + 1], rows[place : place + 1] = [now], [number]
    found, last = [], rows[-1] if rows else -1
    while last >= 0:
        found.append(last)
        last = before[last]
    if len(times) - len(found) > STRAY * len(times):
        check_times(times)
    return found[::-1]


def check_times(times: Sequence[float], shortest: float = 0.0, longest: float = math.inf) -> list[str]:
    """A phrase about gaps in two or more `times` [s], in a list; the list is empty without gaps.

    Raises ValueError with a phrase if they do not increase, or if the median step [s] is not within `shortest` and
    `longest`.
    """
    for number, (before, after) in enumerate(itertools.pairwise(times), start=2):
        if (fault := time_fault(before, after)) is not None:
            raise ValueError(f"row {number}: {fault}")
    steps = [after - before for before, after in itertools.pairwise(times)]
    usual = statistics.median(steps)
    if not shortest <= usual <= longest:
        hint = f"; {usual:g} ms would be {usual / 1000:g} s" if shortest <= usual / 1000 <= longest else ""
        raise ValueError(f"its rows are {usual:.3g} s apart, not {shortest:g} to {longest:g} s{hint}")
    holes = [(step, before) for step, before in zip(steps, times, strict=False) if step > GAP * usual]
    if not holes:
        return []
    widest, begin = max(holes)
    more = f", and {len(holes) - 1} shorter gaps" if len(holes) > 1 else ""
    return [f"there is nothing for {widest:.3g} s from {begin - times[0]:.3g} s on{more}"]
