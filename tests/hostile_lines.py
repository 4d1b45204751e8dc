"""Bad and hostile command lines and files, each in a process and a directory of its own.

A case is a command line that is sound but for one flaw, generated from the programs' own parsers, with the files that
it is given. `run` says what of this does not hold: exit code 2, one sentence on stderr, no traceback, less than 20 s
and 3 GB, nothing overwritten and nothing left behind.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from command_line import REPOSITORY as ROOT
from recording_bombs import BOMBS

from mjxball import cli, export
from mjxball import config as configs
from mjxball.commands import evaluate, train
from mjxball.policy.file import shipped_policy
from mjxfly import log
from mjxfly import main as fly
from mjxfly.app import main as app
from mjxfly.rig import design, gains, identify, mount
from mjxfly.view import main as view

SECONDS, MEMORY = 20.0, 3.0e9  # [s] of a line, [bytes] resident, at most
POLL = 0.05  # [s]
LONGEST = 1000  # characters of a sentence, paths included
SPARSE = 6 * 10**9  # bytes of a file that takes no room on the disk
Content = bytes | Callable[[Path], None]  # of a file, or what makes it


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(SPARSE)


ODD_FILES: dict[str, Content] = {
    "missing": lambda path: None,
    "a directory": lambda path: path.mkdir(),
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a pipe": os.mkfifo,
    "a loop of links": lambda path: path.symlink_to(path.name),
    "6 GB of nothing": _sparse,
    "empty": b"",
    "noise": Random(0).randbytes(5000),
    "other UTF": "\ufeff{}".encode("utf-16"),
}


def _changed(metadata: Callable[[str], str] = str, weight: float | None = None) -> bytes:
    """A shipped policy file with another text as its metadata, or one weight of another value."""
    with np.load(shipped_policy("balance")) as arrays:
        found = {name: array.copy() for name, array in arrays.items()}
    found["card"] = np.array(metadata(str(found["card"])))
    if weight is not None:
        found["weight_0"][0, 0] = weight
    stream = io.BytesIO()
    np.savez(stream, **found)
    return stream.getvalue()


def _edited(field: str, value: Any) -> bytes:
    return _changed(lambda text: json.dumps({**json.loads(text), field: value}))


METADATA_VALUES = {"gravity": 0, "control_period": 0, "action_reach": 2, "leader_kp": 3, "training_steps": 0}


def policies() -> dict[str, Content]:
    """Damaged policy files."""
    sound = shipped_policy("balance").read_bytes()
    return {
        "half of one": sound[: len(sound) // 2],
        "a flipped byte": bytes(sound[:900] + bytes([sound[900] ^ 255]) + sound[901:]),
        "a NaN weight": _changed(weight=float("nan")),
        "a weight of 1e30": _changed(weight=1e30),
        "format 99": _edited("format_version", 99),
        "control period 0": _edited("control_period", 0),
        "limits of NaN": _edited("command_limits", [float("nan"), 6.0]),
        "a twice given key": _changed(lambda text: '{"gravity": 1.62, ' + text[1:]),
        "flown by one drone": _edited("flown", {"drones": [1], "seconds": 60}),
        "metadata of 100 000 brackets": _changed(lambda text: "[" * 100_000),
        **{
            f"{field} {told}": _edited(field, [number] * count if count else number)
            for field, count in METADATA_VALUES.items()
            for told, number in (("of 401 digits", 10**400), ("1e-320", 1e-320), ("1e300", 1e300))
        },
        "flown for 1e-320 s": _edited("flown", {"drones": [2], "seconds": 1e-320}),
        "a bound of 10^400": _edited("bounds", {"rmse": 10**400}),
        "10^400 observations": _edited("history", 10**400),
    }


RIG = (ROOT / "mjxball" / "config" / "plants" / "team3.toml").read_text()


def rigs() -> dict[str, tuple[str, Content]]:
    """Damaged plant files: flaw -> (name, content)."""
    toml = {
        "no TOML": "plant = [",
        "a key given twice": "[plant]\nobject_mass = 0.3\nobject_mass = 0.4\n",
        "an unknown key": RIG.replace("carrier_mass", "carrier_weight"),
        "a word for a number": RIG.replace("object_mass = 0.3\n", 'object_mass = "0.3"\n'),
        "a mass of NaN": RIG.replace("object_mass = 0.3\n", "object_mass = nan\n"),
        "a mass of inf": RIG.replace("object_mass = 0.3\n", "object_mass = inf\n"),
        "a negative mass": RIG.replace("object_mass = 0.3\n", "object_mass = -0.3\n"),
        "drones of 1000 kg": RIG.replace("[[plant.drones]]\n", "[[plant.drones]]\nmass = 1000.0\n"),
        "arms of 46 m": RIG.replace("[plant]\n", "[plant]\narm = 46.0\n"),
        "a lag of 30 s": RIG.replace("[plant]\n", "[plant]\nrotor_lag = 30.0\n"),
        "rotors of 5.5 mN": RIG.replace("rotor_force_max = 8.0", "rotor_force_max = 0.0055"),
        "one drone": RIG[: RIG.index("[[plant.drones]]\nmount = [-")],
        "10 000 drones": RIG + "[[plant.drones]]\nmount = [0.1, 0.1, 0.0]\n" * 10_000,
        "drones in one place": RIG.replace("-0.09815, -0.17", "-0.09815, 0.17"),
        "drones that are a number": RIG.split("# The leader")[0].replace("[plant]", "[plant]\ndrones = 3"),
    }
    for told, number in (("of 401 digits", 10**400), ("1e-320", "1e-320"), ("5e-324", "5e-324"), ("1e300", "1e300")):
        for name in ("object_mass", "gravity", "arm"):
            toml[f"{name} {told}"] = f"[plant]\n{name} = {number}\n"
    text = json.dumps({"plant": {"object_mass": 0.3}})
    other = {
        "JSON: a key given twice": '{"plant": {"object_mass": 0.3, "object_mass": 0.4}}',
        "JSON: NaN": '{"plant": {"object_mass": NaN}}',
        "JSON: a mass of 401 digits": text.replace("0.3", str(10**400)),
        "JSON: a mass of 1e-320": text.replace("0.3", "1e-320"),
        "JSON: 1e400": text.replace("0.3", "1e400"),
        "JSON: a list": "[1, 2]",
        "JSON: brackets": '{"plant":' * 50_000,
    }
    found: dict[str, tuple[str, Content]] = {flaw: ("rig.toml", content.encode()) for flaw, content in toml.items()}
    return {**found, **{flaw: ("rig.json", content.encode()) for flaw, content in other.items()}}


def logs() -> dict[str, Content]:
    """What is no flight log."""
    return {
        "text": b"hello\n" * 100,
        "half a line": b'{"kind": "flight", "time": 0.',
        "numbers": b"1\n2\n3\n",
        "NaN": b'{"time": NaN, "record": "tick"}\n' * 50,
        "brackets": b"[" * 100_000,
    }


def series() -> dict[str, Content]:
    """Bad `--waveform` files."""
    rows = {
        "words": "time,offset\nnow,here\n",
        "NaN": "0,0\n1,nan\n2,0\n",
        "backwards": "0,0\n2,0.01\n1,0.02\n",
        "a time twice": "0,0\n1,0.01\n1,0.02\n",
        "one column": "0\n1\n2\n",
        "one sample": "0,0\n",
        "out of the object": "0,0\n1,17\n",
        "too many": "0,0\n" * 200_000,
    }
    return {flaw: text.encode() for flaw, text in rows.items()}


def sweeps() -> dict[str, Content]:
    """Bad `--sweep` files."""
    rows = {
        "no JSON": "{",
        "a key given twice": '{"leader.kp": [0.5, 0.6], "leader.kp": [0.1, 0.2]}',
        "an unknown setting": '{"leader.gain": [0.5, 0.6]}',
        "unlike lengths": '{"sac.learning_rate": [1e-3, 2e-3], "sac.tau": [0.1]}',
        "NaN": '{"sac.learning_rate": [NaN, 1e-3]}',
        "words": '{"sac.learning_rate": ["a", "b"]}',
        "a list": "[1, 2]",
        "a rate of 1e-320": '{"sac.learning_rate": [1e-320, 1e-3]}',
        "a rate of 401 digits": f'{{"sac.learning_rate": [{10**400}, 1e-3]}}',
        "a rate of a billion": '{"sac.learning_rate": [1e9, 1e-3]}',
    }
    return {flaw: text.encode() for flaw, text in rows.items()}


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

    kept, cli.Parser.parse_args = cli.Parser.parse_args, stop
    try:
        main([])
    except _FoundError as found:
        parser: argparse.ArgumentParser = found.args[0]
        return parser
    finally:
        cli.Parser.parse_args = kept
    raise RuntimeError(f"{main} made no parser")


def programs() -> list[Program]:
    """Every command of the project that a user calls."""
    flies, flight = (lambda name: ("-m", f"mjxfly.{name}")), str(shipped_policy("flight"))
    balance = str(shipped_policy("balance"))
    text = frozenset(
        {
            "--env",
            "--reward",
            "--twin-load",
            "--twin-mount",
            "--mocap-option",
            "--bodies",
            "--mocap-host",
            "--coordinator",
        }
    )
    learning = ("paper", "--physics", "newton-euler", "--out", "run")
    short = ("copy", "--seconds", "1", "--physics", "newton-euler")
    return [
        Program("train", (str(ROOT / "train.py"),), learning, train.parser(), text),
        Program("eval", (str(ROOT / "eval.py"),), ("--followers", *short), evaluate.parser(), text),
        Program("export", ("-m", "mjxball.export"), (balance, "out.npz"), parser_in(export.main), text),
        Program("fly", ("-m", "mjxfly"), (flight, "--rehearse", "--seconds", "2"), fly.make_parser(), text),
        Program("view", flies("view"), (*short, "--out", "page.html"), view.parser(), text),  # mjxball.view and more
        Program("app", flies("app"), (flight, "app"), parser_in(app.main), text),
        Program("log", flies("log"), ("flight.jsonl", "out"), parser_in(log.main), text),
        Program("gains", flies("rig.gains"), ("--out", "gains.json"), gains.parser(), text),
        Program("design", flies("rig.design"), ("--plant", "team3"), design.parser(), text),
        Program("mount", flies("rig.mount"), ("flight.jsonl",), mount.parser(), text),
        Program("identify", flies("rig.identify"), ("flight.jsonl", "--out", "plant.json"), identify.parser(), text),
    ]


WORDS: dict[Any, tuple[str, ...]] = {
    float: ("nan", "inf", "1e999", "abc", "", "1e-320", "1e300", "9" * 400),
    int: ("abc", "1.5", "1e30", "nan", "", "9" * 400, "9" * 5000),
}


def _named(word: str) -> str:
    return word if len(word) < 20 else f"{len(word)} digits"


OUTPUTS = ("--out", "--json", "--log", "--save")


def words(program: Program, random: Random) -> Iterator[Case]:
    """Every flag of a parser but the configuration's with values that its type does not take."""
    for action in program.parser._actions:
        flag = next((name for name in action.option_strings if name.startswith("--")), None)
        if flag is None or action.dest in ("help", "version") or action.dest.startswith("config:"):
            continue
        if flag in program.skip or flag in OUTPUTS or (action.type is Path and flag != "--plant"):
            continue
        if action.nargs == 0:
            yield _with(program, f"{flag}=yes", f"{flag}=yes")
            continue
        count = action.nargs if isinstance(action.nargs, int) else 1
        if action.choices is not None:
            wrong = ("", "nonsense")
        elif action.type in WORDS:
            wrong = tuple(random.sample(WORDS[action.type], 3))
        else:
            wrong = ("",)
        for word in wrong:
            yield _with(program, f"{flag} {_named(word)!r}", flag, *[word] * count)
        if action.type in WORDS and not flag.endswith("-seed") and flag != "--seed":
            yield _with(program, f"{flag} a billion", flag, *[f"1{'0' * 9}"] * count)
        if action.nargs != "?":
            yield _with(program, f"{flag} alone", flag)


