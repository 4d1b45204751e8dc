"""Environments side by side: reset, step and restart of all of them on one shard, with their statistics."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball.algorithms.base import Shards, Transition
from mjxball.errors import InputError
from mjxball.scalar_form import scalar_form
from mjxball.train.extensions import is_transport_env

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Statistics(NamedTuple):
    """Sums over the steps of one call of `TrainingProgram.advance`."""

    reward: Float[Array, ""]  # mean reward per step, summed over steps
    ended: Float[Array, ""]  # episodes terminated
    totals: dict[str, Float[Array, ""]]  # each of the environment's metrics, summed over environments and steps
    peaks: dict[str, Float[Array, " envs"]]  # maximum of each metric over steps


def added(first: Statistics, second: Statistics) -> Statistics:
    """Statistics over the steps of both."""
    return Statistics(
        reward=first.reward + second.reward,
        ended=first.ended + second.ended,
        totals={name: total + second.totals[name] for name, total in first.totals.items()},
        peaks={name: jnp.maximum(peak, second.peaks[name]) for name, peak in first.peaks.items()},
    )


class Envs(NamedTuple):
    """States of `Environments` and statistics of the steps so far."""

    states: Any  # brax State of all environments
    statistics: Statistics


def report(env: Any, totals: Mapping[str, Any], peaks: Mapping[str, Any], count: float, evaluation: bool) -> Any:
    """An environment's columns of metrics.csv, {name: (members,)}, NaN if undefined, from sums over `count` steps.

    These are `env.report(totals, peaks, count, evaluation)`, if it exists, else the mean of each metric.
    """
    if hasattr(env, "report"):
        return env.report(totals, peaks, count, evaluation)
    return {name: total / count for name, total in totals.items() if name != "reward"}


class Agents:
    """Mapping between worlds of teams and agents, the followers that fly, numbered world after world.

    A world has F slots for followers. In a world of N drones the first N - 1 slots are filled.
    """

    def __init__(self, sizes: Sequence[int], slots: int, count: int):
        """`count` agents in worlds of `sizes` drones, repeated cyclically, with F = `slots`.

        Raises InputError if `count` does not fill whole cycles.
        """
        each = sum(sizes) - len(sizes)
        if count % each:
            raise InputError(
                f"num_envs = {count} followers do not fill worlds of {', '.join(map(str, sizes))} drones in turn; "
                f"make it a multiple of {each}"
            )
        self.worlds = count // each * len(sizes)
        followers = [size - 1 for size in sizes] * (count // each)
        self.world = np.repeat(np.arange(self.worlds), followers)
        self.first = np.concatenate([[0], np.cumsum(followers)[:-1]])  # (worlds,) the agent in the first slot
        # (count,) chosen so that episode starts are staggered over worlds of each size, and over few worlds too.
        self.turn = self.world // len(sizes) + self.world % len(sizes)
        self.slot = np.arange(count) - self.first[self.world]
        # (worlds, F); empty slots repeat the first agent, whose action has no effect there.
        filled = np.arange(slots) < np.array(followers)[:, None]
        self.table = np.where(filled, self.first[:, None] + np.arange(slots), self.first[:, None])

    def per_agent(self, states: Any) -> Any:
        """States (worlds, [F,] ...) with all fields but `pipeline_state` rearranged by agent (count, ...)."""
        own = {name: getattr(states, name)[self.world, self.slot] for name in ("obs", "reward")}
        shared = {name: jax.tree.map(lambda leaf: leaf[self.world], getattr(states, name)) for name in SHARED}
        return states.replace(**own, **shared)

    def per_world(self, states: Any) -> Any:
        """The inverse of `per_agent`."""
        own = {name: getattr(states, name)[self.table] for name in ("obs", "reward")}
        shared = {name: jax.tree.map(lambda leaf: leaf[self.first], getattr(states, name)) for name in SHARED}
        return states.replace(**own, **shared)


SHARED = ("done", "metrics", "info")  # fields of a state that all followers of a world share


class Environments:
    """`count` environments on each shard; see `mjxball.algorithms.base.EnvironmentBatch`.

    Besides Brax's `Env` interface, an environment may have `input_mask` and `critic_mask` (n,), and `report` (above).
    One with `team_sizes` has several followers (see `mjxball.env`). Each follower then counts as one environment:
    states are (count, ...), but `pipeline_state` is (worlds, ...). A world is reset when its first follower is. Its
    `reset` takes the index of the world as a second argument.
    """

    def __init__(self, env: Any, count: int, shards: Shards | None = None):
        self.env, self.count, self.shards = env, count, shards or Shards()
        self.observation_size, self.action_size = env.observation_size, env.action_size
        self.recurrent_slots = getattr(env, "recurrent_slots", slice(self.observation_size, self.observation_size))
        self.policy_mask = getattr(env, "input_mask", None) or [1.0] * self.observation_size
        self.critic_mask = getattr(env, "critic_mask", None) or self.policy_mask
        self.smooth = is_transport_env(env)
        # `scalar_form` halves the time of a closed-form step on a CPU. MJX gains nothing, and compiles longer.
        closed = self.smooth and env.backend == "newton-euler" and jax.default_backend() == "cpu"
        self._step = (scalar_form if closed else jax.vmap)(env.step)
        sizes = getattr(env, "team_sizes", None)
        slots, whole = env.config.plant.count - 1 if sizes else 0, count * self.shards.parts
        self._agents = Agents(sizes, slots, count) if sizes else None
        self._turns = Agents(sizes, slots, whole).turn if sizes else np.arange(whole)

    @property
    def _worlds(self) -> int:
        return self._agents.worlds if self._agents else self.count

    @property
    def turn(self) -> Any:
        """See `mjxball.algorithms.base.EnvironmentBatch`."""
        return self.shards.cut(self._turns)

    def reset(self, key: Array) -> Any:
        """Sampled initial states of all environments, the same however they are cut into shards."""
        whole = self._worlds * self.shards.parts
        keys = self.shards.cut(jax.random.split(key, whole))
        if self._agents:
            fresh = jax.vmap(self.env.reset)(keys, self.shards.cut(jnp.arange(whole)))
            return self._agents.per_agent(fresh)
        return jax.vmap(self.env.reset)(keys)

    def staggered(self, states: Any, key: Array, episode_steps: int) -> Any:
        """`states` with random step counters, so that episodes do not end together."""
        steps = self.shards.cut(jax.random.randint(key, (self._worlds * self.shards.parts,), 0, episode_steps))
        if "steps" in states.info:
            dtype = states.info["steps"].dtype
            return states.replace(info={**states.info, "steps": steps.astype(dtype)})
        world = states.pipeline_state
        if "steps" in getattr(world, "_fields", ()):
            return states.replace(pipeline_state=world._replace(steps=steps))
        return states

    def begin(self, states: Any) -> Envs:
        """`states` with empty statistics."""
        zero = jnp.zeros(())
        totals = dict.fromkeys(states.metrics, zero)
        peaks = dict.fromkeys(states.metrics, jnp.zeros(self.count))
        return Envs(states, Statistics(zero, zero, totals, peaks))

    def rewritten(self, transform: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Environments:
        """See `mjxball.algorithms.base.EnvironmentBatch`."""
        other = copy.copy(self)
        other._step = transform(self.env.step)
        return other

    def restart(self, envs: Envs, key: Array, others: Bool[Array, " envs"] | None = None) -> Envs:
        """See `mjxball.algorithms.base.EnvironmentBatch`."""
        done = envs.states.done.astype(bool)
        ended = done if others is None else done | others

        def reset_ended(before: Any) -> Any:
            return self._mixed(ended, self.reset(key), before)

        if jax.default_backend() != "cpu":  # on a GPU the host would wait for the condition
            return envs._replace(states=reset_ended(envs.states))
        return envs._replace(states=jax.lax.cond(ended.any(), reset_ended, lambda before: before, envs.states))

    def _mixed(self, ended: Bool[Array, " envs"], fresh: Any, before: Any) -> Any:
        """States `fresh` where `ended`, else `before`."""
        agents = self._agents

        def where(condition: Array, new: Any, old: Any) -> Any:
            def one(new: Array, old: Array) -> Array:
                return jnp.where(condition.reshape((-1,) + (1,) * (old.ndim - 1)), new, old)

            return jax.tree.map(one, new, old)

        if not agents:
            return where(ended, fresh, before)
        worlds = where(ended[agents.first], fresh.pipeline_state, before.pipeline_state)
        per_agent = (states.replace(pipeline_state=()) for states in (fresh, before))
        return where(ended[agents.first][agents.world], *per_agent).replace(pipeline_state=worlds)

    def step(
        self, envs: Envs, action: Float[Array, "envs actions"], key: Array | None, fresh: Any = None
    ) -> tuple[Envs, Transition]:
        """See `mjxball.algorithms.base.EnvironmentBatch`."""
        before, agents = envs.states, self._agents
        if agents:
            after = agents.per_agent(self._step(agents.per_world(before), action[agents.table]))
        else:
            after = self._step(before, action)
        terminated = after.done * (1 - after.info["truncation"])
        totals = {name: values.sum() for name, values in after.metrics.items()}
        statistics = added(envs.statistics, Statistics(after.reward.mean(), terminated.sum(), totals, after.metrics))
        transition = Transition(before.obs, action, after.reward, terminated, after.obs, after.done)
        stepped = Envs(after, statistics)
        if fresh is not None:
            return stepped._replace(states=self._mixed(after.done.astype(bool), fresh, after)), transition
        return stepped if key is None else self.restart(stepped, key), transition

    def over_shards(self, statistics: Statistics) -> Statistics:
        """Statistics over all shards; `peaks` remain those of each shard's environments."""
        total = self.shards.total
        return statistics._replace(
            reward=self.shards.mean(statistics.reward), ended=total(statistics.ended), totals=total(statistics.totals)
        )
