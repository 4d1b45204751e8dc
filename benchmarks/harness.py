"""What the benchmarks share: the flag --json, rows and tables on the terminal, and one form of result file.

A result file is JSON: what was found, then `command`, `commit` and `versions` of the run that found it. A list has a
row a line, numbers have six digits, and None stands for what JSON has no number for.
"""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from mjxball import __version__, cli
from mjxball.config import Config
from mjxball.control.followers import Follower

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
LIBRARIES = ("jax", "mujoco", "numpy")
Row = dict[str, Any]


def arguments(file: str, text: str) -> cli.Parser:
    """The parser of the script `file`, whose help begins with the first paragraph of `text`."""
    parser = cli.make_parser(f"python benchmarks/{Path(file).name}", text.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    return parser


def shown(value: Any, form: str = ".4g") -> str:
    """A cell of a table."""
    if isinstance(value, float):
        return format(value, form) if math.isfinite(value) else "-"
    if isinstance(value, list | tuple):
        return f"({', '.join(shown(part, form) for part in value)})"
    return "-" if value is None else str(value)


def say(row: Mapping[str, Any], form: str = ".4g") -> None:
    """Print a row as soon as it is measured, `name value` by `name value`, without paths."""
    parts = {name: value for name, value in row.items() if not isinstance(value, Path)}
    print("  ".join(f"{name} {shown(value, form)}" for name, value in parts.items()), flush=True)


def table(rows: Sequence[Mapping[str, Any]], columns: Iterable[str] = (), form: str = ".4g") -> None:
    """Print `rows` in aligned columns: those named, or all that the first row has."""
    names = list(columns) or list(rows[0] if rows else ())
    cells = [names, *([shown(row.get(name), form) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)).rstrip(), flush=True)


def medians(rows: Sequence[Mapping[str, Any]], names: Iterable[str]) -> dict[str, float]:
    """Of every one of `names` the median over paired runs; a number that is missing is infinitely bad."""
    known = {name: [math.inf if row[name] is None else row[name] for row in rows] for name in names}
    return {name: statistics.median(values) for name, values in known.items()}


def follower_of(name: str, config: Config) -> Follower:
    """A policy file's, or a baseline with privileged information too."""
    from mjxball.evaluate.followers import follower_factory
    from mjxball.evaluate.policies import load_policy

    return load_policy(Path(name), config) if name.endswith(".npz") else follower_factory(name, "follower")[1](config)


def finite(value: Any) -> Any:
    """`value` with numbers of six digits, and None for what JSON has no number for."""
    if isinstance(value, Mapping):
        return {str(key): finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def versions() -> dict[str, Any]:
    """Machine and libraries."""
    found = {"mjxball": __version__, **{name: metadata.version(name) for name in LIBRARIES}}
    if "jax" in sys.modules:
        jax = sys.modules["jax"]
        found["device"] = f"{jax.local_device_count()} x {jax.devices()[0].device_kind}"
    return {**found, "cores": len(os.sched_getaffinity(0)), "python": platform.python_version()}


def write(path: Path | None, found: Mapping[str, Any]) -> None:
    """Write `found` and its origin to `path`, if one is wanted."""
    if path is None:
        return
    from mjxball.train.run_directory import commit

    command = f"python benchmarks/{Path(sys.argv[0]).name} {shlex.join(sys.argv[1:])}".strip()
    path.write_text(text({**found, "command": command, "commit": commit(), "versions": versions()}), encoding="utf-8")


def text(found: Mapping[str, Any]) -> str:
    """A result file's text."""

    def part(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict | list):
            return "[\n" + ",\n".join(json.dumps(row, allow_nan=False) for row in value) + "\n]"
        return json.dumps(value, allow_nan=False)

    return "{\n" + ",\n".join(f"{json.dumps(key)}: {part(value)}" for key, value in finite(found).items()) + "\n}\n"
