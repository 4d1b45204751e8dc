"""Damaged policy files and run records, and what loading them did: each must load right or be refused in one sentence.

Counts for every kind of damage what loaded, what was refused, and what went wrong: another exception than the one-line
refusal, code run from the file, too much memory, too much time.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import signal
import struct
import sys
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.errors import InputError
from mjxball.evaluate.policies import load_policy
from mjxball.policy import Policy, shipped_policies
from mjxball.train.curves import read_members, training_summary
from mjxball.train.run_directory import read_config, write_config

Mutation = Callable[[Random, bytes], bytes]  # of a sound file's bytes
MEMORY = 256 * 2**20  # [B] that reading one file may take: a few times the largest file that is read
PATIENCE = 10.0  # [s] for one file
SEEN = np.random.default_rng(0).normal(size=(5, OBSERVATION_SIZE))
FORBIDDEN = ("pickle.find_class", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect")
WITNESS = "MJXBALL_FUZZ_WITNESS"  # environment variable that unpickled code would set
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, -(2**64), 10**400, 1e308, -1e308, 1e-320, 0.1),
    *(float("nan"), float("inf"), "", "x", "a\nb", "\x1b[31m", "\u202e", "\ud800", "é" * 50, [], {}, [[]], {"": {}}),
    *([1, 2], [None, None], ["a", "b"], {"a": [1]}, [float("nan")] * 3, "x" * 10_000),
)


FIELDS = {  # of a zip: where numbers stand behind each signature
    **{b"PK\x01\x02": (8, 10, 20, 24, 28, 30, 42), b"PK\x05\x06": (8, 10, 12, 16, 20)},
    **{b"PK\x03\x04": (6, 8, 18, 22, 26, 28)},
}
NAMES = ("../../x.npy", "/etc/x.npy", "é\u202e.npy", "a\nb.npy", "a\0b.npy", "card", "weight_0.npy.npy", ".npy", "a/")
events: list[str] = []  # forbidden ones, as Python's audit hook tells them
sys.addaudithook(lambda event, _: events.append(event) if event in FORBIDDEN else None)


class Explosive:
    """Sets an environment variable when unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"import os; os.environ[{WITNESS!r}] = 'executed'",)


