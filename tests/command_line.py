"""Support for tests of the command lines: call them in this process or as a user would, and judge a refusal."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjxball.xla import SMALL_LOOPS

REPOSITORY = Path(__file__).parents[1]
TRANSPORT = REPOSITORY / "policies" / "archive" / "transport-large.npz"
Main = Callable[[list[str]], int]
# Programs of tests are small and run once: to optimise them little takes half off the time of tests that compile, most
# of it by XLA's older emitters of loops. Level 0 compiles no sooner than level 1 and computes four times as slowly.
HASTY = "--xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true"
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):  # a later XLA ends a process that is given it
    HASTY += " --xla_cpu_use_fusion_emitters=false"
HASTY += f" {SMALL_LOOPS}"  # as train.py --algorithm gradient
# Training for seconds: closed-form physics, tiny networks, two updates a step. One program for all tests that train so:
# the number of steps, which are seconds of training, so that a signal arrives in the middle, is a part of it.
STEPS = 48_000
TINY: dict[str, Any] = {
    "--physics": "newton-euler",
    "--timing.episode_steps": 100,
    "--sac.total_steps": STEPS,
    "--sac.num_envs": 32,
    "--sac.replay_size": 3200,
    "--sac.warmup_steps": 1024,
    "--sac.batch_size": 64,
    "--sac.updates_per_step": 2,
    "--sac.policy_layers": "16,16",
    "--sac.critic_layers": "16,16",
}


def tiny(**extra: Any) -> list[str]:
    """Flags of such a training; in names of `extra` two underscores are a dot."""
    flags = {**TINY, **{f"--{name.replace('__', '.')}": value for name, value in extra.items()}}
    return [str(word) for pair in flags.items() for word in pair]


def call(main: Main, arguments: Sequence[object]) -> int:
    """Exit code of `main` in this process, whether it returns or exits."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)


def run(arguments: Sequence[object], cwd: Path, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Run `python ARGUMENTS` in the directory `cwd`; the scripts are given by `script`."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=timeout, check=False
    )


def environment() -> dict[str, str]:
    """The environment of a child: CPU only, hasty, unbuffered, without the level of messages that JAX sets here."""
    inherited = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    return {**inherited, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": HASTY, "PYTHONUNBUFFERED": "1"}


def script(name: str) -> Path:
    """Path of train.py or eval.py."""
    return REPOSITORY / name


def listing(directory: Path) -> dict[str, bytes | None]:
    """Every path below `directory` with its contents, None for a directory."""
    paths = sorted(directory.rglob("*"))
    return {str(path.relative_to(directory)): path.read_bytes() if path.is_file() else None for path in paths}


WORKING = re.compile(r"(flying|preparing|drawing) .*( \.\.\.|\d s)")


def without_progress(errors: str) -> str:
    """What a program wrote to stderr, without the lines of what took time (`terminal.Working`)."""
    return "".join(line for line in errors.splitlines(keepends=True) if not WORKING.fullmatch(line.rstrip("\n")))


def assert_one_line(errors: str) -> None:
    """A refusal is exactly one line, and no traceback."""
    assert errors.endswith("\n")
    assert len(without_progress(errors).splitlines()) == 1, errors
    assert "Traceback" not in errors


def assert_refused(main: Main, arguments: Sequence[object], here: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """`main` refuses with exit code 2, prints one line on stderr (returned), and changes not a byte in `here`."""
    before = listing(here)
    code = call(main, arguments)
    captured = capsys.readouterr()
    assert code == 2, captured
    assert_one_line(captured.err)
    assert not captured.out
    assert listing(here) == before
    return captured.err


def assert_process_refuses(arguments: Sequence[object], here: Path) -> None:
    """`python ARGUMENTS` in `here`, the same as a process."""
    before = listing(here)
    done = run(arguments, here)
    assert done.returncode == 2
    assert_one_line(done.stderr)
    assert not done.stdout
    assert listing(here) == before


def load_arrays(path: Path = TRANSPORT) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and metadata of a policy file, free to be damaged."""
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    return arrays, json.loads(str(arrays.pop("card")))


def write_arrays(path: Path, arrays: dict[str, np.ndarray], metadata: Any) -> Path:
    """Write a policy file without any check."""
    np.savez(path, **arrays | {"card": np.array(json.dumps(metadata))})
    return path
