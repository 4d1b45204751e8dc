"""The directive `settings`: every setting of one part of the configuration, from the dataclass itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from mjxball.config import Config, leaves, to_text


def row(*cells: list[nodes.Node]) -> nodes.row:
    """One line of the table; every part of a cell is a paragraph."""
    return nodes.row("", *(nodes.entry("", *(nodes.paragraph("", "", part) for part in cell)) for cell in cells))


def setting(path: str, value: Any, bounds: Mapping[str, Any]) -> nodes.row:
    """The line of one setting."""
    span = "" if bounds["low"] is None else f"; {bounds['low']:g} to {bounds['high']:g}"
    default = nodes.inline("", f"default {to_text(value) or '(none)'}{span}", classes=["default"])
    return row([nodes.literal("", f"--{path}"), default], [nodes.Text(bounds["about"])])


class Settings(SphinxDirective):
    """`settings` with the part's name: a table of flag, default, range and meaning."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Build the table."""
        part = self.arguments[0]
        found = [(path, value, item) for path, value, item in leaves(Config()) if path.startswith(f"{part}.")]
        rows = [setting(path, value, item.metadata) for path, value, item in found]
        if not rows:
            raise self.error(f"the configuration has no part called {part!r}")
        head = row(*([nodes.Text(text)] for text in ("flag", "meaning")))
        group = nodes.tgroup("", *(nodes.colspec(colwidth=width) for width in (40, 60)), cols=2)
        group += [nodes.thead("", head), nodes.tbody("", *rows)]
        return [nodes.table("", group, classes=["colwidths-auto", "settings"])]


def setup(app: Any) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_directive("settings", Settings)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
