"""Bad and hostile command lines and files, generated from the programs' own parsers, for `hardening.py`.

A case is a command line that is sound but for one flaw. It starts in a directory of its own with the files that
`prepare` puts there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from hostile_files import ODD_FILES, ROOT, Content, logs, policies, rigs, series, sweeps
from mjxball import cli, export
from mjxball import config as configs
from mjxball.commands import evaluate, train
from mjxball.fly import main as fly
from mjxball.policy.file import shipped_policy
from mjxball.rig import gains, identify
from mjxball.view import command as view


@dataclass(frozen=True)
class Case:
    """One command line."""

    program: str
    flaw: str
    arguments: tuple[str, ...]
    files: dict[str, Content] = field(default_factory=dict)


@dataclass(frozen=True)
class Program:
    """A command with a sound line; `{}` in `line` is where a flag may be put."""

    name: str
    start: tuple[str, ...]  # python arguments
    line: tuple[str, ...]
    parser: argparse.ArgumentParser
    skip: frozenset[str] = frozenset()  # flags that take any text, or that are outputs


class _FoundError(Exception):
    """Carries a parser out of the `main` that makes it."""


def parser_in(main: Callable[[list[str]], Any]) -> argparse.ArgumentParser:
    """The parser that `main` makes for itself."""

    def stop(self: Any, *_: Any, **__: Any) -> Any:
        raise _FoundError(self)

    kept, cli.Parser.parse_args = cli.Parser.parse_args, stop  # type: ignore[assignment]
    try:
        main([])
    except _FoundError as found:
        parser: argparse.ArgumentParser = found.args[0]
        return parser
    finally:
        cli.Parser.parse_args = kept  # type: ignore[method-assign]
    raise RuntimeError(f"{main} made no parser")


def programs() -> list[Program]:
    """Every command of the project that a user calls."""
    module, flight = (lambda name: ("-m", f"mjxball.{name}")), str(shipped_policy("flight"))
    balance = str(shipped_policy("balance"))
    text = frozenset(
        {"--env", "--reward", "--twin-load", "--mocap-option", "--bodies", "--mocap-host", "--coordinator"}
    )
    learning = ("paper", "--physics", "newton-euler", "--out", "run")
    short = ("copy", "--seconds", "1", "--physics", "newton-euler")
    return [
        Program("train", (str(ROOT / "train.py"),), learning, train.parser(), text),
        Program("eval", (str(ROOT / "eval.py"),), ("--followers", *short), evaluate.parser(), text),
        Program("view", module("view"), (*short, "--out", "page.html"), view.parser(), text),
        Program("fly", module("fly"), (flight, "--rehearse", "--seconds", "2"), fly.make_parser(), text),
        Program("export", module("export"), (balance, "out.npz"), parser_in(export.main), text),
        Program("gains", module("rig.gains"), ("--out", "gains.json"), gains.parser(), text),
        Program("identify", module("rig.identify"), ("flight.jsonl", "--out", "plant.json"), identify.parser(), text),
    ]


# --- one word ---------------------------------------------------------------------------------------------------------

WORDS: dict[Any, tuple[str, ...]] = {
    float: ("nan", "inf", "1e999", "abc", ""),
    int: ("abc", "1.5", "1e30", "nan", ""),
}
OUTPUTS = ("--out", "--json", "--log", "--save")


def words(program: Program, random: Random) -> Iterator[Case]:
    """Every flag of a parser but the configuration's with values that its type does not take."""
    for action in program.parser._actions:
        flag = next((name for name in action.option_strings if name.startswith("--")), None)
        if (
            flag is None
            or action.dest in ("help", "version")
            or action.dest.startswith("config:")
            or flag in program.skip
        ):
            continue
        if flag in OUTPUTS or (action.type is Path and flag != "--plant"):
            continue
        if action.nargs == 0:
            yield _with(program, f"{flag}=yes", f"{flag}=yes")
            continue
        count = action.nargs if isinstance(action.nargs, int) else 1
        if action.choices is not None:
            wrong = ("", "nonsense")
        elif action.type in WORDS:
            wrong = tuple(random.sample(WORDS[action.type], 2))
        else:
            wrong = ("",)
        for word in wrong:
            yield _with(program, f"{flag} {word!r}", flag, *[word] * count)
        if action.nargs != "?":
            yield _with(program, f"{flag} alone", flag)


def settings(program: Program, random: Random, count: int) -> Iterator[Case]:
    """Some of the configuration's flags with what no setting is."""
    leaves = random.sample([path for path, _, _ in configs.leaves(configs.Config())], count)
    for number, path in enumerate(leaves):
        word = ("nan", "1e999", "-1e30", "abc", "1,2,3,4,5,6,7,8,9")[number % 5]
        yield _with(program, f"--{path}={word}", f"--{path}={word}")


