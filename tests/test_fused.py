"""The closed form on split components and as one GPU kernel computes what the plain one computes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plants import HEAVE, LIGHT_BALL, REFERENCE, ROLLING, paper_with

from mjxball.config import Config, Motion, Plant
from mjxball.physics import fused, newton_euler
from mjxball.physics.components import Components, Namespace, join, split
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.kernel import make_kernel_step
from mjxball.physics.step import make_control_step, start_state

WORLDS = 8
CASES = {
    "sine": (REFERENCE, Motion()),
    "rolling": (LIGHT_BALL, ROLLING),
    "heave": (HEAVE, Motion()),
}


def batch(config: Config) -> tuple[PlantState, jax.Array, Load]:
    random = np.random.default_rng(7)
    mass = random.uniform(0.1, 0.3, WORLDS)
    load = Load(
        mass,
        mass,
        random.uniform(0.02, 0.05, WORLDS),
        random.uniform(0.3, 3, WORLDS),
        random.uniform(0, 6, WORLDS),
        random.uniform(-0.05, 0.1, (WORLDS, 1)),
        random.uniform(0, 0.02, (WORLDS, 1)),
    )
    zero = np.zeros((WORLDS, 3))
    euler, velocity = random.normal(0, 0.2, (2, WORLDS, 3))
    state = start_state(config, zero, euler, velocity, mass, random.uniform(-0.05, 0.05, WORLDS))
    commands = random.normal(0, 0.1, (WORLDS, 2, 3))
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), (state, commands, load))


@pytest.mark.parametrize("name", CASES)
def test_fused_step_equals_the_plain_one(name: str) -> None:
    plant, motion = CASES[name]
    config = paper_with(plant, motion)
    arguments = batch(config)
    plain = make_control_step(config, newton_euler.make_engine(config.plant, config.attitude))
    expected, found = jax.jit(plain)(*arguments), jax.jit(fused.make_fused_step(config))(*arguments)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # float32 rounding of four steps; rates reach 10 rad/s
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_fused_step_works_for_one_world_under_vmap() -> None:
    config = paper_with()
    arguments = batch(config)
    step = fused.make_fused_step(config)
    one_by_one, together = jax.jit(jax.vmap(step))(*arguments), jax.jit(step)(*arguments)
    for a, b in zip(jax.tree.leaves(one_by_one), jax.tree.leaves(together), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)  # the compiler may order sums differently


def test_kernel_equals_the_fused_step() -> None:
    config = dataclasses.replace(paper_with(), motion=Motion())
    state, commands, load = batch(config)
    arguments = fused.split_state(state), split(commands, 2), fused.split_load(load)
    kernel = make_kernel_step(config, block=4, interpret=True)
    expected = jax.jit(fused.make_split_step(config))(*arguments)
    joined = (jax.tree.leaves(fused.join_state(state)) for state in (kernel(*arguments), expected))
    for a, b in zip(*joined, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_kernel_refuses_a_batch_that_is_no_multiple_of_its_block() -> None:
    config = paper_with(Plant())
    state, commands, load = batch(config)
    with pytest.raises(ValueError, match="multiple"):
        make_kernel_step(config, block=3)(fused.split_state(state), split(commands, 2), fused.split_load(load))


def test_components_behave_like_the_array_they_split() -> None:
    random = np.random.default_rng(8)
    a, b = (jnp.asarray(random.normal(size=(5, 2, 3)), jnp.float32) for _ in range(2))
    x, y = split(a, 2), split(b, 2)
    assert x.shape == (2, 3)
    assert x.dtype == jnp.float32
    checks = {
        "arithmetic": ((2 - x) * y / (1 + y * y) - x**2, (2 - a) * b / (1 + b * b) - a**2),
        "index": (x[..., 1, :], a[..., 1, :]),
        "slice": (x[..., 1:], a[..., 1:]),
        "new axis": (x[..., None, :] * y[..., None], a[..., None, :] * b[..., None]),
        "sum": (x.sum(axis=-1), a.sum(axis=-1)),
        "first sum": (x.sum(axis=-2), a.sum(axis=-2)),
        "where": (Namespace.where(x > y, x, -y), jnp.where(a > b, a, -b)),
        "clip": (Namespace.clip(x, -0.5, 0.5), jnp.clip(a, -0.5, 0.5)),
        "stack": (Namespace.stack([x, y], axis=-1), jnp.stack([a, b], axis=-1)),
        "concat": (Namespace.concat([x, y], axis=-1), jnp.concatenate([a, b], axis=-1)),
        "NumPy on the left": (np.array([1.0, 2.0, 3.0]) * x, np.array([1.0, 2.0, 3.0]) * a),
        "asarray": (x + Namespace.asarray([1.0, 2.0, 3.0]), a + jnp.asarray([1.0, 2.0, 3.0])),
    }
    for name, (found, expected) in checks.items():
        assert isinstance(found, Components), name
        np.testing.assert_allclose(join(found), expected, rtol=1e-6, err_msg=name)
