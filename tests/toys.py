"""A Brax-style environment, rewards and mistakes of a user's own, found by name."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from mjxball.env import TransportEnv
from mjxball.quiet import import_brax_env

Env, State = import_brax_env()


class DoubleIntegrator(Env):
    """A point on a line, pushed by the action towards 0. It keeps no time and knows nothing of mjxball."""

    observation_size, action_size, backend = 2, 1, "none"

    def reset(self, rng: Any) -> Any:
        obs = jax.random.uniform(rng, (2,), minval=-1.0)
        zero = jnp.zeros(())
        return State(None, obs, zero, zero, {"distance": zero}, {})

    def step(self, state: Any, action: Any) -> Any:
        position, speed = state.obs
        speed = speed + 0.2 * action[0]
        position = position + 0.2 * speed
        lost = (jnp.abs(position) > 3.0).astype(jnp.float32)
        reward = -(position**2) - 0.1 * speed**2 - 10.0 * lost
        obs = jnp.stack([position, speed])
        return state.replace(obs=obs, reward=reward, done=lost, metrics={"distance": jnp.abs(position)})


class Gentle(TransportEnv):
    """Ours, teams included, where a pitch rate costs more."""

    def step(self, state: Any, action: Any) -> Any:
        after = super().step(state, action)
        return after.replace(reward=after.reward - after.pipeline_state.plant.rates[..., 1] ** 2)


class Brief(Env):
    """Every step earns 1, and the seventh ends the episode; three numbers are seen, two are acted with."""

    observation_size, action_size, backend = 3, 2, "none"

    def reset(self, rng: Any) -> Any:
        zero = jnp.zeros(())
        return State(zero, jnp.zeros(3), zero, zero, {}, {})

    def step(self, state: Any, action: Any) -> Any:
        age = state.pipeline_state + 1.0
        return state.replace(
            pipeline_state=age, obs=jnp.full(3, age), reward=jnp.ones(()), done=(age >= 7).astype(jnp.float32)
        )


class Needy(DoubleIntegrator):
    def __init__(self, mass: float):
        self.mass = mass


class Wide(DoubleIntegrator):
    observation_size = 3


class Broken(DoubleIntegrator):
    def step(self, state: Any, action: Any) -> Any:
        raise ValueError("no such wheel")


class Fed(DoubleIntegrator):
    def step(self, state: Any, action: Any, food: Any) -> Any:
        return super().step(state, action)


class Sizeless(DoubleIntegrator):
    @property
    def observation_size(self) -> int:
        raise ValueError("no ruler")


class Masked(DoubleIntegrator):
    input_mask = 3


class Bare(DoubleIntegrator):
    def reset(self, rng: Any) -> Any:
        return super().reset(rng).replace(info=None)


class Branching(DoubleIntegrator):
    def step(self, state: Any, action: Any) -> Any:
        return super().step(state, action if action[0] > 0 else 0 * action)


class Nothing:
    """No environment."""


NUMBER = 3.0


def effort(state: Any, action: Any, after: Any) -> Any:
    """The pair's error and the action, squared."""
    return -after.metrics["error"] - (action**2).sum()


def vector(state: Any, action: Any, after: Any) -> Any:
    return action


def binary(state: Any, action: Any) -> Any:
    return 0.0


def unsound(state: Any, action: Any, after: Any) -> Any:
    """A reward that is not finite."""
    return 0.0 * after.metrics["error"] + jnp.nan
