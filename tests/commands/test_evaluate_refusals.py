"""`eval.py` answers bad arguments, outputs and policy files with one sentence and exit code 2, and touches nothing."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT, assert_process_refuses, assert_refused, load_arrays, script, write_arrays
from tables import rows

from mjxball.commands.evaluate import main

FAST = ["--physics", "newton-euler"]
BAD_ARGUMENTS = {
    "unknown flag": ["--followers", "copy", "--frobnicate"],
    "unknown follower": ["--followers", "nobody"],
    "unknown engine": ["--followers", "copy", "--physics", "bullet"],
    "no such policy": ["nothing.npz"],
    "policy is a directory": ["full"],
    "policy is text": ["note.txt"],
    "negative mass": ["--followers", "copy", "--mass", -1],
    "zero mass": ["--followers", "copy", "--mass", 0],
    "negative believed mass": ["--followers", "copy", "--believed-mass", -1],
    "mass is not a number": ["--followers", "copy", "--mass", "nan"],
    "mass is a word": ["--followers", "copy", "--mass", "heavy"],
    "goal beyond d_term": ["--followers", "copy", "--goal", 1.5, 1.5, 1.5],
    "goal of two numbers": ["--followers", "copy", "--goal", 1, 1],
    "infinite goal": ["--followers", "copy", "--goal", "inf", 0, 0],
    "amplitude beyond the object": ["--followers", "copy", "--amplitude", 0.18],
    "negative amplitude": ["--followers", "copy", "--amplitude", -0.05],
    "negative omega": ["--followers", "copy", "--omega", -1],
    "no time": ["--followers", "copy", "--seconds", 0],
    "endless": ["--followers", "copy", "--seconds", "inf"],
    "negative stiffness": ["--followers", "copy", "--wn-pitch", -1],
    "a rolling ball at a sine's speed": ["--followers", "copy", "--rolling", 0.05, "--omega", 1],
    "a rolling ball of a sine's amplitude": ["--followers", "copy", "--amplitude", 0.05, "--rolling", 0.05],
    "a waveform at a sine's speed": ["--followers", "copy", "--omega", 1, "--waveform", "note.txt"],
    "a waveform that rolls": ["--followers", "copy", "--rolling", 0.05, "--waveform", "note.txt"],
    "same name twice": [TRANSPORT, TRANSPORT],
    "check without a policy": ["--followers", "copy", "--seconds", 0.1, "--check"],
}
BAD_OUTPUTS = {
    "directory that is not empty": ["--out", "full"],
    "directory that is a file": ["--out", "note.txt"],
    "directory below a file": ["--out", "note.txt/new"],
    "json that exists": ["--json", "old.json"],
    "json with another ending": ["--json", "new.txt"],
    "json nowhere": ["--json", "nowhere/new.json"],
    "json below a file": ["--json", "note.txt/new.json"],
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that holds what bad inputs point at."""
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept.txt").write_text("kept")
    (tmp_path / "note.txt").write_text("a note")
    (tmp_path / "old.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> str:
    """What `eval.py` says when it refuses."""
    return assert_refused(main, arguments, here, capsys)


@rows("arguments", BAD_ARGUMENTS.values())
def test_bad_argument_is_refused(here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    refused(here, [*FAST, *arguments, "--json", "new.json", "--out", "new"], capsys)


@rows("arguments", BAD_OUTPUTS.values())
def test_bad_output_is_refused_before_the_flight(
    here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    refused(here, [*FAST, "--followers", "copy", "--seconds", 0.1, *arguments], capsys)


def _first_weight(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict, dict], None]:
    def damage(arrays: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
        arrays["weight_0"] = change(arrays["weight_0"])

    return damage


def _in_metadata(key: str, change: Callable[[Any], Any]) -> Callable[[dict, dict], None]:
    def damage(arrays: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
        metadata[key] = change(metadata[key])

    return damage


def _with_nan(weight: np.ndarray) -> np.ndarray:
    weight = weight.copy()
    weight[3, 5] = np.nan
    return weight


DAMAGES: dict[str, tuple[Callable[[dict, dict], None], str]] = {
    "wrong shape": (_first_weight(lambda weight: weight[:-1]), "shape"),
    "wrong rank": (_first_weight(np.ravel), "shape"),
    "wrong dtype": (_first_weight(lambda weight: weight.astype(np.float64)), "float32"),
    "NaN": (_first_weight(_with_nan), "finite"),
    "array missing": (lambda arrays, metadata: arrays.pop("bias_1"), "bias_1"),
    "array too many": (lambda arrays, metadata: arrays.update(extra=np.zeros(3)), "extra"),
    "layer missing": (lambda arrays, metadata: [arrays.pop(name) for name in ("weight_2", "bias_2")], "shape"),
    "statistics missing": (lambda arrays, metadata: arrays.pop("observation_mean"), "observation_mean"),
    "statistics infinite": (lambda arrays, metadata: arrays["observation_mean"].fill(np.inf), "finite"),
    "negative scale": (lambda arrays, metadata: arrays["action_scale"].fill(-1), "positive"),
    "pickle inside": (lambda arrays, metadata: arrays.update(weight_0=np.array([{}], object)), "pickle"),
    "later format": (_in_metadata("format_version", lambda version: version + 1), "format"),
    "format is text": (_in_metadata("format_version", str), "format"),
    "metadata field missing": (lambda arrays, metadata: metadata.pop("control_period"), "control_period"),
    "another observation": (_in_metadata("observation", lambda slots: [["battery", "V"], *slots[1:]]), "observation"),
    "another order": (_in_metadata("observation", lambda slots: slots[::-1]), "observation"),
    "another unit": (_in_metadata("observation", lambda slots: [[name, "deg"] for name, _ in slots]), "observation"),
    "another slot": (_in_metadata("observation", lambda slots: [*slots, "battery"]), "observation"),
    "fewer observations": (_in_metadata("observation", lambda slots: slots[:-1]), "observation"),
    "another action": (_in_metadata("action", lambda slots: slots[::-1]), "action"),
    "longer history": (_in_metadata("history", lambda _: 2), "history"),
    "another rate": (_in_metadata("control_period", lambda _: 0.01), "control period"),
    "another plant": (_in_metadata("plant", lambda plant: {**plant, "arm": 0.2}), "plant"),
    "number beyond any float": (_in_metadata("gravity", lambda _: 10**400), "gravity"),
    "bounds not numbers": (_in_metadata("bounds", lambda _: {"x_peak": "small"}), "bounds"),
}


@rows("damage, word", DAMAGES.values())
def test_unusable_policy_is_named_and_refused(
    here: Path, damage: Callable[[dict, dict], None], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays, metadata = load_arrays()
    damage(arrays, metadata)
    write_arrays(here / "odd.npz", arrays, metadata)
    message = refused(here, [*FAST, "odd.npz", "--json", "new.json", "--out", "new"], capsys)
    assert "odd.npz" in message
    assert word in message


RAW = {
    "empty": lambda whole: b"",
    "truncated": lambda whole: whole[: len(whole) // 2],
    "flipped byte": lambda whole: bytes([*whole[:3000], whole[3000] ^ 0xFF, *whole[3001:]]),
    "pickle": lambda whole: pickle.dumps({"weight_0": [1.0]}),
    "single array": lambda whole: b"\x93NUMPY" + whole[:100],
}


@rows("change", RAW.values())
def test_damaged_bytes_are_refused(
    here: Path, change: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "odd.npz").write_bytes(change(TRANSPORT.read_bytes()))
    assert "odd.npz" in refused(here, [*FAST, "odd.npz", "--json", "new.json", "--out", "new"], capsys)


def test_card_that_is_not_json_is_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, _ = load_arrays()
    np.savez(here / "odd.npz", **arrays | {"card": np.array("{")})
    assert "metadata" in refused(here, [*FAST, "odd.npz"], capsys)


@pytest.mark.slow
def test_refusal_of_a_real_process(here: Path) -> None:
    (here / "odd.npz").write_bytes(TRANSPORT.read_bytes()[:2000])
    assert_process_refuses([script("eval.py"), "odd.npz"], here)