def _with(program: Program, flaw: str, *flag: str, files: dict[str, Content] | None = None) -> Case:
    return Case(program.name, flaw, (*program.start, *program.line, *flag), files or {})


# --- files ------------------------------------------------------------------------------------------------------------

PLACES = {"train": "run", "eval": "out", "view": "page.html", "export": "out.npz", "gains": "gains.json"}


def files(every: dict[str, Program]) -> Iterator[Case]:
    """A bad file in the place of every one that a command reads, and something where it writes."""
    for flaw, content in {**ODD_FILES, **policies()}.items():
        bad, made = "bad.npz", {"bad.npz": content}
        for name, line in {
            "eval": (bad, "--seconds", "1", "--physics", "newton-euler"),
            "view": (bad, "--seconds", "1", "--out", "page.html"),
            "fly": (bad, "--rehearse", "--seconds", "2"),
            "export": (bad, "out.onnx"),
            "train": ("balance", "--start-from", bad, "--out", "run"),
        }.items():
            if name in ("eval", "fly") or flaw in ODD_FILES or flaw == "a twice given key":
                yield Case(name, f"policy: {flaw}", (*every[name].start, *line), made)
    for flaw, (file, content) in {**{f: ("rig.toml", c) for f, c in ODD_FILES.items()}, **rigs()}.items():
        yield _with(every["train"], f"--plant {flaw}", "--plant", file, files={file: content})
        if flaw in ODD_FILES or len(flaw) % 2:
            yield _with(every["eval"], f"--plant {flaw}", "--plant", file, files={file: content})
    for flaw, content in {**ODD_FILES, **logs()}.items():
        made = {"flight.jsonl": content}
        for name, line in {
            "eval": ("--flight", "flight.jsonl", "--out", "out"),
            "view": ("flight.jsonl", "--out", "page.html"),
            "identify": ("flight.jsonl", "--out", "plant.json"),
        }.items():
            yield Case(name, f"log: {flaw}", (*every[name].start, *line), made)
    for flaw, content in {**ODD_FILES, **series()}.items():
        yield _with(every["eval"], f"--waveform {flaw}", "--waveform", "wave.csv", files={"wave.csv": content})
    for flaw, content in {**ODD_FILES, **sweeps()}.items():
        yield _with(every["train"], f"--sweep {flaw}", "--sweep", "sweep.json", files={"sweep.json": content})
    for flaw, content in ODD_FILES.items():
        yield _with(every["fly"], f"--gains {flaw}", "--gains", "own.json", files={"own.json": content})
    yield from outputs(every)


def outputs(every: dict[str, Program]) -> Iterator[Case]:
    """Where a command writes there is something already, or no directory."""
    for name, place in PLACES.items():
        line = every[name] if name != "eval" else None
        flags = () if line else ("--out", place)
        made: Content = _full if name in ("train", "eval") else b"mine"
        yield _with(every[name], f"{place} exists", *flags, files={place: made})
        if name in ("train", "eval"):
            yield _with(every[name], f"{place} is a file", *flags, files={place: b"mine"})
    for flag, file in (("--json", "cells.json"), ("--json", "nowhere/cells.json"), ("--json", "cells.txt")):
        yield _with(every["eval"], f"{flag} {file}", flag, file, files={"cells.json": b"mine"})
    yield _with(every["view"], "--save exists", "--save", "f.npz", files={"f.npz": b"mine"})
    yield _with(every["fly"], "--log exists", "--log", "f.jsonl", files={"f.jsonl": b"mine"})


def _full(path: Path) -> None:
    path.mkdir()
    (path / "mine").write_text("mine")


def every_case(seed: int = 0, config_flags: int = 40) -> list[Case]:
    """All of them, in a fixed order."""
    random, named = Random(seed), {program.name: program for program in programs()}
    found: list[Case] = []
    for program in named.values():
        found += words(program, random)
    return [*found, *settings(named["train"], random, config_flags), *files(named)]


def prepare(case: Case, place: Path) -> None:
    """Put the case's files into the directory `place`."""
    for name, content in case.files.items():
        if isinstance(content, bytes):
            (place / name).write_bytes(content)
        else:
            content(place / name)


def spread(cases: Sequence[Case], count: int) -> list[Case]:
    """`count` of the cases, evenly from their order; all of them if there are fewer."""
    step = max(len(cases) / count, 1.0)
    return [cases[int(number * step)] for number in range(min(count, len(cases)))]
