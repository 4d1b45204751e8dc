#!/usr/bin/env python3
"""Write docs/licences.csv: the licence of every package in constraints.txt, from the metadata of what is installed.

`python docs/licences.py`, in an environment with the extras `dev` and `fly`. It fails if one is not installed.
"""

from __future__ import annotations

import csv
import re
import sys
import tomllib
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).parents[1]
LIST = REPOSITORY / "docs" / "licences.csv"


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


def listed() -> list[tuple[str, str, str]]:
    """Every pinned package, its licence, and what installs it."""
    by = installers()
    return [
        (name, licence(name), ", ".join(extra for extra, packages in by.items() if plain(name) in packages))
        for name in pinned()
    ]


if __name__ == "__main__":
    with LIST.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([("package", "licence", "installed by"), *listed()])
    sys.stdout.write(f"{LIST}\n")
