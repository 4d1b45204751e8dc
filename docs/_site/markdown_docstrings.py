"""Docstrings of this house for autodoc: prose with `code`, and fields whose shape and unit a comment states."""

from __future__ import annotations

import inspect
import re
from typing import Any

FIELD = re.compile(r"^    (?P<name>[a-z]\w*): (?P<type>.+?)(?: = (?P<default>.+?))?\s+# (?P<about>.+)$")


def escaped(line: str) -> str:
    """One line as reStructuredText that shows what the source shows: `code` as code, every other sign as itself."""
    parts = line.split("`")
    if len(parts) % 2 == 0:  # a lone backtick
        return re.sub(r"([\\*|_`])", r"\\\1", line)
    shown = [
        f"``{part}``" if number % 2 else re.sub(r"([\\*|])|_(?!\w)", lambda sign: "\\" + sign[0], part)
        for number, part in enumerate(parts)
    ]
    return "".join(shown)


def fields(kind: type) -> list[str]:
    """The class's fields with what their comments say, as a reStructuredText list; [] if no field has a comment."""
    try:
        source = inspect.getsource(kind)
    except (OSError, TypeError):
        return []
    found = [match for line in source.splitlines() if (match := FIELD.match(line))]
    lines = [f"* ``{field['name']}``: {escaped(field['about'])}" for field in found]
    return ["", *lines, ""] if lines else []


def process(app: Any, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring's `lines` in place."""
    lines[:] = [escaped(line) for line in lines]
    if what == "class":
        lines += fields(subject)


def setup(app: Any) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