def flipped_bits(draw: Random, content: bytes) -> bytes:
    """1 to 8 bits flipped, half the time in the last 1500 bytes: a zip's directory."""
    changed = bytearray(content)
    low = max(0, len(changed) - 1500) if draw.random() < 0.5 else 0
    for _ in range(draw.randint(1, 8)):
        changed[draw.randrange(low, len(changed))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def truncated(draw: Random, content: bytes) -> bytes:
    """Cut short, or without its beginning."""
    place = draw.randrange(len(content))
    return content[:place] if draw.random() < 0.7 else content[place:]


def inserted(draw: Random, content: bytes) -> bytes:
    """Random bytes, zeros or a copy of a part put in somewhere."""
    place, length = draw.randrange(len(content)), draw.choice((1, 2, 7, 64, 4096))
    start = draw.randrange(len(content))
    part = draw.choice((draw.randbytes(length), bytes(length), content[start : start + length]))
    return content[:place] + part + content[place:]


def overwritten(draw: Random, content: bytes) -> bytes:
    """A stretch replaced by random bytes, 0xff or bytes that formats know."""
    place = draw.randrange(len(content))
    known = (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07", b"\x93NUMPY", b"(dp0")
    new = draw.choice((draw.randbytes(draw.randint(1, 64)), b"\xff" * draw.randint(1, 16), draw.choice(known)))
    return content[:place] + new + content[place + len(new) :]


def removed(draw: Random, content: bytes) -> bytes:
    """A stretch taken out."""
    place = draw.randrange(len(content))
    return content[:place] + content[place + draw.choice((1, 2, 8, 500)) :]


def _entries(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zipped(entries: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(stream, "w", method) as archive:  # of names twice
        for name, content in entries:
            archive.writestr(name, content)
    return stream.getvalue()


def _replaced(content: bytes, name: str, new: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    return _zipped([*{**_entries(content), name: new}.items()], method)


def _relabelled(content: bytes, size: int) -> bytes:
    """The sizes unpacked that the last entry of a zip claims, in its header and in the directory."""
    changed, local, central = bytearray(content), content.rfind(b"PK\x03\x04"), content.rfind(b"PK\x01\x02")
    struct.pack_into("<I", changed, local + 22, size)
    struct.pack_into("<I", changed, central + 24, size)
    return bytes(changed)


def bomb(draw: Random, content: bytes) -> bytes:
    """Tens of megabytes of zeros packed small: told truly, or as less or more than they are."""
    name = draw.choice(("weight_0.npy", "card.npy", "bias_9.npy"))
    others = [(key, value) for key, value in _entries(content).items() if key != name]
    packed = _zipped([*others, (name, bytes(draw.choice((20, 70)) * 2**20))], zipfile.ZIP_DEFLATED)
    return packed if draw.random() < 0.5 else _relabelled(packed, draw.choice((0, 100, 10_000, 2**31, 2**32 - 2)))


def false_sizes(draw: Random, content: bytes) -> bytes:
    """A field of the directory or of the end record set to an extreme number."""
    changed = bytearray(content)
    signature = draw.choice([*FIELDS])
    places = [k for k in range(len(content)) if content.startswith(signature, k)]
    value = draw.choice((0, 1, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF))
    place = draw.choice(places) + draw.choice(FIELDS[signature])
    struct.pack_into("<H" if value <= 0xFFFF else "<I", changed, min(place, len(changed) - 4), value)
    return bytes(changed)


def many_entries(draw: Random, content: bytes) -> bytes:
    """A directory of thousands of entries."""
    count = draw.choice((70, 500, 3000))
    return _zipped([*_entries(content).items(), *((f"weight_{k}.npy", b"") for k in range(3, count))])


def odd_entries(draw: Random, content: bytes) -> bytes:
    """Entries twice, renamed, missing, with names of any kind or packed by another method."""
    entries = [*_entries(content).items()]
    place = draw.randrange(len(entries))
    change = draw.randrange(4)
    if change == 0:
        entries.append((entries[place][0], draw.choice((entries[place][1], b"", b"x"))))
    elif change == 1:
        entries[place] = (draw.choice(NAMES), entries[place][1])
    elif change == 2:
        del entries[place]
    else:
        return _zipped(entries, draw.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED)))
    return _zipped(entries)


def pickled(draw: Random, content: bytes) -> bytes:
    """An array of objects, or a bare pickle in the place of an array."""
    stream = io.BytesIO()
    array = np.empty(draw.choice(((), (1,), (3, 2))), object)
    array[...] = Explosive()
    np.save(stream, array, allow_pickle=True)
    new = stream.getvalue() if draw.random() < 0.7 else pickle.dumps(Explosive())
    return _replaced(content, draw.choice(("card.npy", "weight_0.npy", "observation_mean.npy", "extra.npy")), new)


def array_headers(draw: Random, content: bytes) -> bytes:
    """The header of one array says something else: dtype, shape, order, version, or no literal at all."""
    name = draw.choice([*_entries(content)])
    shapes = ("(2**40,)", f"({2**40},)", "(-1,)", "(0,)", "()", f"({2**31}, {2**31})", "(1.5,)", "'x'", "(True,)")
    types = ("'<f4'", "'>f4'", "'|O'", "'<U0'", "'V0'", "'<U2000000000'", "[('a','<f4')]", "'<m8'", "'f'", "[" * 60)
    shape = draw.choice(shapes) if draw.random() < 0.6 else f"({draw.randrange(200)}, {draw.randrange(200)})"
    text = (
        f"{{'descr': {draw.choice(types)}, 'fortran_order': {draw.choice(('True', 'False', '1'))}, 'shape': {shape}}}"
    )
    if draw.random() < 0.2:
        text = draw.choice(("", "{}", "(" * 9000, "__import__('os')", "{'descr': 1}", "\0" * 100, "1" * 9000))
    body = text.encode() + b"\n"
    version = draw.choice(((1, 0), (1, 0), (2, 0), (3, 0), (9, 9)))
    length = len(body) if draw.random() < 0.8 else draw.choice((0, 0xFFFF))
    packed = struct.pack("<H" if version == (1, 0) else "<I", length)
    data = _entries(content)[name][128:]
    return _replaced(content, name, b"\x93NUMPY" + bytes(version) + packed + body + data)


def array_values(draw: Random, content: bytes) -> bytes:
    """NaN, infinities, huge and tiny numbers among the weights; the zip itself is sound."""
    entries = {key: value for key, value in _entries(content).items() if key != "card.npy"}
    name = draw.choice([*entries])
    changed = bytearray(entries[name])
    value = draw.choice((np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, -1.0, 0.0))
    struct.pack_into("<f", changed, 128 + 4 * draw.randrange((len(changed) - 128) // 4), value)
    return _replaced(content, name, bytes(changed))


def _with_metadata(content: bytes, text: str) -> bytes:
    stream = io.BytesIO()
    try:
        np.save(stream, np.array(text))
    except (UnicodeEncodeError, ValueError):
        np.save(stream, np.array(text.encode("utf-8", "replace")))
    return _replaced(content, "card.npy", stream.getvalue())


def hostile_text(draw: Random) -> str:
    """JSON that is deep, long, huge in its numbers, or no JSON."""
    deep, wide = draw.choice((100, 10_000, 200_000)), draw.choice((1000, 400_000))
    choices = (
        lambda: "[" * deep + "]" * deep,
        lambda: '{"a":' * deep + "1" + "}" * deep,
        lambda: "[" + "[]," * wide + "[]]",
        lambda: '{"format_version":' + "9" * draw.choice((400, 4000, 5000, 300_000)) + "}",
        lambda: '{"gravity":1e999999999}',
        lambda: draw.choice(("", "null", "NaN", "[1]", "{", '"', "\0", "{}", '{"a":1,"a":2}', "\ufeff{}", "'a'")),
    )
    return draw.choice(choices)()


def metadata_text(draw: Random, content: bytes) -> bytes:
    """The whole metadata replaced."""
    return _with_metadata(content, hostile_text(draw))


def damaged(draw: Random, tree: Any) -> Any:
    """A JSON tree with one to three of its values replaced, removed, renamed or doubled, at any depth."""
    for _ in range(draw.randint(1, 3)):
        spot = tree
        while isinstance(spot, dict) and spot:
            key = draw.choice([*spot])
            if isinstance(spot[key], dict) and spot[key] and draw.random() < 0.6:
                spot = spot[key]
                continue
            action = draw.randrange(6)
            if action == 0:
                del spot[key]
            elif action == 1:
                spot[draw.choice(("x", "", "é", key + "_", "a\nb"))] = spot.pop(key)
            elif action == 2 and isinstance(spot[key], list):
                spot[key] = [*spot[key], draw.choice(ODD_VALUES)]
            else:
                spot[key] = draw.choice(ODD_VALUES)
            break
    return tree


def metadata_values(draw: Random, content: bytes) -> bytes:
    """Fields of the metadata replaced, removed, renamed."""
    metadata = json.loads(str(np.load(io.BytesIO(_entries(content)["card.npy"]))))
    return _with_metadata(content, json.dumps(damaged(draw, metadata)))


def json_values(draw: Random, content: bytes) -> bytes:
    """Values of a JSON file replaced, removed, renamed."""
    return json.dumps(damaged(draw, json.loads(content))).encode("utf-8", "replace")


def json_text(draw: Random, content: bytes) -> bytes:
    """A JSON file replaced."""
    return hostile_text(draw).encode("utf-8", "replace")


def csv_cells(draw: Random, content: bytes) -> bytes:
    """Cells, rows and the header of a CSV file damaged."""
    rows = [line.split(b",") for line in content.splitlines()]
    row = draw.choice(rows)
    odd = (b"", b"x", b"nan", b"inf", b"1e400", b"-1", b"9" * 5000, b'"', b"\xff", b"\0", "²".encode(), b"1\n2", b"1,2")
    row[draw.randrange(len(row))] = draw.choice(odd)
    if draw.random() < 0.2:
        rows = rows[draw.randrange(len(rows)) :] + rows[: draw.randrange(3)]
    return b"\n".join(b",".join(row) for row in rows)


ANY: tuple[Mutation, ...] = (flipped_bits, truncated, inserted, overwritten, removed)
POLICY = (*ANY, false_sizes, bomb, odd_entries, many_entries, pickled)
POLICY += (array_headers, array_values, metadata_values, metadata_text)
JSON, CSV = (*ANY, json_values, json_text), (*ANY, csv_cells)


class HangError(BaseException):
    """Reading took longer than `PATIENCE`; no loader's `except Exception` can catch it."""


@dataclass
class Count:
    """What became of the files of one kind."""

    kind: str
    files: int = 0
    loaded: int = 0
    refused: int = 0
    faults: int = 0
    longest: float = 0.0  # [s]
    memory: float = 0.0  # [MiB] most of any file


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Raise HangError in the body after `seconds`."""

    def over(*_: Any) -> None:
        raise HangError

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def outcome(load: Callable[[Path], object], path: Path) -> str:
    """'loaded', 'refused', or what went wrong."""
    events.clear()
    os.environ.pop(WITNESS, None)
    try:
        with patience(PATIENCE):
            load(path)
        result = "loaded"
    except InputError as error:
        result = "refused" if str(error).isprintable() and str(error) else f"not one line: {str(error)[:80]!r}"
    except HangError:
        result = "it hung"
    except BaseException as error:
        result = f"{type(error).__name__}: {str(error)[:80]}"
    if events or WITNESS in os.environ:
        result = f"ran code: {events or WITNESS}"
    return result


def measured(load: Callable[[Path], object], path: Path, count: Count) -> str:
    """`outcome`, with time and memory added to `count`."""
    tracemalloc.start()
    began = time.perf_counter()
    result = outcome(load, path)
    count.longest = max(count.longest, time.perf_counter() - began)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    count.memory = max(count.memory, peak / 2**20)
    if peak > MEMORY:
        result = f"took {peak >> 20} MiB"
    count.files += 1
    if result in ("loaded", "refused"):
        setattr(count, result, getattr(count, result) + 1)
    else:
        count.faults += 1
        print(f"FAULT {count.kind}: {result}", file=sys.stderr)
    return result


def load_and_fly(path: Path) -> None:
    """What `eval.py` does with a policy file before it flies, and one batch of commands, which must be finite."""
    policy = Policy.load(path)
    if not np.isfinite(policy(SEEN)).all():
        raise ArithmeticError("a command is not finite")
    load_policy(path, configs.preset("paper"))


def read_records(run: Path) -> None:
    """All that is read of a run directory besides its checkpoints."""
    read_config(run)
    read_members(run)
    training_summary(run, 0)


def records(run: Path) -> Path:
    """The records of a run of two members, without its checkpoints."""
    origin = {"seed": 0, "physics": "mjx", "seeds": 2, "sweep": None, "command": "train"}
    write_config(run, configs.preset("transport"), origin)
    header = "steps,seconds,rate,episode_return,eval_return"
    (run / "metrics.csv").write_text(f"{header}\n1024,0.5,2000.0,-3.5,\n2048,1.0,2000.0,-2.5,-1.25\n")
    members = "steps,seed,eval_return,eval_steady_error,eval_peak,eval_tilt_error,eval_vertical_error"
    (run / "members.csv").write_text(f"{members}\n2048,0,-1.5,0.1,0.2,0.01,0.1\n2048,1,-1.0,0.1,0.2,0.01,0.1\n")
    return run


def fuzz_policies(files: int, seed: int, place: Path) -> list[Count]:
    """Damaged copies of the shipped policies."""
    originals, path = [path.read_bytes() for path in shipped_policies()], place / "policy.npz"
    return _fuzz(load_and_fly, path, [(path, originals, mutate) for mutate in POLICY], files, seed)


def fuzz_records(run: Path, files: int, seed: int) -> list[Count]:
    """A run directory of which one text file is damaged."""
    places = {run / "config.json": JSON, run / "metrics.csv": CSV, run / "members.csv": CSV}
    kinds = [(path, [path.read_bytes()], mutate) for path, mutations in places.items() for mutate in mutations]
    return _fuzz(read_records, run, kinds, files, seed)


def _fuzz(
    load: Callable[[Path], object],
    read: Path,
    kinds: Sequence[tuple[Path, list[bytes], Mutation]],
    files: int,
    seed: int,
) -> list[Count]:
    """Of every kind (file, what it held, damage) in turn, `files` in all, what `load` makes of `read`."""
    counts = [Count(f"{path.name}, {mutate.__name__.replace('_', ' ')}") for path, _, mutate in kinds]
    for number in range(files):
        draw, (path, sound, mutate) = Random(f"{seed} {number}"), kinds[number % len(kinds)]
        path.write_bytes(mutate(draw, draw.choice(sound)))
        measured(load, read, counts[number % len(kinds)])
        path.write_bytes(sound[0])
    return counts
