"""JAX as users have it: without the device they ask for, with 64 bits, inside `shard_map`, with caches of others."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from command_line import REPOSITORY, assert_one_line, environment, listing, script, tiny
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, PartitionSpec
from tables import weekly

from mjxball import config as configs
from mjxball import entry, running
from mjxball.config import Config
from mjxball.train import compilation, train
from mjxball.xla import enable_compilation_cache

SMALL = {
    "timing.episode_steps": 100,
    "sac.total_steps": 640,
    "sac.num_envs": 8,
    "sac.replay_size": 800,
    "sac.warmup_steps": 160,
    "sac.batch_size": 16,
    "sac.updates_per_step": 1,
    "sac.policy_layers": (8,),
    "sac.critic_layers": (8,),
}


def small() -> Config:
    config = configs.preset("transport")
    for path, value in SMALL.items():
        config = configs.replace(config, path, value)
    return configs.validate(config)


def trained(key: jax.Array) -> jax.Array:
    """All weights of a policy, trained in one stretch."""
    policy, _ = train(small(), key, physics="newton-euler", evaluate=False)
    return ravel_pytree(jax.tree.leaves(policy))[0]


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["cuda", *weekly("nonsense")])
def test_an_absent_device_is_bad_input(tmp_path: Path, platform: str) -> None:
    """Exit code 1 would say that training diverged, or that a policy misses its bounds."""
    for command in ("train.py", "eval.py"):
        arguments = tiny(out=tmp_path / "run") if command == "train.py" else ["--followers", "copy"]
        done = subprocess.run(
            [sys.executable, script(command), *arguments],
            cwd=tmp_path,
            env={**environment(), "JAX_PLATFORMS": platform},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 2, done.stderr
        assert_one_line(done.stderr)
        assert f"JAX_PLATFORMS={platform}" in done.stderr
    assert listing(tmp_path) == {}


def test_an_error_of_the_program_is_no_result(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    def fail(*_: object) -> int:
        raise AssertionError("not the user's fault")

    for name, command in (("train", entry.train), ("evaluate", entry.evaluate)):
        monkeypatch.setattr(f"mjxball.commands.{name}.main", fail)
        for later in ("quit_on_interrupt", "collect_seldom", "switch_often"):
            monkeypatch.setattr(entry, later, lambda: None)
        assert command() == running.FAULT == 3
        assert "not the user's fault" in capsys.readouterr().err  # with its traceback


@pytest.mark.release
def test_64_bits_change_nothing_of_a_run(tmp_path: Path) -> None:
    """The same policy to the bit, so that a run may be resumed with or without."""
    found = []
    for bits in ("0", "1"):
        out = tmp_path / bits
        done = subprocess.run(
            [sys.executable, REPOSITORY / "tests" / "short_train.py", *tiny(out=out, sac__total_steps=3200)],
            cwd=REPOSITORY,
            env={**environment(), "JAX_ENABLE_X64": bits, "PYTHONPATH": str(REPOSITORY)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        with np.load(out / "policy.npz") as data:
            found.append({name: data[name] for name in data.files if name != "card"})
    for name, value in found[0].items():
        np.testing.assert_array_equal(found[1][name], value, err_msg=name)


@pytest.mark.release
def test_train_is_the_same_with_64_bits_and_over_a_mesh() -> None:
    """`shard_map` needs check_vma=False, as the docstring says: Brax's networks know nothing of varying axes."""
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    alone = jax.jit(jax.vmap(trained))(keys)
    assert alone.dtype == np.float32
    mesh, spec = jax.make_mesh((1,), ("members",), axis_types=(AxisType.Auto,)), PartitionSpec("members")
    spread = jax.shard_map(jax.vmap(trained), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    np.testing.assert_allclose(jax.jit(spread)(keys), alone, rtol=1e-4, atol=1e-5)
    with jax.enable_x64(True):
        double = jax.jit(jax.vmap(trained))(keys)
    assert double.dtype == np.float32
    np.testing.assert_allclose(double, alone, rtol=1e-4, atol=1e-5)


def test_a_cache_of_another_user_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MJXBALL_CACHE", str(tmp_path / "cache"))
    with compilation.jax_setting("jax_compilation_cache_dir", None):
        monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != tmp_path / "cache")
        assert enable_compilation_cache() is None
        assert jax.config.jax_compilation_cache_dir is None
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert f"{tmp_path / 'cache'} cannot be written" in said
        (tmp_path / "file").touch()
        monkeypatch.setenv("MJXBALL_CACHE", str(tmp_path / "file" / "below"))  # no directory can be made there
        assert enable_compilation_cache() is None
        assert "cannot be written" in capsys.readouterr().err


def test_a_cache_that_refuses_files_is_gone_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the write nor its clean-up, which is refused as well, ends a training."""

    def refuse(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    class Exported:
        def serialize(self) -> bytes:
            return b"program"

    compilation._write(tmp_path / "traced" / "good", Exported(), [1])
    assert (tmp_path / "traced" / "good").read_bytes() == b"[1]\nprogram"
    for method in ("open", "unlink"):
        monkeypatch.setattr(Path, method, refuse)
    compilation._write(tmp_path / "traced" / "refused", Exported(), [1])
    assert os.listdir(tmp_path / "traced") == ["good"]
