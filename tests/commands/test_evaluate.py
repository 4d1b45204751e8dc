"""`eval.py` as a user and as a script meets it: numbers, JSON, exit codes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import (
    TRANSPORT,
    assert_one_line,
    call,
    listing,
    load_arrays,
    run,
    script,
    without_progress,
    write_arrays,
)

from mjxball.baselines import BASELINES
from mjxball.commands.evaluate import main
from mjxball.evaluate.policies import group_by_plant
from mjxball.policy.file import shipped_policies

FAST = ["--physics", "newton-euler"]
# The fixed keys, with the types that JSON gives back.
SCENARIO_KEYS = {"omega": float, "amplitude": float, "mass": float, "believed_mass": float}
NUMBERS = (
    *("rmse", "settling_time", "overshoot", "x_peak", "y_peak", "z_peak", "plane_peak", "max_tilt", "action_error"),
    *("rotors_at_limit", "rotor_power", "command_spread"),
)
SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)


def cells_of(path: Path) -> list[dict[str, Any]]:
    contents = json.loads(path.read_text())
    assert set(contents) == {"cells"}
    return contents["cells"]


def standard(place: Path, *policies: object) -> tuple[list[dict[str, Any]], str]:
    """(cells, printed) of `eval.py --check` with these policies, as a process, in another directory."""
    done = run([script("eval.py"), *policies, *FAST, "--check", "--json", "cells.json"], place)
    assert done.returncode == 0
    assert without_progress(done.stderr) == ""
    assert set(listing(place)) == {"cells.json"}
    return cells_of(place / "cells.json"), done.stdout


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Cells of `copy`, at every speed, with and without motion of the CG."""
    path = tmp_path_factory.mktemp("copied") / "cells.json"
    scenarios = ["--omega", *SPEEDS, "--amplitude", 0, 0.05]
    assert call(main, [*FAST, "--followers", "copy", *scenarios, "--json", path]) == 0
    return cells_of(path)


# --- numbers --------------------------------------------------------------------------------------------------------


def one(cells: list[dict[str, Any]], **wanted: Any) -> dict[str, Any]:
    found = [cell for cell in cells if all(cell[key] == value for key, value in wanted.items())]
    assert len(found) == 1, (wanted, found)
    return found[0]


@pytest.mark.slow
def test_cells_have_the_fixed_keys_and_types(copied: list[dict[str, Any]]) -> None:
    for cell in copied:
        assert set(cell) == {"follower", *SCENARIO_KEYS, *NUMBERS, "failed"}
        assert isinstance(cell["follower"], str)
        assert isinstance(cell["failed"], bool)
        assert all(isinstance(cell[key], kind) for key, kind in SCENARIO_KEYS.items())
        assert all(cell[key] is None or isinstance(cell[key], float) for key in NUMBERS)
        assert cell["believed_mass"] == cell["mass"] == 0.2


# From an independent simulation that runs its attitude loop at 500 Hz; 5 % covers the difference.
@pytest.mark.slow
@pytest.mark.parametrize(("omega", "x_peak"), zip(SPEEDS, (0.296, 0.258, 0.163, 0.050, 0.023), strict=True))
def test_copy_sways_as_the_reference_says(copied: list[dict[str, Any]], omega: float, x_peak: float) -> None:
    cell = one(copied, omega=omega, amplitude=0.05)
    assert cell["x_peak"] == pytest.approx(x_peak, rel=0.05)
    assert cell["y_peak"] < 1e-3  # nothing pushes sideways
    assert not cell["failed"]


@pytest.mark.slow
def test_copy_reaches_the_reference_rmse_and_never_settles(copied: list[dict[str, Any]]) -> None:
    cell = one(copied, omega=0.31, amplitude=0.05)
    assert cell["rmse"] == pytest.approx(0.520, rel=0.05)
    assert cell["settling_time"] is None
    assert cell["action_error"] < 1e-9  # copying is its definition


@pytest.mark.slow
def test_copy_without_cg_motion_settles_as_the_reference_says(copied: list[dict[str, Any]]) -> None:
    cell = one(copied, omega=0.31, amplitude=0.0)
    assert cell["settling_time"] == pytest.approx(7.96, rel=0.05)
    assert cell["rmse"] == pytest.approx(0.479, rel=0.05)
    assert cell["x_peak"] < 1e-3
    assert cell["max_tilt"] == pytest.approx(np.deg2rad(3.6), rel=0.05)


def test_the_line_below_the_table_names_the_reference(capsys: pytest.CaptureFixture[str]) -> None:
    for more, said in ((["--omega", 1], "omega 0.31, ampl. 0.05, mass 0.2"), (["--rolling", 0.05], "is mass 0.2")):
        assert call(main, [*FAST, "--followers", "copy", "--seconds", 1, *more]) == 0
        *_, last = capsys.readouterr().out.splitlines()
        assert said in last


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


