"""`eval.py` as a user and as a script meets it: numbers, JSON, exit codes, and one sentence for every bad input."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT, assert_one_line, call, listing, load_arrays, run, script, write_arrays

from mjxball.commands.evaluate import main
from mjxball.control.followers import BASELINES
from mjxball.evaluate.homes import by_home
from mjxball.policy.shipped import shipped_policies

FAST = ["--physics", "newton-euler"]
# The fixed keys, with the types that JSON gives back.
SCENARIO_KEYS = {"omega": float, "amplitude": float, "mass": float, "believed_mass": float}
NUMBERS = ("rmse", "settling_time", "overshoot", "x_peak", "y_peak", "z_peak", "max_tilt", "action_error")
SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)


def cells_of(path: Path) -> list[dict[str, Any]]:
    contents = json.loads(path.read_text())
    assert set(contents) == {"cells"}
    return contents["cells"]


@pytest.fixture(scope="module")
def standard(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Cells of `eval.py` without any scenario: every shipped policy and baseline, the standard scenarios."""
    path = tmp_path_factory.mktemp("standard") / "cells.json"
    assert call(main, [*FAST, "--json", path]) == 0
    return cells_of(path)


# --- numbers --------------------------------------------------------------------------------------------------------


def one(cells: list[dict[str, Any]], **wanted: Any) -> dict[str, Any]:
    found = [cell for cell in cells if all(cell[key] == value for key, value in wanted.items())]
    assert len(found) == 1, (wanted, found)
    return found[0]


def test_no_arguments_judge_every_shipped_policy_and_baseline(standard: list[dict[str, Any]]) -> None:
    here, homes = by_home(shipped_policies())
    names = {*BASELINES, *(path.stem for path in here)}
    assert {"transport", "robust", "paper"} <= names
    assert {config.preset for config, _ in homes} == {"flight", "stand"}
    scenarios = {(0.31, 0.0), *((omega, 0.05) for omega in SPEEDS)}
    assert {(cell["follower"], cell["omega"], cell["amplitude"]) for cell in standard} == {
        (name, *scenario) for name in names for scenario in scenarios
    }
    assert len(standard) == len(names) * len(scenarios)


def test_cells_have_the_fixed_keys_and_types(standard: list[dict[str, Any]]) -> None:
    for cell in standard:
        assert set(cell) == {"follower", *SCENARIO_KEYS, *NUMBERS, "failed"}
        assert isinstance(cell["follower"], str)
        assert isinstance(cell["failed"], bool)
        assert all(isinstance(cell[key], kind) for key, kind in SCENARIO_KEYS.items())
        assert all(cell[key] is None or isinstance(cell[key], float) for key in NUMBERS)
        assert cell["believed_mass"] == cell["mass"] == 0.2


# From an independent simulation that runs its attitude loop at 500 Hz; 5 % covers the difference.
@pytest.mark.parametrize(("omega", "x_peak"), zip(SPEEDS, (0.296, 0.258, 0.163, 0.050, 0.023), strict=True))
def test_copy_sways_as_the_reference_says(standard: list[dict[str, Any]], omega: float, x_peak: float) -> None:
    cell = one(standard, follower="copy", omega=omega, amplitude=0.05)
    assert cell["x_peak"] == pytest.approx(x_peak, rel=0.05)
    assert cell["y_peak"] < 1e-3  # nothing pushes sideways
    assert not cell["failed"]


def test_copy_reaches_the_reference_rmse_and_never_settles(standard: list[dict[str, Any]]) -> None:
    cell = one(standard, follower="copy", omega=0.31, amplitude=0.05)
    assert cell["rmse"] == pytest.approx(0.520, rel=0.05)
    assert cell["settling_time"] is None
    assert cell["action_error"] < 1e-9  # copying is its definition


def test_copy_without_cg_motion_settles_as_the_reference_says(standard: list[dict[str, Any]]) -> None:
    cell = one(standard, follower="copy", amplitude=0.0)
    assert cell["settling_time"] == pytest.approx(7.96, rel=0.05)
    assert cell["rmse"] == pytest.approx(0.479, rel=0.05)
    assert cell["x_peak"] < 1e-3
    assert cell["max_tilt"] == pytest.approx(np.deg2rad(3.6), rel=0.05)


def test_lists_are_crossed_and_short_flights_have_no_peaks(tmp_path: Path) -> None:
    lists = ["--omega", 0.3, 1, "--amplitude", 0, 0.05, "--mass", 0.1, 0.3]
    path = tmp_path / "cells.json"
    assert (
        call(main, [*FAST, "--followers", "copy", *lists, "--believed-mass", 0.2, "--seconds", 2, "--json", path]) == 0
    )
    cells = cells_of(path)
    crossed = {(w, a, m) for w in (0.3, 1.0) for a in (0.0, 0.05) for m in (0.1, 0.3)}
    assert {(cell["omega"], cell["amplitude"], cell["mass"]) for cell in cells} == crossed
    assert len(cells) == len(crossed)
    for cell in cells:
        assert cell["believed_mass"] == 0.2
        assert [cell[f"{axis}_peak"] for axis in "xyz"] == [None] * 3
        assert cell["settling_time"] is None