def settings(program: Program, random: Random, count: int) -> Iterator[Case]:
    """Some of the configuration's flags with what no setting is."""
    leaves = random.sample([path for path, _, _ in configs.leaves(configs.Config())], count)
    for number, path in enumerate(leaves):
        word = ("nan", "1e999", "-1e30", "abc", "1,2,3,4,5,6,7,8,x", "1e-320", "1e13", "1e300", "9" * 400)[number % 9]
        yield _with(program, f"--{path}={_named(word)}", f"--{path}={word}")
    for flag in (
        "sac.learning_rate=1e-320",
        "scenario.noise=0,1e9",
        "scenario.cg_speed=0,1e9",
        "sac.num_envs=10000000",
    ):
        yield _with(program, f"--{flag}, a range", f"--{flag}")
    meet = ("--distributed", "--coordinator", "localhost:1", "--process", "0", "--processes")
    for flaw, line in {
        "a billion processes": (*meet, "1000000000"),
        "no process": (*meet, "0"),
        "nobody's port": ("--distributed", "--coordinator", "localhost:99999", "--process", "0", "--processes", "2"),
    }.items():
        yield _with(program, flaw, *line)


def _with(program: Program, flaw: str, *flag: str, files: dict[str, Content] | None = None) -> Case:
    return Case(program.name, flaw, (*program.start, *program.line, *flag), files or {})


