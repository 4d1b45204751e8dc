"""The training program: collect, record and update in one compiled function that also prefills and evaluates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.env import CoupledPairEnv
from mjxball.quiet import import_brax_training
from mjxball.train import replay, sac

Array = Any
statistics = import_brax_training().running_statistics
MATMUL_PRECISION = "highest"  # float32 throughout: GPUs would else round products to TF32


class Mode(NamedTuple):
    """What a call of `Program.advance` does; all traced, so that one executable serves every phase."""

    steps: Array  # steps of all worlds
    updates: Array  # gradient updates after each step, at most the configuration's
    random: Array  # act uniformly at random
    deterministic: Array  # act with the averaged policy's mean
    record: Array  # write transitions to the replay and update the normaliser


def prefill(steps: int) -> Mode:
    """Random actions, recorded."""
    return _mode(steps, 0, random=True, deterministic=False, record=True)


def train(steps: int, updates: int) -> Mode:
    """Sampled actions, recorded, with updates."""
    return _mode(steps, updates, random=False, deterministic=False, record=True)


def evaluate(steps: int) -> Mode:
    """The averaged policy's mean; nothing is recorded or learnt."""
    return _mode(steps, 0, random=False, deterministic=True, record=False)


def _mode(steps: int, updates: int, random: bool, deterministic: bool, record: bool) -> Mode:
    # NumPy's: each of JAX's own would compile a program to make it.
    return Mode(*(np.asarray(n, np.int32) for n in (steps, updates)), *map(np.asarray, (random, deterministic, record)))


class TrainState(NamedTuple):
    """Everything needed to continue a run exactly."""

    learner: sac.Learner
    replay: replay.Replay
    worlds: Any  # brax State of all worlds
    key: Array
    steps: Array  # () environment steps recorded


class Tally(NamedTuple):
    """Sums over the steps of one call of `Program.advance`."""

    reward: Array  # mean reward per step, summed over steps
    steady_error: Array  # |e_o| summed over worlds and steps in steady state [m]
    steady: Array  # their number
    peak: Array  # (worlds,) largest |e_o| in steady state [m]
    ended: Array  # episodes terminated
    diverged: Array  # worlds that diverged
    tilt_error: Array  # mean square of the roll and pitch commands' difference to the leader's, summed [rad2]
    vertical_error: Array  # the same of the vertical accelerations [m2/s4]
    losses: sac.Losses  # of the last update


class Shards(NamedTuple):
    """One follower's worlds, replay and batches cut into `parts` equal parts along a mapped axis (data parallel)."""

    axis: str | None = None
    parts: int = 1

    def own(self, key: Array) -> Array:
        """A key of this shard alone, from one that all shards share."""
        return jax.random.fold_in(key, jax.lax.axis_index(self.axis)) if self.axis else key

    def mean(self, value: Any) -> Any:
        """Mean over the shards."""
        return jax.lax.pmean(value, self.axis) if self.axis else value

    def total(self, value: Any) -> Any:
        """Sum over the shards."""
        return jax.lax.psum(value, self.axis) if self.axis else value