def test_out_holds_the_cells_and_a_figure_for_each_scenario(tmp_path: Path) -> None:
    out, twice = tmp_path / "out", tmp_path / "cells.json"
    arguments = ["--followers", "copy", "--omega", 0.31, 1, "--seconds", 1, "--out", out, "--json", twice]
    assert call(main, [*FAST, *arguments]) == 0
    assert (out / "cells.json").read_text() == twice.read_text()
    figures = list(out.glob("*.png"))
    assert len(figures) == 2
    assert all(figure.read_bytes().startswith(b"\x89PNG") for figure in figures)


@pytest.mark.parametrize("name", ["flight", "stand"])
def test_a_policy_for_crazyflies_flies_its_own_plant(name: str, tmp_path: Path) -> None:
    path = next(path for path in shipped_policies() if path.stem == name)
    out = tmp_path / "cells.json"
    assert call(main, [path, *FAST, "--seconds", 3, "--json", out]) == 0
    cells = cells_of(out)
    assert [cell["follower"] for cell in cells] == ["copy", name]
    assert {cell["mass"] for cell in cells} == {0.0175}
    assert all(cell["max_tilt"] < 0.3 and not cell["failed"] for cell in cells)


def test_baselines_beside_a_policy_for_crazyflies_fly_its_plant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = next(path for path in shipped_policies() if path.stem == "flight")
    out = tmp_path / "cells.json"
    assert call(main, [path, "--followers", "copy", *FAST, "--seconds", 3, "--json", out]) == 0
    assert [(cell["follower"], cell["mass"]) for cell in cells_of(out)] == [("copy", 0.0175), ("flight", 0.0175)]
    capsys.readouterr()
    assert call(main, [path, "--followers", "memoryless"]) == 2
    assert "this plant is another" in capsys.readouterr().err


def test_families_refuse_a_policy_for_crazyflies(capsys: pytest.CaptureFixture[str]) -> None:
    path = next(path for path in shipped_policies() if path.stem == "flight")
    assert call(main, [path, "--families", "gusts"]) == 2
    assert "two Crazyflies" in capsys.readouterr().err


# --- check ----------------------------------------------------------------------------------------------------------


def test_every_shipped_policy_meets_its_card_from_anywhere(tmp_path: Path) -> None:
    """A real process, MJX physics, another working directory, another scenario than the card's."""
    shipped = shipped_policies()
    assert {"paper", "transport"} <= {path.stem for path in shipped}
    done = run([script("eval.py"), *shipped, "--check", "--seconds", 1], tmp_path)
    assert done.returncode == 0, done.stderr
    for path in shipped:
        assert f"check {path.stem}: ok" in done.stdout
    assert not done.stderr
    assert listing(tmp_path) == {}


def test_check_fails_a_policy_that_misses_its_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, card = load_arrays()
    card["bounds"]["x_peak"] = 1e-6
    strict = write_arrays(tmp_path / "strict.npz", arrays, card)
    assert call(main, [*FAST, strict, TRANSPORT, "--check"]) == 1
    printed = capsys.readouterr().out
    assert "check strict: x_peak" in printed
    assert "check transport: ok" in printed


# --- bad input ------------------------------------------------------------------------------------------------------

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


