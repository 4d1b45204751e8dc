"""Bad files of every kind that a command reads, for `hostile.py`."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from mjxball.policy.file import shipped_policy

ROOT = Path(__file__).parents[1]
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


def card_changed(change: Callable[[str], str], name: str = "balance") -> bytes:
    """A shipped policy file with another text as its card."""
    with np.load(shipped_policy(name)) as arrays:
        found = dict(arrays)
    found["card"] = np.array(change(str(found["card"])))
    return _npz(found)


def weights_changed(value: float) -> bytes:
    """A shipped policy file with one weight of `value`."""
    with np.load(shipped_policy("balance")) as arrays:
        found = {name: array.copy() for name, array in arrays.items()}
    found["weight_0"][0, 0] = value
    return _npz(found)


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _edited(field: str, value: Any) -> bytes:
    return card_changed(lambda text: json.dumps({**json.loads(text), field: value}))


def policies() -> dict[str, Content]:
    """Damaged policy files."""
    sound = shipped_policy("balance").read_bytes()
    return {
        "half of one": sound[: len(sound) // 2],
        "a flipped byte": bytes(sound[:900] + bytes([sound[900] ^ 255]) + sound[901:]),
        "a NaN weight": weights_changed(float("nan")),
        "a weight of 1e30": weights_changed(1e30),
        "format 99": _edited("format_version", 99),
        "control period 0": _edited("control_period", 0),
        "limits of NaN": _edited("command_limits", [float("nan"), 6.0]),
        "a twice given key": card_changed(lambda text: '{"gravity": 1.62, ' + text[1:]),
        "flown by one drone": _edited("flown", {"drones": [1], "seconds": 60}),
        "a card of 100 000 brackets": card_changed(lambda text: "[" * 100_000),
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
    text = json.dumps({"plant": {"object_mass": 0.3}})
    other = {
        "JSON: a key given twice": '{"plant": {"object_mass": 0.3, "object_mass": 0.4}}',
        "JSON: NaN": '{"plant": {"object_mass": NaN}}',
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
    }
    return {flaw: text.encode() for flaw, text in rows.items()}
