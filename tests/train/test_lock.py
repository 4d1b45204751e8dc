"""One training at a time in a run directory: who comes second is told who holds it; a dead one's lock is nobody's."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import assert_one_line, environment, listing, script, tiny
from command_line import run as command

from mjxball.errors import InputError
from mjxball.train import lock
from train.test_distributed import SMALL, finish, launch

HOLD = """
import sys
from pathlib import Path
from mjxball.running import quit_on_interrupt
from mjxball.train.lock import held
quit_on_interrupt()
with held(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the directory `run`."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "run")]
    child = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY, env=environment()
    )
    assert child.stdout.readline() == "held\n"
    yield child
    child.kill()
    child.communicate()


def test_the_second_is_refused_with_the_name_of_the_first(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    run = tmp_path / "run"
    found = json.loads((run / lock.LOCK).read_text())
    before = listing(run)
    holds = f"in use by process {holder.pid} on {found['host']}, since 20"
    with pytest.raises(InputError, match=holds), lock.held(run):
        pass
    assert listing(run) == before
    done = command([script("train.py"), *tiny(out=run)], tmp_path)
    assert done.returncode == 2
    assert_one_line(done.stderr)
    assert f"process {holder.pid}" in done.stderr
    assert listing(run) == before
    (run / "config.json").write_text("{}")  # as soon as it has written something
    done = command([script("train.py"), *tiny(out=run)], tmp_path)
    assert done.returncode == 2
    assert f"process {holder.pid}" in done.stderr


def test_ctrl_c_before_a_training_has_begun_leaves_no_lock(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    holder.send_signal(signal.SIGINT)
    assert holder.wait(timeout=60) == 130
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_lock_ends_with_its_process_however_that_ends(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    run = tmp_path / "run"
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert json.loads((run / lock.LOCK).read_text())["pid"] == holder.pid  # it could not clean up
    with lock.held(run):
        assert json.loads((run / lock.LOCK).read_text())["pid"] == os.getpid()
        with pytest.raises(InputError, match="in use"), lock.held(run):  # not even by the same process
            pass
        assert (run / lock.LOCK).exists()
    assert list(run.iterdir()) == []


def test_directories_that_nothing_was_written_to_are_removed(tmp_path: Path) -> None:
    with lock.held(tmp_path / "new" / "run"):
        assert (tmp_path / "new" / "run").is_dir()
    assert list(tmp_path.iterdir()) == []
    with lock.held(tmp_path / "new" / "run"):
        (tmp_path / "new" / "run" / "kept").touch()
    assert [path.name for path in (tmp_path / "new" / "run").iterdir()] == ["kept"]


def test_a_directory_that_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(lock, "_acquired", refuse)
    with pytest.raises(InputError, match="cannot be written: Read-only"), lock.held(tmp_path):
        pass


@pytest.mark.release
def test_two_processes_of_one_run_are_one_holder_and_a_second_pair_is_refused(
    tmp_path: Path, holder: subprocess.Popen[str]
) -> None:
    """Both of a pair are refused while another process has the directory, and train once it is free."""
    arguments = [*SMALL, "--seeds", "2", "--sac.total_steps", "800", "--out", str(tmp_path / "run")]
    children = launch(arguments, tmp_path / "cache")
    outputs = finish(children)
    assert [child.returncode for child in children] == [2, 2], outputs
    assert f"process {holder.pid}" in outputs[0]
    holder.communicate()
    children = launch(arguments, tmp_path / "cache")
    outputs = finish(children)
    assert [child.returncode for child in children] == [0, 0], outputs
    assert not (tmp_path / "run" / lock.LOCK).exists()
