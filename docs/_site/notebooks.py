"""Notebooks as pages: their text as Markdown, their code as code; nothing is run when the pages are built."""

from __future__ import annotations

import json
from typing import Any

from myst_parser.parsers.sphinx_ import MystParser


def markdown(notebook: str) -> str:
    """A notebook's JSON as one Markdown text."""
    parts = []
    for cell in json.loads(notebook)["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


class NotebookParser(MystParser):
    """Reads `.ipynb`."""

    supported = ("ipynb",)

    def parse(self, inputstring: str, document: Any) -> None:
        """See `MystParser.parse`."""
        super().parse(markdown(inputstring), document)


def setup(app: Any) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_source_suffix(".ipynb", "ipynb")
    app.add_source_parser(NotebookParser)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