PLACES = {"train": "run", "eval": "out", "view": "page.html", "export": "out.npz", "app": "app", "gains": "gains.json"}


def files(every: dict[str, Program]) -> Iterator[Case]:
    """A bad file in the place of every one that a command reads, and something where it writes."""
    for flaw, content in {**ODD_FILES, **policies()}.items():
        bad, made = "bad.npz", {"bad.npz": content}
        for name, line in {
            "eval": (bad, "--seconds", "1", "--physics", "newton-euler"),
            "view": (bad, "--seconds", "1", "--out", "page.html"),
            "fly": (bad, "--rehearse", "--seconds", "2"),
            "export": (bad, "out.onnx"),
            "app": (bad, "app"),
            "train": ("balance", "--start-from", bad, "--out", "run"),
        }.items():
            if name in ("eval", "fly") or flaw in ODD_FILES or flaw == "a twice given key":
                yield Case(name, f"policy: {flaw}", (*every[name].start, *line), made)
    odd = {f: ("rig.toml", c) for f, c in ODD_FILES.items()} | {
        f"model: {f}": ("rig.xml", c) for f, c in ODD_FILES.items()
    }
    for flaw, (file, content) in {**odd, **rigs()}.items():
        yield _with(every["train"], f"--plant {flaw}", "--plant", file, files={file: content})
        if flaw in ODD_FILES or len(flaw) % 2:
            yield _with(every["eval"], f"--plant {flaw}", "--plant", file, files={file: content})
    for flaw, content in {**ODD_FILES, **logs()}.items():
        made = {"flight.jsonl": content}
        for name, line in {
            "log": ("flight.jsonl", "out"),
            "view": ("flight.jsonl", "--out", "page.html"),
            "identify": ("flight.jsonl", "--out", "plant.json"),
            "mount": ("flight.jsonl",),
        }.items():
            yield Case(name, f"log: {flaw}", (*every[name].start, *line), made)
    for flaw, content in {**ODD_FILES, **series()}.items():
        yield _with(every["eval"], f"--waveform {flaw}", "--waveform", "wave.csv", files={"wave.csv": content})
    for flaw, content in {**ODD_FILES, **sweeps()}.items():
        yield _with(every["train"], f"--sweep {flaw}", "--sweep", "sweep.json", files={"sweep.json": content})
    for flaw, content in ODD_FILES.items():
        yield _with(every["fly"], f"--gains {flaw}", "--gains", "own.json", files={"own.json": content})
    yield from numbers(every)
    yield from outputs(every)


