"""Support: one test that loops over the rows of a table, and cases that run weekly."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest


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