def assert_refused(here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> str:
    """Exit code 2, one line on stderr, and not a byte of the working directory changed."""
    before = listing(here)
    code = call(main, arguments)
    captured = capsys.readouterr()
    assert code == 2, captured
    assert_one_line(captured.err)
    assert listing(here) == before
    return captured.err


@pytest.mark.parametrize("arguments", BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS)
def test_bad_argument_is_refused(here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(here, [*FAST, *arguments, "--json", "new.json", "--out", "new"], capsys)


@pytest.mark.parametrize("arguments", BAD_OUTPUTS.values(), ids=BAD_OUTPUTS)
def test_bad_output_is_refused_before_the_flight(
    here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(here, [*FAST, "--followers", "copy", "--seconds", 0.1, *arguments], capsys)


def _first_weight(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict, dict], None]:
    def damage(arrays: dict[str, np.ndarray], card: dict[str, Any]) -> None:
        arrays["weight_0"] = change(arrays["weight_0"])

    return damage


def _in_card(key: str, change: Callable[[Any], Any]) -> Callable[[dict, dict], None]:
    def damage(arrays: dict[str, np.ndarray], card: dict[str, Any]) -> None:
        card[key] = change(card[key])

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
    "array missing": (lambda arrays, card: arrays.pop("bias_1"), "bias_1"),
    "array too many": (lambda arrays, card: arrays.update(extra=np.zeros(3)), "extra"),
    "layer missing": (lambda arrays, card: [arrays.pop(name) for name in ("weight_2", "bias_2")], "shape"),
    "statistics missing": (lambda arrays, card: arrays.pop("observation_mean"), "observation_mean"),
    "statistics infinite": (lambda arrays, card: arrays["observation_mean"].fill(np.inf), "finite"),
    "negative scale": (lambda arrays, card: arrays["action_scale"].fill(-1), "positive"),
    "pickle inside": (lambda arrays, card: arrays.update(weight_0=np.array([{}], object)), "pickle"),
    "later format": (_in_card("format_version", lambda version: version + 1), "format"),
    "format is text": (_in_card("format_version", str), "format"),
    "card field missing": (lambda arrays, card: card.pop("control_period"), "control_period"),
    "another observation": (_in_card("observation", lambda slots: [["battery", "V"], *slots[1:]]), "observation"),
    "another order": (_in_card("observation", lambda slots: slots[::-1]), "observation"),
    "another unit": (_in_card("observation", lambda slots: [[name, "deg"] for name, _ in slots]), "observation"),
    "another slot": (_in_card("observation", lambda slots: [*slots, "battery"]), "observation"),
    "fewer observations": (_in_card("observation", lambda slots: slots[:-1]), "observation"),
    "another action": (_in_card("action", lambda slots: slots[::-1]), "action"),
    "longer history": (_in_card("history", lambda _: 2), "shape"),
    "another rate": (_in_card("control_period", lambda _: 0.01), "control period"),
    "another plant": (_in_card("plant", lambda plant: {**plant, "arm": 0.2}), "plant"),
    "number beyond any float": (_in_card("gravity", lambda _: 10**400), "gravity"),
    "bounds not numbers": (_in_card("bounds", lambda _: {"x_peak": "small"}), "bounds"),
}


@pytest.mark.parametrize(("damage", "word"), DAMAGES.values(), ids=DAMAGES)
def test_unusable_policy_is_named_and_refused(
    here: Path, damage: Callable[[dict, dict], None], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arrays, card = load_arrays()
    damage(arrays, card)
    write_arrays(here / "odd.npz", arrays, card)
    message = assert_refused(here, [*FAST, "odd.npz", "--json", "new.json", "--out", "new"], capsys)
    assert "odd.npz" in message
    assert word in message


RAW = {
    "empty": lambda whole: b"",
    "truncated": lambda whole: whole[: len(whole) // 2],
    "flipped byte": lambda whole: bytes([*whole[:3000], whole[3000] ^ 0xFF, *whole[3001:]]),
    "pickle": lambda whole: pickle.dumps({"weight_0": [1.0]}),
    "single array": lambda whole: b"\x93NUMPY" + whole[:100],
}


@pytest.mark.parametrize("change", RAW.values(), ids=RAW)
def test_damaged_bytes_are_refused(
    here: Path, change: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "odd.npz").write_bytes(change(TRANSPORT.read_bytes()))
    assert "odd.npz" in assert_refused(here, [*FAST, "odd.npz", "--json", "new.json", "--out", "new"], capsys)


def test_card_that_is_not_json_is_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, _ = load_arrays()
    np.savez(here / "odd.npz", **arrays, card=np.array("{"))
    assert "card" in assert_refused(here, [*FAST, "odd.npz"], capsys)


@pytest.mark.parametrize(
    "arguments", [["odd.npz"], ["--followers", "nobody"], ["--nothing"]], ids=["truncated policy", "follower", "flag"]
)
def test_refusal_of_a_real_process(here: Path, arguments: list[str]) -> None:
    (here / "odd.npz").write_bytes(TRANSPORT.read_bytes()[:2000])
    before = listing(here)
    done = run([script("eval.py"), *arguments], here)
    assert done.returncode == 2
    assert_one_line(done.stderr)
    assert not done.stdout
    assert listing(here) == before


def test_policies_of_one_stem_are_called_by_their_directory(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        (here / name).mkdir()
        (here / name / "policy.npz").write_bytes(TRANSPORT.read_bytes())
    paths = [here / name / "policy.npz" for name in ("a", "b")]
    assert call(main, [*paths, "--seconds", "1", "--json", here / "cells.json", *FAST]) == 0
    assert [cell["follower"] for cell in cells_of(here / "cells.json")] == ["a/policy", "b/policy"]


def test_a_policy_for_another_rate_flies_only_when_forced(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, card = load_arrays(TRANSPORT)
    write_arrays(here / "slow.npz", arrays, {**card, "control_period": 0.04})
    flags = [here / "slow.npz", "--seconds", "1", *FAST]
    assert call(main, flags) == 2
    refusal = capsys.readouterr().err
    assert_one_line(refusal)
    assert "--force" in refusal
    assert call(main, [*flags, "--force", "--json", here / "forced.json"]) == 0
    assert "FORCED" in capsys.readouterr().err
    assert cells_of(here / "forced.json")[0]["follower"] == "slow (FORCED)"
