"""Products of JAX arrays are of full float32, whatever JAX is told: GPUs round those of its default to TF32."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from jax.extend import core
from tables import rows

from mjxball import config as configs
from mjxball.baselines import CONTROLLERS, make_baseline
from mjxball.control.followers import PrivilegedInfo
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.evaluate.policies import native_config
from mjxball.physics.step import TRAINING_ENGINES
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policies

KEY = jax.random.key(0)
PRODUCTS = ("conv_general_dilated", "dot_general", "ragged_dot_general")
WHOLE = (jax.lax.Precision.HIGHEST,) * 2


def equations(value: Any) -> Iterator[Any]:
    """Every equation of a traced program, those of the programs that it calls included."""
    if isinstance(value, core.ClosedJaxpr | core.Jaxpr):
        for equation in value.eqns:
            yield equation
            yield from equations(list(equation.params.values()))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from equations(part)


def rounded(function: Callable[..., Any], *arguments: Any) -> tuple[int, int]:
    """(products in `function` of `arguments`, those of them that a GPU may round)."""
    with jax.default_matmul_precision("tensorfloat32"):  # a user's own setting
        traced = jax.make_jaxpr(function)(*arguments)
    found = [one.params["precision"] for one in equations(traced) if one.primitive.name in PRODUCTS]
    return len(found), sum(precision != WHOLE for precision in found)


def reward(env: TransportEnv) -> Callable[..., Any]:
    """Of one step, for its gradient."""
    return lambda action, state: jnp.sum(env.step(state, action).reward)


def check_environment(preset: str, physics: str, gradient: bool) -> None:
    env = TransportEnv(configs.replace(configs.preset(preset), "follower.recurrent_units", 0), physics)
    action = jnp.zeros((env.config.plant.count - 1, 3) if env.team_sizes else 3)
    state = jax.eval_shape(env.reset, KEY)
    assert rounded(env.reset, KEY)[1] == 0
    count, default = rounded(env.step, state, action)
    assert (count > 0) is (physics == "mjx")
    assert default == 0
    if gradient:
        assert rounded(jax.grad(reward(env)), action, state)[1] == 0


def test_the_default_environment_does_not_round_its_products() -> None:
    """All 15 products of its step were of JAX's default."""
    check_environment("transport", "mjx", gradient=True)


@pytest.mark.release  # three more traces
@rows("preset, physics", [("stand", "mjx"), ("universal", "newton-euler"), ("team", "mjx")])
def test_other_environments_do_not_round_their_products(preset: str, physics: str) -> None:
    check_environment(preset, physics, gradient=False)


def test_laws_do_not_round_their_products() -> None:
    """Of every shipped policy and every baseline that is written for JAX, and of what their gradients multiply."""
    for path in shipped_policies():
        policy, config = Policy.load(path), native_config(path) or configs.preset("paper")
        policy.join(config.plant)
        followers = () if config.plant.count == 2 else (config.plant.count - 1,)
        controller, seen = policy.controller, jnp.full((*followers, 18), 0.01)
        memory = jnp.asarray(controller.start(seen))
        count, default = rounded(controller.answer, memory, seen)
        assert count > 1, path
        assert default == 0, path
        slope = jax.grad(lambda seen, memory, controller=controller: controller.answer(memory, seen)[1].sum())
        assert rounded(slope, seen, memory)[0] > count, path
        assert rounded(slope, seen, memory)[1] == 0, path


def test_baselines_do_not_round_their_products() -> None:
    for preset in ("paper", "team", "stand"):
        config, multiplied = configs.preset(preset), 0
        followers = () if config.plant.count == 2 else (config.plant.count - 1,)
        seen, one = jnp.full((*followers, 18), 0.01), jnp.ones(followers)
        two = one if not followers else jnp.ones((*followers, 2))
        drones = (*followers, config.plant.count)
        known = PrivilegedInfo(
            *(0.2 * one, 0.01 * two, 0.0 * two, 2.2 * one, jnp.ones(drones)),
            moment_rate=0.0 * two,
            rotors=jnp.ones((*drones, 3)),
            force=jnp.ones((*followers, 3)),
            loop_scale=one,
            loops=jnp.ones((*drones, 13)),
        )
        for name in CONTROLLERS:
            try:
                controller: Any = make_baseline(name, config).controller
                state = controller.start(seen)
                count, default = rounded(controller.step, state, seen, known)
            except (InputError, jax.errors.TracerArrayConversionError):
                continue  # of another plant, or NumPy's alone
            assert default == 0, (preset, name)
            multiplied += count
        assert multiplied > 5, preset


@pytest.mark.slow  # JaxMARL takes 4 s to import, Brax two
def test_adapters_do_not_round_their_products() -> None:
    import brax_trainers
    from mjxball.gym import core, playground

    config = configs.replace(configs.preset("transport"), "follower.recurrent_units", 0)
    chains, action = jax.random.split(KEY, 2), jnp.zeros((2, 3))
    found = {}
    for physics in TRAINING_ENGINES:
        program = core.program(config, physics, many=True)
        state = jax.eval_shape(program.start, chains)[1]
        found["vector", physics] = rounded(program.next_step, chains, state, action)
        found["same step", physics] = rounded(program.same_step, chains, state, action)
        env = playground.PlaygroundEnv(config=config, physics=physics)
        found["playground", physics] = rounded(env.step, jax.eval_shape(env.reset, KEY), action[0])
        program = core.program(config, physics)
        alone = jax.eval_shape(program.start, KEY)[1]
        found["parallel", physics] = rounded(program.step, alone, action[0])
    found["single", ""] = rounded(program.arrive, alone, action[0], alone.pipeline_state.plant)
    brax_trainers.brax_trainer("ppo")
    from brax.envs import training

    wrapped = training.wrap(TransportEnv(config, "mjx"), episode_length=10)
    found["brax", "mjx"] = rounded(wrapped.step, jax.eval_shape(wrapped.reset, jax.random.key_data(chains)), action)
    jaxmarl = pytest.importorskip("mjxball.gym.jaxmarl")
    team = jaxmarl.FollowersMultiAgentEnv(config=config, physics="mjx")
    acting = dict.fromkeys(team.agents, action[0])
    found["jaxmarl", "mjx"] = rounded(team.step, KEY, jax.eval_shape(team.reset, KEY)[1], acting)
    for name, (count, default) in found.items():
        assert (count > 0) is (name[1] == "mjx"), name
        assert default == 0, name