OWN = """
import numpy as np

from mjxball.control.followers import Copy

class Controller(Copy):
    pass

class Level:
    def __init__(self, config): pass
    def reset(self): pass
    def __call__(self, observation): return np.zeros((*observation.shape[:-1], 3))

class Two(Level):
    def __call__(self, observation): return np.zeros(2)
"""


def test_followers_of_ones_own_fly_beside_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (tmp_path / "own_eval.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    own = ["copy", "own_eval:Controller", "own_eval:Level", "stay"]
    assert call(main, [*FAST, "--followers", *own, "--seconds", 2, "--json", "cells.json"]) == 0
    rmse = {cell["follower"]: cell["rmse"] for cell in cells_of(tmp_path / "cells.json")}
    assert list(rmse) == ["copy", "Controller", "Level", "stay"]
    assert rmse["Controller"] == rmse["copy"]
    assert rmse["Level"] != rmse["copy"]
    capsys.readouterr()
    for name, said in (("Two", "answered shape (2,) where (1, 3)"), ("Gone", "own_eval has no Gone")):
        assert call(main, [*FAST, "--followers", f"own_eval:{name}", "--seconds", 2]) == 2
        errors = capsys.readouterr().err
        assert_one_line(errors)
        assert said in errors


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
    assert call(main, [path, "--followers", "pid"]) == 2
    assert "this plant is another" in capsys.readouterr().err


# --- check ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_policies_of_two_plants_meet_their_cards_from_anywhere(tmp_path: Path) -> None:
    _, printed = standard(tmp_path, "balance", "flight")
    assert "check balance: ok" in printed
    assert "check flight: ok" in printed


@pytest.mark.release
def test_no_arguments_judge_every_shipped_policy_and_baseline(tmp_path: Path) -> None:
    shipped = shipped_policies()
    here, others = group_by_plant(shipped)
    names = {*BASELINES, *(path.stem for path in here)}
    assert {"balance", "paper"} <= names
    assert {"flight", "stand", "universal"} <= {config.preset for config, _ in others}
    scenarios = {(0.31, 0.0), *((omega, 0.05) for omega in SPEEDS)}
    found, printed = standard(tmp_path)
    cells = [cell for cell in found if cell["mass"] == 0.2]
    assert {(cell["follower"], cell["omega"], cell["amplitude"]) for cell in cells} == {
        (name, *scenario) for name in names for scenario in scenarios
    }
    assert len(cells) == len(names) * len(scenarios)
    for path in shipped:
        assert f"check {path.stem}: ok" in printed


@pytest.mark.slow
def test_a_policy_meets_its_card_on_mjx(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(main, [TRANSPORT, "--check", "--seconds", 1]) == 0
    assert "check transport-large: ok" in capsys.readouterr().out


def test_check_fails_a_policy_that_misses_its_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, metadata = load_arrays()
    metadata["bounds"]["x_peak"] = 1e-6
    strict = write_arrays(tmp_path / "strict.npz", arrays, metadata)
    assert call(main, [*FAST, strict, TRANSPORT, "--check"]) == 1
    printed = capsys.readouterr().out
    assert "check strict: x_peak" in printed
    assert "check transport-large: ok" in printed


def test_a_run_s_policy_has_its_name_and_equal_names_their_directory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tmp_path / name for name in ("first/policy.npz", "a/mine.npz", "b/mine.npz")]
    for path in paths:
        path.parent.mkdir()
        path.write_bytes(TRANSPORT.read_bytes())
    assert call(main, [*paths, "--seconds", "1", "--json", tmp_path / "cells.json", *FAST]) == 0
    assert [cell["follower"] for cell in cells_of(tmp_path / "cells.json")] == ["first", "a/mine", "b/mine"]


def test_policies_runs_and_baselines_may_stand_with_or_without_the_flag(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "policy.npz").write_bytes(TRANSPORT.read_bytes())
    given = [tmp_path / "mine", "copy", "--followers", "paper", "adaptive"]
    assert call(main, [*given, "--seconds", "1", "--json", tmp_path / "cells.json", *FAST]) == 0
    assert {cell["follower"] for cell in cells_of(tmp_path / "cells.json")} == {"mine", "copy", "paper", "adaptive"}


def test_a_policy_for_another_rate_flies_only_when_forced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, metadata = load_arrays(TRANSPORT)
    write_arrays(tmp_path / "slow.npz", arrays, {**metadata, "control_period": 0.04})
    flags = [tmp_path / "slow.npz", "--seconds", "1", *FAST]
    assert call(main, flags) == 2
    refusal = capsys.readouterr().err
    assert_one_line(refusal)
    assert "--force" in refusal
    assert call(main, [*flags, "--force", "--json", tmp_path / "forced.json"]) == 0
    assert "FORCED" in capsys.readouterr().err
    assert cells_of(tmp_path / "forced.json")[0]["follower"] == "slow (FORCED)"