def numbers(every: dict[str, Program]) -> Iterator[Case]:
    """What says that it is larger than any computer, and plants of such numbers where others read them."""
    for flaw, make in BOMBS.items():
        for name, line in {
            "log": (flaw, "out.csv"),
            "view": (flaw, "--out", "page.html"),
            "identify": (flaw, "--out", "plant.json"),
            "mount": (flaw,),
        }.items():
            yield Case(name, f"recording: {flaw}", (*every[name].start, *line), {flaw: make})
    for flaw, (file, content) in rigs().items():
        if flaw.split()[0] in ("object_mass", "gravity", "arm", "JSON:"):
            yield _with(every["design"], f"--plant {flaw}", "--plant", file, files={file: content})
            yield _with(every["gains"], f"--plant {flaw}", "--plant", file, files={file: content})


def outputs(every: dict[str, Program]) -> Iterator[Case]:
    """Where a command writes there is something already, or no directory."""
    for name, place in PLACES.items():
        line = every[name] if name != "eval" else None
        flags = () if line else ("--out", place)
        made: Content = _full if name in ("train", "eval", "app") else b"mine"
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


def every_case(seed: int = 0, config_flags: int = 90) -> list[Case]:
    """All of them, in a fixed order."""
    random, named = Random(seed), {program.name: program for program in programs()}
    found: list[Case] = []
    for program in named.values():
        found += words(program, random)
    return [*found, *settings(named["train"], random, config_flags), *files(named)]


