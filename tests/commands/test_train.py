"""`train.py` and `python -m mjxball.export` as a user meets them: files, Ctrl-C, resume, and refusals."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from command_line import (
    STEPS,
    assert_process_refuses,
    assert_refused,
    call,
    environment,
    listing,
    load_arrays,
    run,
    script,
    tiny,
)
from tables import rows

from mjxball import cli, export
from mjxball import config as configs
from mjxball.commands.new_run import LATE_IMPORTS
from mjxball.commands.train import main, parser
from mjxball.errors import InputError
from mjxball.policy import Policy
from mjxball.train.population import Population

ROW = re.compile(r"^\s*[\d,]+ steps")
COMPILING = re.compile("compiling the training program")
EVALUATED = {"eval_return", "eval_steady_error", "eval_peak", "eval_tilt_error", "eval_vertical_error"}


def rows_of(run_directory: Path) -> list[dict[str, str]]:
    with (run_directory / "metrics.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def checkpoint_steps(run_directory: Path) -> list[int]:
    return sorted(int(path.name) for path in (run_directory / "checkpoints").iterdir() if path.name.isdigit())


def command_of(policy: Path) -> np.ndarray:
    return Policy.load(policy)(np.linspace(-0.5, 0.5, 18))


# --- a whole run ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run in a fresh working directory."""
    here = tmp_path_factory.mktemp("finished")
    with contextlib.chdir(here), contextlib.redirect_stdout(io.StringIO()) as said:
        assert call(main, tiny(out="run", seed=3)) == 0
    assert "run/policy.npz" in said.getvalue()
    assert sorted(path.name for path in here.iterdir()) == ["run"]
    return here / "run"


