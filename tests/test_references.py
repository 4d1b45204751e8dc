"""What the package's docstrings and comments name in back quotes, with a dot or a slash in it, exists."""

from __future__ import annotations

import ast
import functools
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import REPOSITORY

PACKAGE, FLIES = REPOSITORY / "mjxball", REPOSITORY / "mjxfly"
SOURCES = sorted([*PACKAGE.rglob("*.py"), *FLIES.rglob("*.py")])
QUOTED = re.compile(r"`([A-Za-z_][\w./]*)(?:\(\))?`")
FILE = re.compile(r"\.(py|c|h|md|js|npz|csv|json|jsonl|toml|html|onnx|elf|svg|png)$")
FOREIGN = {"jax", "jnp", "lax", "np", "mjx", "mujoco", "brax", "scipy", "gymnasium", "sys", "ZipFile"}
VARIABLES = {"x", "state", "plant", "follower"}  # of no one function: an array, a world's, a rig's, a C header's


def qualified(tree: ast.AST, prefix: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """The names that a module, class or function makes, each with its owners."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            yield (*prefix, node.name)
            yield from qualified(node, (*prefix, node.name) if isinstance(node, ast.ClassDef) else prefix)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                for leaf in target.elts if isinstance(target, ast.Tuple) else [target]:
                    name = getattr(leaf, "id", None) or getattr(leaf, "attr", None)
                    if name:
                        yield (*prefix, name)
        elif isinstance(node, (ast.ImportFrom, ast.Import)):
            yield from ((*prefix, (one.asname or one.name).split(".")[0]) for one in node.names)
        elif not isinstance(node, ast.Lambda):
            yield from qualified(node, prefix)


@functools.cache
def everything() -> set[tuple[str, ...]]:
    """All qualified names of the package, and all their endings."""
    found: set[tuple[str, ...]] = set()
    for path in SOURCES:
        way = path.relative_to(REPOSITORY).with_suffix("").parts
        way = way[:-1] if way[-1] == "__init__" else way
        public = tuple(part for part in way if not part.startswith("_"))  # such as config/_plant.py
        for name in (way, *qualified(ast.parse(path.read_text(encoding="utf-8")), public)):
            found |= {name[first:] for first in range(len(name))}
    return found


def texts(path: Path) -> Iterator[tuple[int, str, set[str]]]:
    """Line, text, and the names of what it stands in, for every docstring and comment."""
    source = path.read_text(encoding="utf-8")
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
    local = [
        (node.lineno, node.end_lineno or node.lineno, {one.arg for one in ast.walk(node) if isinstance(one, ast.arg)})
        for node in nodes
    ]
    with path.open("rb") as stream:
        for token in tokenize.tokenize(stream.readline):
            if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and token.string.startswith('"""')):
                line = token.start[0]
                yield line, token.string, set().union(*(names for first, last, names in local if first <= line <= last))


def is_file(name: str) -> bool:
    """Whether `name` is that of a file or folder: the repository's, or one that a command reads or writes."""
    folders = (REPOSITORY / folder for folder in ("docs", "benchmarks", "tests", "policies"))
    places = (REPOSITORY, PACKAGE, FLIES, *folders)
    return ("/" not in name and FILE.search(name) is not None) or any((place / name).exists() for place in places)


FIELD = re.compile(r"^    (\w+):", re.MULTILINE)
SETTINGS = {name for path in (PACKAGE / "config").glob("*.py") for name in FIELD.findall(path.read_text())}


def stale(path: Path) -> list[str]:
    """What is quoted in `path` and is nothing."""
    found = []
    for line, text, local in texts(path):
        for name in QUOTED.findall(text):
            parts = tuple(name.split("."))
            if not ("." in name or "/" in name) or is_file(name) or parts[0] in FOREIGN | VARIABLES | local:
                continue
            if parts not in everything() and parts[1:] != () and not (parts[-1] in SETTINGS and len(parts) <= 3):
                found.append(f"{path.relative_to(REPOSITORY)}:{line}: {name}")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_what_is_quoted_exists(path: Path) -> None:
    assert stale(path) == []


def test_a_stale_name_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("test_references.REPOSITORY", tmp_path)
    path = tmp_path / "module.py"
    path.write_text(
        '"""See `mjxfly.link.Link`, `mjxfly.link.Lnk`, `mjxfly/lnk.py` and `controller.FlightController.step`."""\n'
    )
    assert [line.rpartition(": ")[2] for line in stale(path)] == ["mjxfly.link.Lnk", "mjxfly/lnk.py"]
