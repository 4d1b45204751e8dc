"""Traced programs: arrays that are carried on, the cache, and what is told to XLA."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball import config as configs
from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.algorithms.ppo import ProximalPolicyOptimization
from mjxball.train import program as programs
from mjxball.train.compilation import TracedProgram, compiler_options
from mjxball.train.extensions import Extensions, TracedOnce
from mjxball.train.population import Population


def rolling(state: dict[str, Any], step: Any) -> tuple[dict[str, Any], Any]:
    """`total` changes, `kept` is read, `far` and the random key are not even that."""
    return {**state, "total": state["total"] + step * state["kept"]}, step + 1


def shapes(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), tree)


@pytest.mark.parametrize("cached", [False, True])
def test_only_what_a_program_reads_and_changes_passes_through_it(
    cached: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mjxball.train.compilation.traced_directory", lambda: tmp_path)
    state = {"far": jnp.ones(3), "key": jax.random.key(1), "kept": jnp.full(2, 5.0), "total": jnp.zeros(2)}
    step, calls = jnp.float32(2.0), []

    def function(*arguments: Any) -> Any:
        calls.append(1)
        return rolling(*arguments)

    for _ in range(1 + cached):
        program = TracedProgram("rolling", {"test": 1}, function, lambda: shapes((state, step)), others=1)
        lowered = program.lower_carrying()
    assert len(calls) == 1  # the second one is the file's
    names = sorted(state)
    assert [names[k] for k in lowered.writes] == ["total"]
    assert {names[k] for k in lowered.reads if k < len(state)} == {"key", "kept", "total"}  # a key has no zeros
    run, carried = lowered.compile(None), jax.tree.leaves(state)
    before = list(carried)
    for count in (1, 2):
        (after,) = run(carried, step)
        assert float(after) == 3.0
        np.testing.assert_array_equal(carried[3], np.full(2, 10.0 * count))
    assert all(one is other for one, other in zip(carried[:3], before[:3], strict=True))
    np.testing.assert_array_equal(carried[0], np.ones(3))  # its memory was not given away
    assert before[3].is_deleted()


def test_many_followers_products_are_tuned_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    tuned = "xla_gpu_autotune_level"
    alone, together = compiler_options(members=1), compiler_options(members=64)
    assert alone is not None
    assert together is not None
    assert alone[tuned] == 0
    assert tuned not in together
    large = compiler_options(ProximalPolicyOptimization)
    assert large is not None
    assert tuned not in large
    assert not large["xla_gpu_enable_triton_gemm"]  # hundreds of kernels to compile and try


def test_xla_takes_the_options_of_every_device(monkeypatch: pytest.MonkeyPatch) -> None:
    lowered = jax.jit(jnp.sin).lower(1.0)
    for device, algorithm in ((one, kind) for one in ("cpu", "gpu") for kind in (None, FirstOrderGradient)):
        monkeypatch.setattr(jax, "default_backend", lambda device=device: device)
        options = compiler_options(algorithm)
        assert ("xla_gpu_graph_min_graph_size" in (options or {})) is (device == "gpu" and algorithm is not None)
        assert lowered.compile(compiler_options=options)(1.0) == pytest.approx(np.sin(1.0))


class Measured:
    """An environment that measures its observation by a reset, as Brax's do."""

    def __init__(self, looks: bool):
        self.looks, self.computed = looks, 0

    @property
    def observation_size(self) -> int:
        found = jnp.arange(4.0) + 1.0
        self.computed += not isinstance(found, jax.core.Tracer)
        return int(found.sum()) if self.looks else found.shape[0]


@pytest.mark.parametrize(("looks", "size", "computed"), [(False, 4, 0), (True, 10, 1)])
def test_a_size_is_known_without_computing_a_reset(looks: bool, size: int, computed: int) -> None:
    """Unless the environment looks at numbers."""
    env = Measured(looks)
    once = TracedOnce(env)
    assert [once.observation_size, once.observation_size] == [size, size]
    assert env.computed == computed


def test_a_program_that_was_traced_before_trains_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjxball.train.compilation.traced_directory", lambda: tmp_path)
    config = configs.replace(configs.preset("transport"), "gradient.num_envs", 2)
    config = configs.replace(config, "gradient.horizon", 2)
    rewards = []
    for _ in range(2):
        population = Population(config, "newton-euler", extensions=Extensions(None, None, FirstOrderGradient))
        compiled = population.compile(creating=True)
        state = population.start(compiled, 0)
        for mode in (programs.warmup_mode(2), programs.train_mode(4)):
            state, statistics, *_ = population.advance(compiled, state, mode)
        rewards.append(float(statistics.reward))
        assert int(state.steps) == 12
    assert rewards[0] == rewards[1] != 0.0