def run(case: Case, longest: float) -> dict[str, Any]:
    """What a case's process did, `wrong` being what it should not have."""
    with tempfile.TemporaryDirectory(prefix="hardening-") as folder:
        place, temporary, errors = Path(folder) / "work", Path(folder) / "tmp", Path(folder) / "stderr"
        place.mkdir()
        temporary.mkdir()
        for name, content in case.files.items():
            if isinstance(content, bytes):
                (place / name).write_bytes(content)
            else:
                content(place / name)
        before = listing(place)
        code, seconds, memory, why = watched(case, place, temporary, errors, longest)
        stderr = errors.read_text(errors="replace")[:20_000]
        changed = sorted(name for name, _ in before.items() ^ listing(place).items())
        left = sorted(path.name for path in temporary.iterdir())
    wrong = [why] if why else [] if code == 2 else [f"exit code: {code}"]
    wrong += [] if why else sentences(stderr)
    wrong += [f"changed: {', '.join(changed[:4])}"] if changed else []
    wrong += [f"left behind: {', '.join(left[:4])}"] if left else []
    line = [word.replace(str(ROOT) + "/", "") for word in case.arguments]
    return {
        **{"program": case.program, "flaw": case.flaw, "line": line, "code": code, "seconds": round(seconds, 2)},
        **{"bytes": memory, "stderr": stderr.replace(str(ROOT), "").strip()[-600:], "wrong": wrong},
    }


def sentences(stderr: str) -> list[str]:
    """What is wrong with what a refused command said."""
    lines = [line for line in stderr.splitlines() if line.strip() and not line.startswith("warning:")]
    if "Traceback" in stderr:
        return [f"traceback: {lines[-1][:150]}"]
    if len(lines) != 1:
        return [f"sentences: {len(lines)}"]
    return ["long: a sentence" for _ in "1" if len(lines[0]) > LONGEST]


def watched(
    case: Case, place: Path, temporary: Path, errors: Path, longest: float
) -> tuple[int | None, float, int, str | None]:
    """(exit code, seconds, bytes resident at most, why it was ended) of the case's process."""
    own = {"TMPDIR": str(temporary), "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    started, most, why = time.monotonic(), 0, None
    with errors.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, *case.arguments],
            cwd=place,
            env={**os.environ, **own},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stream,
            start_new_session=True,
        )
        while process.poll() is None and why is None:
            time.sleep(POLL)
            most = max(most, resident(process.pid))
            if time.monotonic() - started > longest:
                why = f"time: more than {longest:g} s"
            if most > MEMORY:
                why = f"memory: more than {MEMORY / 1e9:g} GB"
        if why:
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    return code if why is None else None, time.monotonic() - started, most, why


def resident(process: int) -> int:
    """Bytes of memory that a process has in use, 0 if it has ended."""
    try:
        pages = Path(f"/proc/{process}/statm").read_text().split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def listing(place: Path) -> dict[str, tuple[int, int]]:
    """Every file below a directory: (bytes, when it was written [ns])."""
    found = {}
    for path in place.rglob("*"):
        status = path.lstat()
        found[str(path.relative_to(place))] = (0 if path.is_dir() else status.st_size, status.st_mtime_ns)
    return found