class Program:
    """`create(key)` makes the state, `advance(state, mode)` moves it on; both jittable and vmappable.

    `overrides` maps config paths to values, arrays included, so that a population can differ in them. With
    `shards` every function works on one part and must run under `jax.shard_map` over their axis.
    """

    def __init__(
        self, config: Config, physics: str, overrides: Mapping[str, Any] | None = None, shards: Shards | None = None
    ):
        for path, value in (overrides or {}).items():
            config = configs.replace(config, path, value)
        self.config = config
        self.env = CoupledPairEnv(config, physics)
        self.sizes = (self.env.observation_size, self.env.action_size)
        self.networks = sac.make_networks(config.sac, self.env.input_mask, self.sizes[1], self.env.critic_mask)
        self._shards = shards or Shards()
        self._worlds = config.sac.worlds // self._shards.parts
        self._update = sac.make_update(self.networks, config.sac, self.sizes[1], self._shards.mean)
        self._step = jax.vmap(self.env.step)

    def create(self, key: Array) -> TrainState:
        """A fresh training state; the worlds' episodes are staggered so that they do not end together."""
        learner_key, world_key, stagger_key, key = jax.random.split(key, 4)
        limits = self.config.sac
        worlds = self.fresh_worlds(world_key, self._reach(jnp.zeros(()), jnp.ones((), bool)))
        spread = jax.random.randint(self._shards.own(stagger_key), (self._worlds,), 0, self.config.timing.episode_steps)
        worlds = worlds.replace(pipeline_state=worlds.pipeline_state._replace(steps=spread))
        return TrainState(
            learner=sac.create(self.networks, limits, self.sizes[0], learner_key),
            replay=replay.create(limits.replay // self._shards.parts, self._worlds, *self.sizes),
            worlds=worlds,
            key=key,
            steps=jnp.zeros((), jnp.int32),
        )

    def fresh_worlds(self, key: Array, reach: Array | float = 1.0) -> Any:
        """All worlds, newly reset; `reach` as in `CoupledPairEnv.reset`."""
        keys = jax.random.split(self._shards.own(key), self._worlds)
        return jax.vmap(lambda one: self.env.reset(one, reach))(keys)

    def _reach(self, steps: Array, record: Array) -> Array | float:
        """How much of the CG's motion is drawn after so many `steps`; in evaluation all of it."""
        limits = self.config.sac
        if limits.curriculum == 0:
            return 1.0
        grown = jnp.clip(steps / (limits.curriculum * limits.steps), 0.0, 1.0)
        return jnp.where(record, grown, 1.0)

    def advance(self, state: TrainState, mode: Mode) -> tuple[TrainState, Tally]:
        """Step all worlds `mode.steps` times, with `mode.updates` gradient updates after each."""
        zero = jnp.zeros(())
        losses = sac.Losses(zero, zero, zero)
        tally = Tally(zero, zero, zero, jnp.zeros(self._worlds), zero, zero, zero, zero, losses)

        def body(_: Array, carry: tuple[TrainState, Tally]) -> tuple[TrainState, Tally]:
            # One draw for many keys: each draw is kernels to compile and to launch.
            *keys, key = jax.random.split(carry[0].key, 6)
            state, tally = self._collect(*carry, keys[:3], mode)
            state, tally = self._learn(state, tally, keys[3:], mode)
            return state._replace(key=key), tally

        with jax.default_matmul_precision(MATMUL_PRECISION):
            state, tally = jax.lax.fori_loop(0, mode.steps, body, (state, tally))
        return state, self._over_shards(tally)

    def _over_shards(self, tally: Tally) -> Tally:
        """The tally of all shards together; `peak` stays each shard's own worlds."""
        mean, total = self._shards.mean, self._shards.total
        return tally._replace(
            reward=mean(tally.reward),
            steady_error=total(tally.steady_error),
            steady=total(tally.steady),
            ended=total(tally.ended),
            diverged=total(tally.diverged),
            tilt_error=mean(tally.tilt_error),
            vertical_error=mean(tally.vertical_error),
            losses=mean(tally.losses),
        )

    def _act(self, learner: sac.Learner, seen: Array, keys: Sequence[Array], mode: Mode) -> Array:
        sample_key, random_key = map(self._shards.own, keys)
        policy = jax.tree.map(
            lambda mean, new: jnp.where(mode.deterministic, mean, new), learner.average, learner.policy
        )
        parameters = self.networks.policy_network.apply(learner.normaliser, policy, seen)
        distribution = self.networks.parametric_action_distribution
        sampled = distribution.sample(parameters, sample_key)
        uniform = jax.random.uniform(random_key, sampled.shape, minval=-1.0, maxval=1.0)
        chosen = jnp.where(mode.random, uniform, sampled)
        return jnp.where(mode.deterministic, distribution.mode(parameters), chosen)

    def _collect(self, state: TrainState, tally: Tally, keys: Sequence[Array], mode: Mode) -> tuple[TrainState, Tally]:
        worlds = state.worlds
        action = self._act(state.learner, worlds.obs, keys[:2], mode)
        after = self._step(worlds, action)
        terminated = after.done * (1 - after.info["truncation"])
        transitions = replay.Transitions(worlds.obs, action, after.reward, 1 - terminated, after.obs, after.done)
        fresh = self.fresh_worlds(keys[2], self._reach(state.steps, mode.record))

        def reset_if_done(new: Array, old: Array) -> Array:
            done = after.done.astype(bool).reshape((-1,) + (1,) * (old.ndim - 1))
            return jnp.where(done, new, old)

        normaliser = statistics.update(state.learner.normaliser, worlds.obs, pmap_axis_name=self._shards.axis)
        normaliser = jax.tree.map(
            lambda new, old: jnp.where(mode.record, new, old), normaliser, state.learner.normaliser
        )
        metrics = after.metrics
        moved = TrainState(
            learner=state.learner._replace(normaliser=normaliser),
            replay=replay.insert(state.replay, transitions, mode.record),
            worlds=jax.tree.map(reset_if_done, fresh, after),
            key=state.key,
            steps=state.steps + jnp.where(mode.record, self.config.sac.worlds, 0),
        )
        return moved, tally._replace(
            reward=tally.reward + after.reward.mean(),
            steady_error=tally.steady_error + metrics["steady_error"].sum(),
            steady=tally.steady + metrics["steady"].sum(),
            peak=jnp.maximum(tally.peak, metrics["steady_error"]),
            ended=tally.ended + terminated.sum(),
            diverged=tally.diverged + metrics["diverged"].sum(),
            tilt_error=tally.tilt_error + metrics["tilt_error"].mean(),
            vertical_error=tally.vertical_error + metrics["vertical_error"].mean(),
        )

    def _sample(self, buffer: replay.Replay, draws: Array) -> replay.Transitions:
        limits = self.config.sac
        return replay.sample(buffer, draws, self._worlds, *self.sizes, limits.return_steps, limits.discount)

    def _learn(self, state: TrainState, tally: Tally, keys: Sequence[Array], mode: Mode) -> tuple[TrainState, Tally]:
        limits = self.config.sac
        progress = jnp.minimum(state.steps / limits.steps, 1.0)
        rate = 1.0 + (limits.learning_rate_end - 1.0) * progress
        draws_key, update_key = map(self._shards.own, keys)
        draws = jax.random.bits(draws_key, (limits.updates, limits.batch // self._shards.parts), jnp.uint32)
        update_keys = jax.random.split(update_key, (limits.updates, 3))

        def update(number: Array, carry: tuple[sac.Learner, sac.Losses]) -> tuple[sac.Learner, sac.Losses]:
            batch = self._sample(state.replay, draws[number])
            moved, losses = self._update(carry[0], batch, update_keys[number], rate)
            due, last = carry[0].updates % limits.policy_delay == 0, carry[1]
            policy, entropy = (jnp.where(due, *pair) for pair in zip(losses[1:], last[1:], strict=True))
            return moved, sac.Losses(losses.critic, policy, entropy)

        updates = jnp.minimum(mode.updates, limits.updates)
        learner, losses = jax.lax.fori_loop(0, updates, update, (state.learner, tally.losses))
        return state._replace(learner=learner), tally._replace(losses=losses)
