"""Trackers of others: they get every row of metrics.csv, and cannot end a training."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import REPOSITORY, assert_refused, environment

from mjxball.commands.train import main

SHORT = ["paper", "--physics", "newton-euler", "--sac.total_steps", "4000", "--sac.warmup_steps", "1000"]
SHORT += ["--sac.policy_layers", "16,16", "--sac.critic_layers", "16,16", "--sac.batch_size", "64"]
SHORT += ["--sac.replay_size", "4000", "--out", "run"]
RECIPES = dict(
    re.findall(
        r"`tracker_(\w+)\.py`\n\n```python\n(.*?)```", (REPOSITORY / "docs/howto/trackers.md").read_text(), re.DOTALL
    )
)
MLFLOW = {"MLFLOW_TRACKING_URI": "mlruns", "MLFLOW_ALLOW_FILE_STORE": "true"}  # `mlflow-skinny` has no database
OWN = """
told = []

def start(name, settings):
    told.append((name, settings))
    return told.append

def failing(name, settings):
    def log(row):
        told.append(row)
        raise OSError("no network")
    return log

def broken(name, settings):
    raise KeyError("a key")

def leaves(name, settings):
    raise SystemExit("two\\nlines \\x1b[31m")

def nothing(name, settings):
    pass
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_verdict: None) -> Path:
    """A directory with a module of trackers."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_tracker.py").write_text(OWN)
    (tmp_path / "leaving.py").write_text("raise SystemExit(0)")
    monkeypatch.delitem(sys.modules, "my_tracker", raising=False)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return tmp_path


@pytest.mark.slow
def test_every_row_is_told_and_a_failing_tracker_ends_nothing(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SHORT, "--tracker", "my_tracker:start"]) == 0
    import my_tracker  # type: ignore[import-not-found]

    (name, settings), *rows = my_tracker.told
    assert name == "paper-seed0"
    assert settings["sac.total_steps"] == 4000
    with (here / "run/metrics.csv").open(newline="") as stream:
        written = [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(stream)]
    assert [{key: pytest.approx(value) for key, value in row.items()} for row in rows] == written
    my_tracker.told.clear()
    assert main([*SHORT[:-1], "second", "--tracker", "my_tracker:failing"]) == 0
    assert len(my_tracker.told) == 1
    told = capsys.readouterr().err
    assert "--tracker raised OSError: no network, in my_tracker.py line 11; it gets no more rows" in told
    assert (here / "second/policy.npz").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my_tracker:broken", "--tracker raised KeyError"),
        ("my_tracker:leaves", "--tracker raised SystemExit: two lines [31m"),
        ("leaving:start", "importing leaving raised SystemExit"),
        ("my_tracker:nothing", "must return what is called with every row"),
        ("my_tracker:told", "is no function of (name, settings)"),
        ("my_tracker:none", "has no none"),
        ("no_such_module:start", "there is no module"),
        ("start", "takes package.module:Name"),
    ],
)
def test_refusals(here: Path, capsys: pytest.CaptureFixture[str], name: str, said: str) -> None:
    assert said in assert_refused(main, [*SHORT, "--tracker", name], here, capsys)


@pytest.mark.release
@pytest.mark.parametrize(
    ("package", "variables"),
    [("wandb", {"WANDB_MODE": "offline"}), ("mlflow", MLFLOW), ("aim", {})],
)
def test_recipes_log_offline(package: str, variables: dict[str, str], tmp_path: Path) -> None:
    """As the page has them, in a directory of their own."""
    pytest.importorskip(package)
    (tmp_path / f"tracker_{package}.py").write_text(RECIPES[package])
    command = [sys.executable, REPOSITORY / "train.py", *SHORT, "--tracker", f"tracker_{package}:start"]
    if package == "aim":
        subprocess.run([Path(sys.executable).with_name("aim"), "init"], cwd=tmp_path, check=True)
    done = subprocess.run(
        command, cwd=tmp_path, env={**environment(), **variables}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "--tracker raised" not in done.stderr
    assert any((tmp_path / name).exists() for name in ("wandb", "mlruns", "mlflow.db", ".aim"))
