"""What cannot fit is refused before it compiles, with the numbers; every preset is let through."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from command_line import STEPS, assert_one_line, assert_refused, environment, script

from mjxball import config as configs
from mjxball.commands.train import main
from mjxball.errors import InputError
from mjxball.train import program as programs
from mjxball.train import requirements
from mjxball.train.extensions import Extensions, find
from mjxball.train.population import Population
from mjxball.train.program import TrainingProgram
from mjxball.train.requirements import PROGRAM, required
from mjxball.xla import explained

PHYSICS = ["--physics", "newton-euler"]
TOO_MUCH: list[tuple[list[Any], str]] = [
    (["--algorithm", "gradient", "--gradient.num_envs", 10**11], "at least .* GB|environment steps|must be between"),
    (["--algorithm", "gradient", "--gradient.num_envs", 10**6, "--gradient.gradient_steps", 1], "GB are free"),
    (["--algorithm", "ppo", "--ppo.num_envs", 10**11, "--ppo.minibatches", 8], "between"),
    (["--sac.policy_layers", "100000,100000"], "GB are free"),
    (["--sac.critic_layers", "100000,100000"], "GB are free"),
    (["--sac.replay_size", 128 * 10**7], "GB are free"),
    (["--follower.recurrent_units", 10**8], "recurrent_units must be between 0 and 512"),
    (["transport", "--follower.recurrent_units", 512, "--num-seeds", 1024], "GB are free"),
    (["transport", "--num-seeds", 4096], "GB are free"),
    (["--sac.total_steps", 10**12], "environment steps"),
    (["--timing.control_period", "1e-30"], "control_period"),
    (["--timing.physics_steps", 10**9], "physics_steps"),
]


def test_what_fits_no_computer_is_refused_with_the_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(requirements, "_available", lambda: 64e9)
    for arguments, words in TOO_MUCH:
        said = assert_refused(main, [*PHYSICS, *arguments], tmp_path, capsys)
        assert re.search(words, said), said


def test_every_preset_fits_a_large_computer() -> None:
    for name in configs.PRESETS:
        settings = configs.preset(name)
        for algorithm in ("sac", "ppo", "gradient"):
            needs = required(settings, algorithm, 1)
            assert needs.memory < 16e9, (name, algorithm)
            assert needs.steps < requirements.MOST_STEPS, (name, algorithm)


@pytest.mark.parametrize("algorithm", ["sac", "ppo"])
def test_the_estimate_is_below_the_true_state_and_near_it_where_it_is_large(algorithm: str) -> None:
    """Arrays of a state as JAX would make them, without making them."""
    settings = configs.replace(configs.preset("transport"), "sac.replay_size", 4096 * 250)
    for path, value in (("policy_layers", (512, 512)), ("num_envs", 4096)):
        settings = configs.replace(settings, f"{algorithm}.{path}", value)
    settings = configs.replace(settings, "ppo.unroll_length", 1)
    extensions = Extensions(algorithm=find(algorithm, "--algorithm"))
    template = Population(settings, "newton-euler", extensions=extensions).template()
    true = sum(np.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(template))
    estimate = required(settings, algorithm, 1).memory
    assert estimate < 2.05 * true  # two copies of the state, and little else
    if algorithm == "sac":
        assert estimate > 1.8 * true  # nearly all of it is the replay


@pytest.mark.release
def test_the_estimate_of_gradients_is_below_what_xla_takes() -> None:
    """What a window keeps for the way back is most of it."""
    settings = configs.preset("transport")
    for path, value in (("policy_layers", (32, 32)), ("num_envs", 256), ("horizon", 20)):
        settings = configs.replace(settings, f"gradient.{path}", value)
    program = TrainingProgram(
        settings, "newton-euler", extensions=Extensions(algorithm=find("gradient", "--algorithm"))
    )
    state = jax.eval_shape(program.create, jax.random.PRNGKey(0))
    compiled = jax.jit(program.advance).lower(state, programs.train_mode(20)).compile()
    taken = compiled.memory_analysis()
    assert required(settings, "gradient", 1).memory < taken.temp_size_in_bytes + 2 * taken.argument_size_in_bytes


def test_room_is_the_least_of_all_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = {"_available": 9e9, "_left_of_group": 7e9, "room_in_address_space": 8e9}
    for name, room in rooms.items():
        monkeypatch.setattr(requirements, name, lambda room=room: room)
    assert requirements.room_for_arrays() == (7e9 - PROGRAM, "in its control group")
    monkeypatch.setattr(requirements, "_left_of_group", lambda: float("inf"))
    assert requirements.room_for_arrays() == (8e9 - PROGRAM, "below the limit of ulimit -v")


def test_limits_are_read_as_the_kernel_writes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        "meminfo": "MemTotal:  100 kB\nMemAvailable:   60 kB\nSwapFree:  4 kB\n",
        "memory.max": "5000\n",
        "memory.current": "3000\n",
        "memory.stat": "anon 2000\ninactive_file 700\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(requirements, "Path", lambda place: tmp_path / "meminfo" if "proc" in place else tmp_path)
    assert requirements._available() == 64 * 1024
    assert requirements._left_of_group() == 5000 - 3000 + 700
    (tmp_path / "memory.max").write_text("max\n")
    assert requirements._left_of_group() == float("inf")


@pytest.mark.slow
def test_a_narrow_address_space_is_refused_at_once(tmp_path: Path) -> None:
    """Below it JAX's threads cannot be made: it waits for ever, or aborts."""
    for command in (["train.py"], ["eval.py", "--followers", "copy"]):
        done = subprocess.run(
            ["bash", "-c", 'ulimit -v 1500000; exec "$@"', "_", sys.executable, script(command[0]), *command[1:]],
            cwd=tmp_path,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 2, done.stderr
        assert_one_line(done.stderr)
        assert "1.54 GB" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_running_out_of_memory_is_a_sentence() -> None:
    assert "not enough memory" in (explained(MemoryError()) or "")
    error = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 400000000000 bytes.\nmore")
    assert "400000000000" in (explained(error) or "")
    assert explained(RuntimeError("something else")) is None
    with pytest.raises(InputError, match="GB are free"):
        requirements.check(configs.replace(configs.preset("transport"), "sac.replay_size", STEPS * 10**9), "sac", 1)
