"""Every command: --help, --version, one line for what is missing, silence on Ctrl-C."""

from __future__ import annotations

import pkgutil
import re
import runpy
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from command_line import REPOSITORY, assert_one_line, environment, run, without_progress
from tables import rows

from mjxball import __version__

MODULES = (
    *("mjxball.export", "mjxball.assembly", "mjxball.view"),
    *("mjxfly", "mjxfly.twin", "mjxfly.watchdog", "mjxfly.view", "mjxfly.log", "mjxfly.app"),
    *("mjxfly.rig.design", "mjxfly.rig.gains", "mjxfly.rig.identify", "mjxfly.rig.mount"),
)
COMMANDS = (*MODULES, "train.py", "eval.py")


class Called(NamedTuple):
    """How a command ended in this process."""

    code: int
    out: str
    err: str


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[str, str], Called]:
    """Run a command with one flag as Python would run it, but in this process."""

    def run_here(command: str, flag: str) -> Called:
        monkeypatch.setattr(sys, "argv", [command, flag])
        handler = signal.getsignal(signal.SIGINT)
        try:
            if command.endswith(".py"):
                runpy.run_path(str(REPOSITORY / command), run_name="__main__")
            else:
                if not hasattr(sys.modules.get(command), "__path__"):  # of a package runpy runs another module
                    sys.modules.pop(command, None)  # else runpy warns that it runs it twice
                runpy.run_module(command, run_name="__main__", alter_sys=True)
        except SystemExit as stop:
            return Called(int(stop.code or 0), *capsys.readouterr())
        finally:
            signal.signal(signal.SIGINT, handler)
        raise AssertionError(f"{command} went on after {flag}")

    return run_here


@rows("command", COMMANDS)
def test_every_command_has_help_and_version_and_refuses_what_it_does_not_know(
    command: str, called: Callable[[str, str], Called]
) -> None:
    assert called(command, "--version") == (0, f"mjxball {__version__}\n", "")
    helped = called(command, "--help")
    assert helped.code == 0
    assert {"--version", "--help"} <= set(re.findall(r"--\w+", helped.out))
    refused = called(command, "--frobnicate")
    assert (refused.code, refused.out) == (2, "")
    assert_one_line(refused.err)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_version_of_a_real_process(command: str, tmp_path: Path) -> None:
    words = [REPOSITORY / command] if command.endswith(".py") else ["-m", command]
    done = run([*words, "--version"], tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"mjxball {__version__}\n", "")


def test_the_version_stands_in_one_number_everywhere() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__
    assert f"version: {__version__}\n" in (REPOSITORY / "CITATION.cff").read_text()


def test_installed_commands_are_completed_by_their_own_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("shtab")
    installed = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["scripts"]
    assert {f"mjxball-{name}" for name in ("train", "eval", "view", "export")} | {"mjxfly"} <= set(installed)
    for name, place in installed.items():
        monkeypatch.setattr(sys, "argv", [f"/bin/{name}", "--print-completion", "bash"])
        handler = signal.getsignal(signal.SIGINT)
        with pytest.raises(SystemExit) as stop:
            pkgutil.resolve_name(place)()
        signal.signal(signal.SIGINT, handler)
        assert stop.value.code == 0
        assert re.search(rf"^complete .* {name}$", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("words", [("train.py", "--help"), ("-m", "mjxfly", "--version"), ("eval.py", "bench", "-h")])
@pytest.mark.parametrize("buffered", [True, False])
def test_what_cannot_be_printed_is_said(words: tuple[str, ...], buffered: bool) -> None:
    """Nor is a second line said by Python, which tries again as it ends."""
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    with full.open("w") as out:
        done = subprocess.run(
            [sys.executable, *([] if buffered else ["-u"]), *words],
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            cwd=REPOSITORY,
            env=environment(),
        )
    assert done.returncode == 2
    assert_one_line(done.stderr)


@pytest.mark.slow
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
    *told, refusal = without_progress(done.stderr).splitlines()
    assert all(
        line.startswith("warning: ") for line in told
    )  # of policies that are flown beyond what they are good for
    assert_one_line(f"{refusal}\n")
    assert "mjxball[train]" in refusal


@pytest.mark.slow
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
