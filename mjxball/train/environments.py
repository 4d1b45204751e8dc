"""Environments side by side: any Brax environment, stepped, counted and started anew as the trainer needs it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjxball.algorithms.base import Shards, Transition

Array = Any


class Tally(NamedTuple):
    """Sums over the steps of one call of `Program.advance`."""

    reward: Array  # mean reward per step, summed over steps
    ended: Array  # episodes terminated
    totals: dict[str, Array]  # each of the environment's metrics, summed over environments and steps
    peaks: dict[str, Array]  # (envs,) the largest of each


class Envs(NamedTuple):
    """What `Environments.step` carries on."""

    states: Any  # brax State of all environments
    tally: Tally
    difficulty: Array | float  # of what is drawn at a reset, 0 to 1: see `Schedule.curriculum`


def report(env: Any, totals: Mapping[str, Any], peaks: Mapping[str, Any], count: float, evaluation: bool) -> Any:
    """What metrics.csv says of an environment's metrics: {name: (members,)}, NaN where there is nothing to say.

    The environment's own `report(totals, peaks, count, evaluation)`, else the mean of each of its metrics.
    """
    if hasattr(env, "report"):
        return env.report(totals, peaks, count, evaluation)
    return {name: total / count for name, total in totals.items() if name != "reward"}


class Environments:
    """`count` environments on each shard; see `mjxball.algorithms.base.Environments`.

    Beyond Brax's `Env` an environment may have `input_mask` and `critic_mask` (n,), `report` (above), and a second
    argument of `reset`, the difficulty of what is drawn.
    """

    def __init__(self, env: Any, count: int, shards: Shards | None = None):
        self.env, self.count, self.shards = env, count, shards or Shards()
        self.observation_size, self.action_size = env.observation_size, env.action_size
        self.policy_mask = getattr(env, "input_mask", None) or [1.0] * self.observation_size
        self.critic_mask = getattr(env, "critic_mask", None) or self.policy_mask
        self._graded = len(inspect.signature(env.reset).parameters) > 1
        self._step = jax.vmap(env.step)

    def reset(self, key: Array, difficulty: Array | float = 1.0) -> Any:
        """New states of all environments."""
        keys = jax.random.split(self.shards.own(key), self.count)
        if not self._graded:
            return jax.vmap(self.env.reset)(keys)
        return jax.vmap(lambda one: self.env.reset(one, difficulty))(keys)

    def staggered(self, states: Any, key: Array, episode_steps: int) -> Any:
        """`states` with part of their episodes behind them, so that they do not end together."""
        steps = jax.random.randint(self.shards.own(key), (self.count,), 0, episode_steps)
        if "steps" in states.info:
            kept = states.info["steps"]
            return states.replace(info={**states.info, "steps": steps.astype(kept.dtype)})
        world = states.pipeline_state
        if "steps" in getattr(world, "_fields", ()):
            return states.replace(pipeline_state=world._replace(steps=steps))
        return states

    def begin(self, states: Any, difficulty: Array | float) -> Envs:
        """`states` with an empty tally."""
        zero = jnp.zeros(())
        totals = dict.fromkeys(states.metrics, zero)
        peaks = dict.fromkeys(states.metrics, jnp.zeros(self.count))
        return Envs(states, Tally(zero, zero, totals, peaks), difficulty)

    def step(self, envs: Envs, action: Array, key: Array) -> tuple[Envs, Transition]:
        """See `mjxball.algorithms.base.Environments`."""
        before = envs.states
        after = self._step(before, action)
        terminated = after.done * (1 - after.info["truncation"])
        fresh = self.reset(key, envs.difficulty)

        def reset_if_done(new: Array, old: Array) -> Array:
            done = after.done.astype(bool).reshape((-1,) + (1,) * (old.ndim - 1))
            return jnp.where(done, new, old)

        states = jax.tree.map(reset_if_done, fresh, after)
        tally, metrics = envs.tally, after.metrics
        tally = Tally(
            reward=tally.reward + after.reward.mean(),
            ended=tally.ended + terminated.sum(),
            totals={name: total + metrics[name].sum() for name, total in tally.totals.items()},
            peaks={name: jnp.maximum(peak, metrics[name]) for name, peak in tally.peaks.items()},
        )
        seen = Transition(before.obs, action, after.reward, terminated, after.obs, after.done)
        return Envs(states, tally, envs.difficulty), seen

    def over_shards(self, tally: Tally) -> Tally:
        """The tally of all shards together; `peaks` stay each shard's own environments."""
        total = self.shards.total
        return tally._replace(
            reward=self.shards.mean(tally.reward), ended=total(tally.ended), totals=total(tally.totals)
        )
