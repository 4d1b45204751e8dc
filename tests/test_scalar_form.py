"""The scalar form of a function: the same numbers and gradients, without the products that are known to be 0."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball import config as configs
from mjxball.env import TransportEnv
from mjxball.scalar_form import MAX_ITEMS, scalar_form


def rotation(x: Any) -> Any:
    """Everything that is rewritten, once."""
    first, rest = x[:1], x[1:]
    turned = jnp.stack([rest, rest[::-1]]).T @ jnp.diag(jnp.array([1.0, 0.0]))
    many = jnp.broadcast_to(jnp.sin(first), (3,)) + turned.sum(axis=1)
    swept = jax.lax.fori_loop(0, 4, lambda i, y: jnp.where(y > 0, y * 0.9, jnp.clip(y, -1.0, 1.0)) + many, many)
    cube = (first * jnp.arange(12.0)).reshape(2, 3, 2).transpose(2, 0, 1)
    square = jnp.concatenate([swept, first]).reshape(2, 2)
    return {"a": square, "b": jnp.max(x), "c": jnp.linalg.norm(swept) / 2.0, "d": cube}


def large(x: Any) -> Any:
    """What is larger than `MAX_ITEMS` and what is unknown to the scalar form, between small arrays."""
    wide = jnp.outer(x, jnp.arange(MAX_ITEMS, dtype=x.dtype)).cumsum(axis=1)
    return jnp.sort(wide[:, -1]) + jax.random.normal(jax.random.PRNGKey(0), x.shape)


@jax.jit
def wide_call(x: Any) -> Any:
    """A call with small and large arrays in it."""
    return jnp.outer(x + 1.0, jnp.arange(MAX_ITEMS, dtype=x.dtype)).sum(axis=1) + jnp.sin(x)


def calling(x: Any) -> Any:
    """`wide_call` between small arrays."""
    return wide_call(x[::-1] * 2.0)[:2] + x[:2]


def retyped(x: Any) -> Any:
    """A number as one integer of its size, and as two of half of it."""
    whole, halves = (jax.lax.bitcast_convert_type(jnp.round(x), kind) for kind in (jnp.int32, jnp.int16))
    return x * (whole < 0), x * halves.shape[-1], (halves[:, 0] == whole % 2**16 - 2**16 * (whole % 2**16 >= 2**15)) * x


def whole_numbers(x: Any) -> Any:
    """Integers divided by integers, as counters of steps are."""
    count = jnp.round(x * 10).astype(jnp.int32)
    return x * (count // 3 % 2), x * jax.lax.div(count, jnp.int32(4))


def looped(x: Any) -> Any:
    """A loop with inputs and outputs for each step, which stays a loop."""
    total, each = jax.lax.scan(lambda total, one: (total + one, total * one), 0.0, x)
    return total, each


@pytest.mark.parametrize("function", [rotation, large, looped, retyped, calling, whole_numbers])
def test_values_and_gradients_are_those_of_the_function(function: Any) -> None:
    points = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)

    def loss(form: Any, x: Any) -> Any:
        outputs = jax.tree.leaves(form(x))
        return sum((leaf * jnp.arange(1.0, leaf.size + 1).reshape(leaf.shape)).sum() for leaf in outputs)

    form, whole = scalar_form(function), jax.vmap(function)
    found, expected = form(points), whole(points)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, expected)
    assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, expected)
    gradients = [jax.grad(lambda x, own=own: loss(own, x))(points) for own in (form, whole)]
    np.testing.assert_allclose(*gradients, rtol=1e-4, atol=1e-5)


def test_an_array_of_nothing_has_a_gradient_of_nothing() -> None:
    form, nothing = scalar_form(lambda x, none: (x * 2.0 + none.sum(), jnp.outer(none, x))), jnp.zeros((5, 0))
    slopes = jax.grad(lambda x, none: sum(leaf.sum() for leaf in form(x, none)), (0, 1))(jnp.ones((5, 4)), nothing)
    np.testing.assert_array_equal(slopes[0], np.full((5, 4), 2.0))
    assert slopes[1].shape == (5, 0)


def test_what_is_the_same_for_all_of_a_batch_stays_so() -> None:
    """A traced number outside the function, and results that no argument has a part in."""

    def step(x: Any, scale: Any) -> Any:
        grown = jax.lax.fori_loop(0, 3, lambda i, y: y * scale[0] + i, x)
        return {
            "a": grown * scale.sum(),
            "b": scale * 2.0,
            "c": jnp.arange(3.0),
            "d": jnp.sort(scale),
            "e": jnp.float32(1.0),
        }

    points, scales = np.ones((5, 4), np.float32), jnp.array([[0.5, 2.0], [1.5, -1.0]])
    found = jax.vmap(lambda scale: scalar_form(lambda x: step(x, scale))(points))(scales)
    expected = jax.vmap(lambda scale: jax.vmap(lambda x: step(x, scale))(points))(scales)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found, expected)
    assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, expected)


def test_products_with_known_zeros_vanish() -> None:
    matrix = jnp.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 3.0, 1.0]])
    program = jax.make_jaxpr(scalar_form(lambda x: matrix @ x))(np.ones((7, 3), np.float32))
    names = [equation.primitive.name for equation in program.eqns]
    assert "dot_general" not in names
    assert names.count("mul") == 2  # by 2 and by 3
    assert names.count("add") == 1


WORLD = {
    **{"offset": (0.0, 1.0), "pose_lag": (0.0, 0.03), "gap_rate": (0.0, 1.0), "jitter": (0.0, 0.01)},
    **{"rotor_drag": (0.1, 0.5), "wind": (0.0, 3.0), "floor_clearance": (0.05, 1.0), "download": (0.0, 0.2)},
    **{"attitude_frequency": (6.0, 40.0), "thrust_fade": (0.0, 0.002), "goal_motion_probability": 0.5},
    "goal_step_probability": 0.5,
}


@pytest.mark.parametrize(("name", "scenario"), [("balance", {}), ("flight", {}), ("balance", WORLD)])
def test_a_step_of_an_environment_is_the_same(name: str, scenario: Any) -> None:
    """`balance`: disturbances, delays and a memory; `flight`: the firmware's cascade and a rolling ball."""
    config = configs.replace(configs.preset(name), "follower.recurrent_units", 0)
    config = dataclasses.replace(config, scenario=dataclasses.replace(config.scenario, **scenario))
    env = TransportEnv(config, "newton-euler")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 3))
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (3, 3)), jnp.float32)
    whole, form = map(jax.jit, (jax.vmap(env.step), scalar_form(env.step)))
    expected, found = whole(whole(states, actions), actions), form(form(states, actions), actions)
    assert jax.tree.structure(expected) == jax.tree.structure(found)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5), found, expected)


def test_a_call_with_a_large_array_stays_one_call() -> None:
    def names(form: Any) -> list[str]:
        return [str(one.params.get("name")) for one in jax.make_jaxpr(form)(jnp.zeros((2, 4))).eqns]

    assert names(scalar_form(calling)).count("wide_call") == 1
    assert all(one == "None" for one in names(scalar_form(jax.jit(lambda x: x * 2.0 + x[0]))))
