"""Policy delay, gradient clipping and the cache's place."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.algorithms import sac
from mjxball.algorithms.replay import Transitions
from mjxball.cache import cache_directory
from mjxball.config import Sac

SMALL = Sac(policy_layers=(8,), critic_layers=(8,), batch_size=16)


def run(config: Sac, updates: int) -> list[sac.Learner]:
    """Learners before and after each of `updates` updates on random transitions."""
    networks = sac.make_networks(config, [1.0] * 4, 2)
    learner = sac.create(networks, config, 4, jax.random.PRNGKey(0))
    update = jax.jit(sac.make_update(networks, config, 2))
    random = np.random.default_rng(0)
    seen, after = (jnp.asarray(random.normal(size=(16, 4)), jnp.float32) for _ in range(2))
    action = jnp.asarray(random.uniform(-1, 1, (16, 2)), jnp.float32)
    reward, ones = jnp.asarray(100 * random.normal(size=16), jnp.float32), jnp.ones(16)
    batch = Transitions(seen, action, reward, ones, after, 0 * ones)
    learners = [learner]
    for number in range(updates):
        keys = jax.random.split(jax.random.PRNGKey(number), 3)
        learners.append(update(learners[-1], batch, keys, jnp.ones(()))[0])
    return learners


def same(a: object, b: object) -> bool:
    return all(bool((x == y).all()) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_max_grad_normping_bounds_the_global_norm() -> None:
    gradient = {"a": jnp.array([3.0, 4.0]), "b": jnp.array([12.0])}  # norm 13
    clipped = sac._clip(gradient, dataclasses.replace(SMALL, max_grad_norm=1.3))
    np.testing.assert_allclose(clipped["a"], [0.3, 0.4], rtol=1e-6)
    np.testing.assert_allclose(clipped["b"], [1.2], rtol=1e-6)
    for free in (0.0, 20.0):
        kept = sac._clip(gradient, dataclasses.replace(SMALL, max_grad_norm=free))
        np.testing.assert_array_equal(kept["a"], gradient["a"])


def test_clipped_update_differs_from_a_free_one() -> None:
    # Adam's first step is blind to the gradient's scale, its second is not once the scale varies between them.
    free, clipped = (run(dataclasses.replace(SMALL, max_grad_norm=clip), 3)[-1] for clip in (0.0, 0.5))
    assert not same(free.critic, clipped.critic)


def test_cache_directory_can_be_chosen_or_switched_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MJXBALL_CACHE", str(tmp_path / "here"))
    assert cache_directory() == tmp_path / "here"
    monkeypatch.setenv("MJXBALL_CACHE", "off")
    assert cache_directory() is None
    monkeypatch.delenv("MJXBALL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_directory() == tmp_path / "mjxball" / "jax"
