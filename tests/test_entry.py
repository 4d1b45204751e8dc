"""Every command: --help, --version, one line for what is missing, silence on Ctrl-C."""

from __future__ import annotations

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from command_line import REPOSITORY, assert_one_line, environment, run

from mjxball import __version__

MODULES = (
    *("mjxball.export", "mjxball.assembly", "mjxball.view", "mjxball.rig.gains", "mjxball.rig.identify"),
    *("mjxball.fly", "mjxball.fly.twin", "mjxball.fly.watchdog"),
)
COMMANDS = {
    "train.py": [REPOSITORY / "train.py"],
    "eval.py": [REPOSITORY / "eval.py"],
    **{f"-m {name}": ["-m", name] for name in MODULES},
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_version(command: list[object], tmp_path: Path) -> None:
    done = run([*command, "--version"], tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"mjxball {__version__}\n", "")


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_help(command: list[object], tmp_path: Path) -> None:
    done = run([*command, "--help"], tmp_path)
    assert done.returncode == 0
    assert done.stdout.startswith("usage: ")
    assert "--version" in done.stdout
    assert "--help" in done.stdout


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_unknown_flag(command: list[object], tmp_path: Path) -> None:
    done = run([*command, "--frobnicate"], tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert_one_line(done.stderr)


def test_the_version_stands_in_one_number_everywhere() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__
    assert f"version: {__version__}\n" in (REPOSITORY / "CITATION.cff").read_text()


def test_installed_commands_are_called_by_their_own_name(tmp_path: Path) -> None:
    script = tmp_path / "mjxball-eval"
    script.write_text("import sys\nfrom mjxball.entry import evaluate\nsys.exit(evaluate())\n")
    done = subprocess.run(
        [sys.executable, script, "--help"],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env={**environment(), "PYTHONPATH": str(REPOSITORY)},
    )
    assert done.stdout.startswith("usage: mjxball-eval ")


def test_without_the_train_extra_a_command_says_what_to_install(tmp_path: Path) -> None:
    script = "import sys; sys.modules['mujoco'] = None; from mjxball.entry import evaluate; sys.exit(evaluate())"
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        cwd=REPOSITORY,
        env=environment(),
    )
    assert done.returncode == 2
    assert_one_line(done.stderr)
    assert "mjxball[train]" in done.stderr


def test_interrupted_export_ends_silently(tmp_path: Path) -> None:
    """Ctrl-C while it imports JAX, which is most of what it does: held there by a finder that dawdles."""
    holder = (
        "import sys, time, runpy\n"
        "class Slow:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'mjxball.train.checkpoint': print('importing', flush=True); time.sleep(60)\n"
        "sys.meta_path.insert(0, Slow())\n"
        "sys.argv = ['export', 'run', 'out.npz']\n"
        "runpy.run_module('mjxball.export', run_name='__main__')\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", holder],
        cwd=tmp_path,
        env={**environment(), "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "importing\n"
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=30)
    assert (child.returncode, errors) == (130, "")
