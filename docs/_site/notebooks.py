"""Notebooks as pages: their text as Markdown, their code as code, and below a cell what it prints and draws.

Nothing is run when the pages are built: `python docs/pictures.py notebook` stores outputs beside the notebook, as
NOTEBOOK-CELL.txt, .svg or .png, with the id of the cell. The metadata `alt` of a cell describes its picture.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from myst_parser.parsers.sphinx_ import MystParser


def markdown(notebook: str, path: Path) -> str:
    """The JSON of the notebook at `path` as one Markdown text."""
    parts = []
    for cell in json.loads(notebook)["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
        else:
            parts += [f"```python\n{text}\n```", *outputs(cell, path)]
    return "\n\n".join(parts) + "\n"


def outputs(cell: dict[str, Any], path: Path) -> list[str]:
    """Markdown of the stored outputs of a code cell of the notebook at `path`."""
    stem, found = path.parent / f"{path.stem}-{cell['id']}", []
    if (printed := stem.with_suffix(".txt")).exists():
        found.append(f"```text\n{printed.read_text(encoding='utf-8').rstrip()}\n```")
    for picture in filter(Path.exists, map(stem.with_suffix, (".svg", ".png"))):
        found.append(f"![{cell['metadata'].get('alt', 'What the cell draws')}]({picture.name})")
    return ["*Output:*", *found] if found else []


class NotebookParser(MystParser):
    """Reads `.ipynb`."""

    supported = ("ipynb",)

    def parse(self, inputstring: str, document: Any) -> None:
        """See `MystParser.parse`."""
        path = Path(document["source"])
        for stored in path.parent.glob(f"{path.stem}-*.txt"):
            document.settings.env.note_dependency(str(stored))
        super().parse(markdown(inputstring, path), document)


def setup(app: Any) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_source_suffix(".ipynb", "ipynb")
    app.add_source_parser(NotebookParser)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
