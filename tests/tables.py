"""Support: one test that loops over the rows of a table, and numbers that a page says."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest
from command_line import REPOSITORY

NUMBER = r"(-?\d+(?: \d{3})*(?:\.\d+)?)"


def rows(names: str | tuple[str, ...], table: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Like `pytest.mark.parametrize`, but one test for all rows: its failure says in which row it was.

    For rows that cost next to nothing. They share the test's fixtures, so a row must not spoil them for the next one.
    """
    named = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    table = list(table)

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def loop(*arguments: Any, **fixtures: Any) -> None:
            assert table, "no row was tested"
            for number, row in enumerate(table):
                given = dict(zip(named, row if len(named) > 1 else (row,), strict=True))
                try:
                    test(*arguments, **fixtures, **given)
                except BaseException as error:
                    error.add_note(f"in row {number}: {given}")
                    raise

        whole = inspect.signature(test)
        left = [parameter for name, parameter in whole.parameters.items() if name not in named]
        loop.__signature__ = whole.replace(parameters=left)  # type: ignore[attr-defined]
        return loop

    return decorate


def weekly(*cases: Any) -> list[Any]:
    """Cases of `parametrize` that repeat others: every week and before a release."""
    return [pytest.param(case, marks=pytest.mark.release) for case in cases]


def says(page: str, phrase: str, numbers: Sequence[float]) -> None:
    """The `page` has this `phrase`, `numbers` in place of every #, rounded to its digits, and any text for ' … '."""
    text = " ".join((REPOSITORY / page).read_text(encoding="utf-8").replace("**", "").split())
    found = re.search(re.escape(phrase).replace(r"\#", NUMBER).replace(r"\ …\ ", ".*?"), text)
    assert found, phrase
    assert len(found.groups()) == len(numbers), numbers
    assert all(map(is_rounded, found.groups(), numbers)), (found.groups(), numbers)


def is_rounded(text: str, number: float) -> bool:
    """Whether `text` is the `number`, rounded to its digits."""
    return abs(float(text.replace(" ", "")) - number) <= 0.5001 * 10.0 ** -len(text.partition(".")[2])
