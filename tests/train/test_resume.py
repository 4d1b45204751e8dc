"""A run that is continued ends exactly as one that was never interrupted; what cannot be continued is refused."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import environment as child_environment
from command_line import tiny

from mjxball.commands.train import main as train
from mjxball.train.checkpoint import CHECKPOINTS, Checkpoints
from mjxball.train.run_directory import PACKAGE, SOURCES

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was never interrupted. Its replay has wrapped around several times."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    launch(["--out", str(out), *tiny()]).wait(timeout=240)
    return out


def launch(arguments: list[str]) -> subprocess.Popen:
    environment = {**child_environment(), "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, str(REPOSITORY / "tests" / "short_train.py"), *arguments]
    return subprocess.Popen(
        command, cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def arrays(run: Path) -> dict[str, np.ndarray]:
    with np.load(run / "policy.npz") as data:
        return {name: data[name] for name in data.files if name != "card"}


def complete(run: Path) -> list[int]:
    place = run / CHECKPOINTS
    return sorted(int(path.name) for path in place.iterdir() if path.name.isdigit()) if place.is_dir() else []


# A training by gradients, whose environments `train.py` cuts over two devices of the CPU.
CUT = ["transport", "--algorithm", "gradient", "--timing.episode_steps", "100", "--gradient.num_envs", "8"]
CUT += ["--gradient.horizon", "10", "--gradient.gradient_steps", "1499", "--gradient.policy_layers", "8"]
CUT += ["--gradient.num_evaluations", "5"]


@pytest.mark.slow
def test_killed_run_resumes_to_the_bit_identical_policy(whole: Path, tmp_path: Path) -> None:
    killed_and_resumed(tiny(), whole, tmp_path / "killed")


@pytest.mark.slow
def test_killed_run_on_two_devices_too(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    assert launch(["--out", str(whole), *CUT]).wait(timeout=240) == 0
    assert json.loads((whole / "config.json").read_text())["parts"] == 2
    killed_and_resumed(CUT, whole, tmp_path / "killed")


def killed_and_resumed(settings: list[str], whole: Path, run: Path) -> None:
    child = launch(["--out", str(run), *settings])
    deadline = time.monotonic() + 120
    while not complete(run) and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    child.kill()
    child.wait(timeout=30)
    assert child.returncode == -signal.SIGKILL, "the run ended before it could be killed"
    kept = complete(run)
    assert kept
    assert kept[-1] < complete(whole)[-1]
    (run / CHECKPOINTS / f"{kept[-1] + 32}.orbax-checkpoint-tmp").mkdir()  # as a write cut short leaves it
    again = launch(["--resume", str(run)])
    output = again.communicate(timeout=240)[0]
    assert again.returncode == 0, output
    for name, value in arrays(whole).items():
        np.testing.assert_array_equal(arrays(run)[name], value, err_msg=name)
    steps = [line.split(",")[0] for line in (run / "metrics.csv").read_text().splitlines()]
    assert steps == [line.split(",")[0] for line in (whole / "metrics.csv").read_text().splitlines()]


@pytest.mark.slow
def test_damaged_checkpoint_is_skipped_with_a_warning(
    whole: Path,
    tmp_path: Path,
    short_verdict: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "damaged"
    assert len(complete(whole)) == 1  # of a finished run
    with monkeypatch.context() as unfinished:
        unfinished.setattr(Checkpoints, "keep_newest", lambda self: None)
        assert train(["--out", str(run), *tiny()]) == 0
    capsys.readouterr()
    _, newest = complete(run)
    for path in (run / CHECKPOINTS / str(newest)).rglob("*"):
        if path.is_file() and path.stat().st_size > 200:
            path.write_bytes(path.read_bytes()[:100])
    assert train(["--resume", str(run)]) == 0
    output = "".join(capsys.readouterr())
    assert f"checkpoint {newest} cannot be read and is skipped" in output
    for name, value in arrays(whole).items():
        np.testing.assert_array_equal(arrays(run)[name], value, err_msg=name)
    assert complete(run)[-1] == newest
    # The damaged one was replaced: resuming once more finds nothing to complain about.
    assert train(["--resume", str(run)]) == 0
    assert "skipped" not in "".join(capsys.readouterr())


@pytest.mark.slow
def test_changed_configuration_is_refused(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run = tmp_path / "changed"
    shutil.copytree(whole, run)
    record = json.loads((run / "config.json").read_text())
    record["config"]["sac"]["discount"] = 0.9
    (run / "config.json").write_text(json.dumps(record))
    before = (run / "policy.npz").read_bytes()
    assert train(["--resume", str(run)]) == 2
    assert "changed" in capsys.readouterr().err
    assert (run / "policy.npz").read_bytes() == before


@pytest.mark.slow
def test_changed_program_is_refused_with_the_differences(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    run = tmp_path / "older"
    shutil.copytree(whole, run)
    record = json.loads((run / "config.json").read_text())
    record["source_hash"] = "0123456789abcdef"
    record["versions"]["jax"] = "0.0.1"
    (run / "config.json").write_text(json.dumps(record))
    assert train(["--resume", str(run)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "source 0123456789abcdef" in message
    assert "jax 0.0.1 is now" in message


@pytest.mark.slow
def test_compilation_cache_is_filled(whole: Path) -> None:
    assert whole.is_dir()
    assert any(path.name.startswith("jit_collect") for path in Path(os.environ["MJXBALL_CACHE"]).iterdir())


@pytest.mark.slow
def test_the_source_hash_covers_what_the_training_program_imports() -> None:
    code = (
        "import sys, mjxball.train.program\n"
        "print(*[m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'mjxball'], sep='\\n')"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY, capture_output=True, text=True)
    used = {Path(line).relative_to(PACKAGE).as_posix() for line in done.stdout.splitlines()}
    computes = used - {"__init__.py", "arrays.py", "cli.py", "errors.py", "files.py", "quiet.py", "reading.py"}
    assert {"env.py", "train/program.py"} <= computes
    assert not {name for name in computes if name not in SOURCES and name.split("/")[0] not in SOURCES}