@pytest.mark.slow
def test_run_writes_every_file(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert names == {"config.json", "metrics.csv", "tensorboard", "checkpoints", "policy.npz", "eval"}
    assert (finished / "eval" / "cells.json").is_file()
    assert len(list((finished / "eval").glob("omega*.png"))) == 6  # the standard scenarios
    assert (finished / "eval" / "training.png").stat().st_size > 10_000


@pytest.mark.slow
def test_run_records_what_made_it(finished: Path) -> None:
    record = json.loads((finished / "config.json").read_text())
    config = configs.validate(configs.from_dict(record["config"]))
    assert record["config_hash"] == configs.config_hash(config)
    assert config.sac.total_steps == STEPS
    assert config.sac.policy_layers == (16, 16)
    assert (record["seed"], record["physics"]) == (3, "newton-euler")
    _, metadata = load_arrays(finished / "policy.npz")
    assert metadata["config_hash"] == record["config_hash"]
    assert metadata["training_steps"] == STEPS
    assert metadata["preset"] == "transport"


@pytest.mark.slow
def test_run_logs_metrics_in_order(finished: Path) -> None:
    rows = rows_of(finished)
    steps = [int(row["steps"]) for row in rows]
    assert steps == sorted(set(steps))
    assert steps[-1] == STEPS == checkpoint_steps(finished)[-1]
    for row in rows:
        empty = {name for name, text in row.items() if not text}
        # No episode here is 8 s long, so there is no steady state to report.
        assert empty in (EVALUATED | {"steady_error"}, {"steady_error", "eval_steady_error", "eval_peak"})
        assert all(np.isfinite(float(text)) for text in row.values() if text)
    assert rows[-1]["eval_return"]


@pytest.mark.slow
def test_run_policy_flies(finished: Path) -> None:
    assert np.isfinite(command_of(finished / "policy.npz")).all()


@pytest.mark.slow
def test_export_of_the_run_is_its_policy(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "exported.npz"
    before = listing(finished)
    assert call(export.main, [finished, out]) == 0
    assert str(out) in capsys.readouterr().out
    np.testing.assert_array_equal(command_of(out), command_of(finished / "policy.npz"))
    assert load_arrays(out)[1] == load_arrays(finished / "policy.npz")[1]
    assert listing(finished) == before


# --- Ctrl-C and resume ----------------------------------------------------------------------------------------------


def stopped(here: Path, line: re.Pattern[str], number: int, **settings: Any) -> str:
    """Output of a short run in `here` that got signal `number` after a line on stderr; it ended with 130."""
    child = subprocess.Popen(
        [sys.executable, str(script("train.py")), *tiny(out="run", **settings)],
        cwd=here,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    guard = threading.Timer(120, child.kill)
    guard.start()
    try:
        seen = []
        for text in child.stderr:
            seen.append(text)
            if line.match(text):
                child.send_signal(number)
                break
        output, errors = child.communicate()
    finally:
        guard.cancel()
        child.kill()
    assert child.returncode == 130, (seen, output, errors)
    assert "Traceback" not in errors
    return output + errors


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that got one Ctrl-C after its first row of progress."""
    here = tmp_path_factory.mktemp("interrupted")
    assert "run/policy.npz" in stopped(here, ROW, signal.SIGINT)
    return here / "run"


@pytest.mark.slow
def test_interrupted_run_keeps_policy_and_checkpoint(interrupted: Path) -> None:
    steps = checkpoint_steps(interrupted)[-1]  # it need not wait for the row's end
    assert int(rows_of(interrupted)[-1]["steps"]) <= steps < STEPS
    assert load_arrays(interrupted / "policy.npz")[1]["training_steps"] == steps
    assert np.isfinite(command_of(interrupted / "policy.npz")).all()
    names = {path.name for path in interrupted.iterdir()}
    assert names == {"config.json", "metrics.csv", "tensorboard", "checkpoints", "policy.npz"}


@pytest.mark.slow
def test_export_of_an_interrupted_run(interrupted: Path, tmp_path: Path) -> None:
    done = run(["-m", "mjxball.export", interrupted, "exported.npz"], tmp_path)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(command_of(tmp_path / "exported.npz"), command_of(interrupted / "policy.npz"))


@pytest.mark.slow
def test_a_run_quit_while_it_compiled_is_started_anew(
    finished: Path, tmp_path: Path, short_verdict: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGTERM before the first checkpoint leaves the configuration and an empty table: enough to resume from."""
    monkeypatch.setenv("MJXBALL_CACHE", "off")  # of the process, which then has seconds to compile
    run_directory = tmp_path / "run"
    assert "before training began" in stopped(tmp_path, COMPILING, signal.SIGTERM, seed=3)
    assert {path.name for path in run_directory.iterdir()} == {"config.json", "metrics.csv", "tensorboard"}
    assert call(main, ["--resume", run_directory]) == 0
    np.testing.assert_array_equal(command_of(run_directory / "policy.npz"), command_of(finished / "policy.npz"))


@pytest.mark.slow
def test_resume_finishes_an_interrupted_run(interrupted: Path, short_verdict: None) -> None:
    before = rows_of(interrupted)
    recorded = (interrupted / "config.json").read_bytes()
    assert call(main, ["--resume", interrupted]) == 0
    rows = rows_of(interrupted)
    assert rows[: len(before)] == before
    steps = [int(row["steps"]) for row in rows]
    assert steps == sorted(set(steps))
    assert steps[-1] == STEPS == checkpoint_steps(interrupted)[-1]
    assert load_arrays(interrupted / "policy.npz")[1]["training_steps"] == STEPS
    assert (interrupted / "eval" / "cells.json").is_file()
    assert (interrupted / "config.json").read_bytes() == recorded


@pytest.mark.slow
def test_a_run_by_the_clock_is_continued_for_the_time_that_is_left(
    tmp_path: Path, short_verdict: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C early in five minutes; told that they are over, it ends after a row with a follower, and is finished."""
    assert "run/policy.npz" in stopped(tmp_path, ROW, signal.SIGINT, minutes=5)
    place = tmp_path / "run" / "config.json"
    before = rows_of(tmp_path / "run")
    origin = json.loads(place.read_text())
    assert origin["minutes"] == 5
    place.write_text(json.dumps({**origin, "minutes": "five"}))
    assert call(main, ["--resume", tmp_path / "run"]) == 2
    assert "no sound minutes" in capsys.readouterr().err
    place.write_text(json.dumps({**origin, "minutes": 1e-3}))
    assert call(main, ["--resume", tmp_path / "run"]) == 0
    rows = rows_of(tmp_path / "run")
    assert rows[: len(before)] == before
    assert len(rows) <= len(before) + 2
    assert rows[-1]["eval_return"]
    assert load_arrays(tmp_path / "run" / "policy.npz")[1]["training_steps"] == int(rows[-1]["steps"])
    assert call(main, ["--resume", tmp_path / "run"]) == 0
    assert "nothing is left to do" in capsys.readouterr().out


# --- bad input ------------------------------------------------------------------------------------------------------

BAD_ARGUMENTS = {
    "unknown preset": ["holiday"],
    "unknown flag": ["--frobnicate", 1],
    "unknown setting": ["--sac.luck", 1],
    "two presets": ["paper", "transport"],
    "unknown engine": ["--physics", "mujoco"],
    "output is not empty": ["--out", "full"],
    "output is a file": ["--out", "note.txt"],
    "output below a file": ["--out", "note.txt/new"],
    "resume of nothing": ["--resume", "nowhere"],
    "resume of another directory": ["--resume", "full"],
    "resume of a damaged run": ["--resume", "damaged"],
    "resume of a run without checkpoints": ["--resume", "unborn"],
    "resume with a setting": ["--resume", "full", "--sac.total_steps", 5],
    "resume with an output": ["--resume", "full", "--out", "new"],
    "negative mass": ["--plant.object_mass", -1],
    "negative drone mass": ["--plant.drones.0.mass", -1],
    "mass is not a number": ["--plant.object_mass", "nan"],
    "mass range with a negative end": ["--scenario.object_mass=-0.1,0.2"],
    "range of one number": ["--scenario.object_mass", 0.2],
    "range upside down": ["--scenario.cg_speed", "3,1"],
    "goal beyond d_term": ["--scenario.goal_range", 2],
    "amplitude beyond the object": ["--scenario.cg_amplitude", "0,0.2"],
    "slow physics": ["--timing.physics_steps", 1],
    "negative steps": ["--sac.total_steps", -1],
    "steps not whole": ["--sac.total_steps", 1.5],
    "replay does not fit the worlds": ["--sac.replay_size", 1000],
    "no layers": ["--sac.policy_layers", ""],
    "unknown choice": ["--follower.action", "nothing"],
    "not a switch": ["--sac.alpha_fixed", "maybe"],
    "seed too large": ["--seed", 2**40],
    "seed is a word": ["--seed", "lucky"],
    "a rate that float32 does not hold": ["--sac.learning_rate", "1e-320"],
    "noise of a billion deviations": ["--scenario.noise", "0,1e9"],
    "a load that moves at 1e9 rad/s": ["--scenario.cg_speed", "0,1e9"],
    "a seed of 400 digits": ["--seed", "9" * 400],
    "a sweep of no settings": ["--seeds", 2, "--sweep", "five.json"],
    "no time": ["--minutes", 0],
    "no number of minutes": ["--minutes", "nan"],
    "a year": ["--minutes", 525600],
    "by the clock on several machines": ["--minutes", 1, "--distributed"],
    "by the clock in parts": ["--minutes", 1, "--seeds", 2, "--share", "0/2"],
    "resume with another time": ["--resume", "full", "--minutes", 1],
    "a billion processes": ["--distributed", "--coordinator", "h:1", "--processes", 10**9, "--process", 0],
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that holds what bad inputs point at."""
    for name in ("full", "damaged", "unborn"):
        (tmp_path / name).mkdir()
    (tmp_path / "full" / "kept.txt").write_text("kept")
    (tmp_path / "damaged" / "config.json").write_text('{"config": {')
    record = {"config": configs.to_dict(configs.preset("transport")), "seed": 0, "physics": "mjx"}
    (tmp_path / "unborn" / "config.json").write_text(json.dumps(record))
    (tmp_path / "note.txt").write_text("a note")
    (tmp_path / "five.json").write_text("5")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_missing_package_is_missed_before_anything_is_written(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that a run would import late, some of them hours after it began."""
    for name in LATE_IMPORTS:
        with monkeypatch.context() as without:
            without.setitem(sys.modules, name, None)
            said = assert_refused(main, [*tiny(), "--out", "run"], here, capsys)
        assert f"{name.partition('.')[0]} is not installed" in said
        assert "mjxball[train]" in said


def test_a_start_that_fails_leaves_nothing(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command is then given again: config.json and metrics.csv had it refused for a directory in use."""
    full = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 TB")
    for error in (InputError("no"), full, ModuleNotFoundError(name="rich")):

        def compiled(*_: Any, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr(Population, "compile", compiled)
        for given in ("run", "unused/below"):
            before = listing(here)
            assert main([*tiny(), "--out", given]) == 2
            assert listing(here) == before
            assert "is not empty" not in capsys.readouterr().err


@rows("arguments", BAD_ARGUMENTS.values())
def test_bad_argument_is_refused(here: Path, arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(main, arguments, here, capsys)


BAD_EXPORTS = {
    "nothing said": [],
    "unknown flag": ["full", "new.npz", "--frobnicate"],
    "no run": ["nowhere", "new.npz"],
    "not a run": ["full", "new.npz"],
    "damaged run": ["damaged", "new.npz"],
    "run without checkpoints": ["unborn", "new.npz"],
    "another ending": ["full", "new.zip"],
    "file that exists": ["full", "old.npz"],
}


@rows("arguments", BAD_EXPORTS.values())
def test_bad_export_is_refused(here: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    (here / "old.npz").write_bytes(b"old")
    assert_refused(export.main, arguments, here, capsys)


def test_a_list_may_begin_with_a_negative_number() -> None:
    """As every flag with a value, after a space or after `=`."""
    asked = (["--scenario.mass_change", "-0.05,0.1"], ["--scenario.mass_change=-0.05,0.1"])
    for arguments in asked:
        found = cli.apply_config_flags(configs.preset("transport"), parser().parse_args(arguments))
        assert found.scenario.mass_change == (-0.05, 0.1)


def test_the_number_of_seeds_has_two_names() -> None:
    assert [parser().parse_args([flag, "3"]).num_seeds for flag in ("--num-seeds", "--seeds")] == [3, 3]


def test_a_misspelt_flag_is_answered_with_the_right_one(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong, right in (("--sac.total_stesp", "--sac.total_steps"), ("--num_seeds", "--num-seeds")):
        assert right in assert_refused(main, [wrong, 5], here, capsys)
    assert "--frobnicate\n" in assert_refused(main, ["--frobnicate"], here, capsys)  # like none


@pytest.mark.slow
def test_refusal_of_a_real_process(here: Path) -> None:
    assert_process_refuses([script("train.py"), "--out", "full"], here)
