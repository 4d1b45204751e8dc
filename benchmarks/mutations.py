"""Ways to damage a policy file or a run's text files: `KINDS[name](draw, content) -> content`, for fuzzing the loaders.

Every function takes a `random.Random` and the bytes of a sound file, and returns other bytes.
"""

from __future__ import annotations

import io
import json
import pickle
import struct
import warnings
import zipfile
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

Mutation = Callable[[Random, bytes], bytes]
WITNESS = "MJXBALL_FUZZ_WITNESS"  # environment variable that unpickled code would set
HUGE = 10**400
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, -(2**64), HUGE, 1e308, -1e308, 1e-320, 0.1),
    *(float("nan"), float("inf"), "", "x", "a\nb", "\x1b[31m", "\u202e", "\ud800", "é" * 50, [], {}, [[]], {"": {}}),
    *([1, 2], [None, None], ["a", "b"], {"a": [1]}, [float("nan")] * 3, "x" * 10_000),
)


class Explosive:
    """Sets an environment variable when unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"import os; os.environ[{WITNESS!r}] = 'executed'",)


# --- any file -------------------------------------------------------------------------------------------------------


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
    return (
        content[:place]
        + draw.choice((draw.randbytes(length), bytes(length), content[start : start + length]))
        + (content[place:])
    )


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


# --- the zip --------------------------------------------------------------------------------------------------------


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
    signature, fields = draw.choice(
        (
            (b"PK\x01\x02", (8, 10, 20, 24, 28, 30, 42)),
            (b"PK\x05\x06", (8, 10, 12, 16, 20)),
            (b"PK\x03\x04", (6, 8, 18, 22, 26, 28)),
        )
    )
    places = [k for k in range(len(content)) if content.startswith(signature, k)]
    value = draw.choice((0, 1, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF))
    place = draw.choice(places) + draw.choice(fields)
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
    names = (
        "../../x.npy",
        "/etc/x.npy",
        "é\u202e.npy",
        "a\nb.npy",
        "a\0b.npy",
        "card",
        "weight_0.npy.npy",
        ".npy",
        "a/",
    )
    change = draw.randrange(4)
    if change == 0:
        entries.append((entries[place][0], draw.choice((entries[place][1], b"", b"x"))))
    elif change == 1:
        entries[place] = (draw.choice(names), entries[place][1])
    elif change == 2:
        del entries[place]
    else:
        return _zipped(entries, draw.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED)))
    return _zipped(entries)


# --- the arrays -----------------------------------------------------------------------------------------------------


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


# --- the card and other JSON ----------------------------------------------------------------------------------------


def _with_card(content: bytes, text: str) -> bytes:
    stream = io.BytesIO()
    try:
        np.save(stream, np.array(text))
    except (UnicodeEncodeError, ValueError):
        np.save(stream, np.array(text.encode("utf-8", "replace")))
    return _replaced(content, "card.npy", stream.getvalue())


def _card(content: bytes) -> Any:
    return json.loads(str(np.load(io.BytesIO(_entries(content)["card.npy"]))))


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


def hostile_card(draw: Random, content: bytes) -> bytes:
    """The whole card replaced."""
    return _with_card(content, hostile_text(draw))


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


def card_values(draw: Random, content: bytes) -> bytes:
    """Fields of the card replaced, removed, renamed."""
    return _with_card(content, json.dumps(damaged(draw, _card(content))))


ANY: dict[str, Mutation] = {
    "bits flipped": flipped_bits,
    "truncated": truncated,
    "bytes inserted": inserted,
    "bytes overwritten": overwritten,
    "bytes removed": removed,
}
POLICY: dict[str, Mutation] = {
    **ANY,
    "zip: sizes": false_sizes,
    "zip: bomb": bomb,
    "zip: entries": odd_entries,
    "zip: many entries": many_entries,
    "array: pickle": pickled,
    "array: header": array_headers,
    "array: values": array_values,
    "card: values": card_values,
    "card: text": hostile_card,
}


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


JSON: dict[str, Mutation] = {**ANY, "json: values": json_values, "json: text": json_text}
CSV: dict[str, Mutation] = {**ANY, "csv: cells": csv_cells}
