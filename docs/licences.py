#!/usr/bin/env python3
"""Write docs/licences.md: the licence of every package in constraints.txt, from the metadata of what is installed.

`python docs/licences.py`, in an environment with the extras `dev` and `fly`. It fails if one is not installed.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).parents[1]
PAGE = REPOSITORY / "docs" / "licences.md"
HEAD = """# Licences of what mjxball installs

mjxball itself is Apache-2.0. `python docs/licences.py` writes this page from the metadata of the packages that
`constraints.txt` pins; `tests/test_licences.py` compares the two.

**cflib is under the GPL**, so it is an extra (`fly`) that must be asked for, and only the code that opens a radio
imports it. The GPL applies to distributions of mjxball together with cflib. docutils, which only builds these pages, is
in the public domain or under BSD licences, except for an Emacs mode under the GPL that is not installed.

| package | licence | installed by |
|---|---|---|
"""


def plain(name: str) -> str:
    """A package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pinned() -> list[str]:
    """Names in constraints.txt, in its order."""
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    return list(dict.fromkeys(line.split("==")[0] for line in lines if line))


def licence(name: str) -> str:
    """The licence that an installed package states: its expression, its classifiers, or its text's first line."""
    told = metadata.metadata(name)
    if expression := told.get("License-Expression"):
        return expression
    classifiers = [text.split(" :: ")[-1] for text in told.get_all("Classifier", []) if text.startswith("License ::")]
    named = [text for text in classifiers if text != "OSI Approved"]
    files = [f"licenses/{path}" for path in told.get_all("License-File", [])]
    written = [told.get("License"), *(metadata.distribution(name).read_text(path) for path in files)]
    text = next((one for one in written if one and one.strip()), "").strip().splitlines()
    return " / ".join(named) or (text[0][:60] if text else "not stated")


def closure(requirements: Iterable[str]) -> set[str]:
    """Plain names of all packages that `requirements` install here."""
    found: set[str] = set()
    waiting = [(Requirement(text), "") for text in requirements]
    while waiting:
        wanted, extra = waiting.pop()
        if wanted.marker and not wanted.marker.evaluate({"extra": extra}):
            continue
        name = plain(wanted.name)
        if name in found or name == "mjxball":
            continue
        found.add(name)
        try:
            inner = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        waiting += [(Requirement(text), one) for text in inner for one in ("", *wanted.extras)]
    return found


def installers() -> dict[str, set[str]]:
    """'base' and every extra -> the packages that it installs."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = {name: list(texts) for name, texts in project["optional-dependencies"].items()}
    return {"base": closure(project["dependencies"]), **{name: closure(texts) for name, texts in extras.items()}}


def page() -> str:
    """The page's text."""
    by = installers()
    lines = []
    for name in pinned():
        asked = [extra for extra, packages in by.items() if plain(name) in packages]
        lines.append(f"| {name} | {licence(name)} | {', '.join(asked)} |")
    return HEAD + "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
    sys.stdout.write(f"{PAGE}\n")
