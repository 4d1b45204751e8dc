"""The directive `generated`: Markdown that a function returns, such as the supervisor's table."""

from __future__ import annotations

import importlib

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective


class Generated(SphinxDirective):
    """`generated` with `module:function`: what the function returns, parsed as if it stood on the page."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Call the function and parse its text."""
        module, _, function = self.arguments[0].partition(":")
        text = getattr(importlib.import_module(module), function)()
        parent = nodes.container(classes=["generated"])
        self.state.nested_parse(StringList(text.splitlines(), source=self.arguments[0]), self.content_offset, parent)
        return [parent]


def setup(app: object) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_directive("generated", Generated)  # type: ignore[attr-defined]
    return {"parallel_read_safe": True, "parallel_write_safe": True}
