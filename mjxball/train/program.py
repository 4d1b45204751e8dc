"""The training program: batched environments, and collect and update, separately or as one compiled function."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball import config as configs
from mjxball.algorithms import ALGORITHMS
from mjxball.algorithms.base import Algorithm, PolicyNetwork, Schedule, Shards, TrainingPhase, Transition
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.scalar_form import scalar_form
from mjxball.train.extensions import DEFAULTS, Extensions, find, is_pair, make_env

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

MATMUL_PRECISION = "highest"  # float32 throughout: by default GPUs round products to TF32
EVALUATION_SECONDS = 16.0  # of which the last half counts as steady state
EVALUATION_SEED = 20_261_121  # folded into the key, so that no seed trains on the evaluation's environments


class Statistics(NamedTuple):
    """Sums over the steps of one call of `TrainingProgram.advance`."""

    reward: Float[Array, ""]  # mean reward per step, summed over steps
    ended: Float[Array, ""]  # episodes terminated
    totals: dict[str, Float[Array, ""]]  # each of the environment's metrics, summed over environments and steps
    peaks: dict[str, Float[Array, " envs"]]  # maximum of each metric over steps


def joined(first: Statistics, second: Statistics) -> Statistics:
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
    """`count` environments on each shard; see `mjxball.algorithms.base.Environments`.

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
        self.smooth = is_pair(env)
        # `scalar_form` halves the time of a closed-form step on a CPU. MJX gains nothing, and compiles longer.
        closed = self.smooth and env.backend == "newton-euler" and jax.default_backend() == "cpu"
        self._step = (scalar_form if closed else jax.vmap)(env.step)
        sizes = getattr(env, "team_sizes", None)
        self._agents = Agents(sizes, env.config.plant.count - 1, count) if sizes else None
        self.turn = self._agents.turn if self._agents else np.arange(count)

    @property
    def _worlds(self) -> int:
        return self._agents.worlds if self._agents else self.count

    def reset(self, key: Array) -> Any:
        """Sampled initial states of all environments."""
        keys = jax.random.split(self.shards.own(key), self._worlds)
        if self._agents:
            fresh = jax.vmap(self.env.reset)(keys, jnp.arange(self._worlds))
            return self._agents.per_agent(fresh)
        return jax.vmap(self.env.reset)(keys)

    def staggered(self, states: Any, key: Array, episode_steps: int) -> Any:
        """`states` with random step counters, so that episodes do not end together."""
        steps = jax.random.randint(self.shards.own(key), (self._worlds,), 0, episode_steps)
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
        """See `mjxball.algorithms.base.Environments`."""
        other = copy.copy(self)
        other._step = transform(self.env.step)
        return other

    def sampled(self, envs: Envs, key: Array) -> Any:
        """See `mjxball.algorithms.base.Environments`."""
        return self.reset(key)

    def restart(self, envs: Envs, key: Array, others: Bool[Array, " envs"] | None = None) -> Envs:
        """See `mjxball.algorithms.base.Environments`."""
        done = envs.states.done.astype(bool)
        ended = done if others is None else done | others

        def reset_ended(before: Any) -> Any:
            return self._mixed(ended, self.sampled(envs, key), before)

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
        """See `mjxball.algorithms.base.Environments`."""
        before, agents = envs.states, self._agents
        if agents:
            after = agents.per_agent(self._step(agents.per_world(before), action[agents.table]))
        else:
            after = self._step(before, action)
        terminated = after.done * (1 - after.info["truncation"])
        totals = {name: values.sum() for name, values in after.metrics.items()}
        statistics = joined(envs.statistics, Statistics(after.reward.mean(), terminated.sum(), totals, after.metrics))
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


class Mode(NamedTuple):
    """Number of steps and phase of a call of `TrainingProgram.advance`. Both are traced: one executable serves all."""

    steps: Int[Array | np.ndarray, ""]  # of each environment
    phase: TrainingPhase


def warmup(steps: int) -> Mode:
    """Mode with random actions, which are recorded."""
    return _mode(steps, random=True, evaluate=False)


def train(steps: int) -> Mode:
    """Mode with actions sampled from the policy, which are recorded, and updates."""
    return _mode(steps, random=False, evaluate=False)


def evaluate(steps: int) -> Mode:
    """Mode with the policy's mean action. Nothing is recorded or learnt."""
    return _mode(steps, random=False, evaluate=True)


def _mode(steps: int, random: bool, evaluate: bool) -> Mode:
    # NumPy scalars, because JAX compiles a program to create each of its own.
    return Mode(np.asarray(steps, np.int32), TrainingPhase(np.asarray(random), np.asarray(evaluate)))


class TrainState(NamedTuple):
    """Everything needed to continue a run exactly."""

    algorithm: Any  # the algorithm's state
    envs: Any  # brax State of all environments
    key: Array
    steps: Int[Array, ""]  # environment steps recorded


class TrainingProgram:
    """Training of one follower: `create(key)` returns a state, `advance(state, mode)` the next. Both can be vmapped.

    `overrides` maps config paths to values, possibly traced arrays, in which members of a population differ. With
    `shards` every function works on one part and must run under `jax.shard_map` over their axis.
    """

    def __init__(
        self,
        config: Config,
        physics: str,
        overrides: Mapping[str, Any] | None = None,
        shards: Shards | None = None,
        extensions: Extensions = DEFAULTS,
    ):
        for path, value in (overrides or {}).items():
            config = configs.replace(config, path, value)
        self.config, self._shards = config, shards or Shards()
        with jax.default_matmul_precision(MATMUL_PRECISION):  # as in training, which reuses the traces of checks
            self.env = make_env(extensions, config, physics)
        make: Any = extensions.algorithm or find(ALGORITHMS["sac"], "--algorithm")
        # The algorithm sets the number of environments, and is then made again with this shard's part of them.
        sizes = getattr(self.env, "team_sizes", None)
        fewest = sum(sizes) - len(sizes) if sizes else 1
        schedule: Schedule = make(config, Environments(self.env, fewest, Shards())).schedule
        self.environments = Environments(self.env, schedule.num_envs // self._shards.parts, self._shards)
        self.algorithm: Algorithm = make(config, self.environments)
        self.schedule = schedule

    def create(self, key: Array) -> TrainState:
        """Initial training state."""
        return self.begin(key)._replace(envs=self.episodes(key, np.asarray(True)))

    def begin(self, key: Array) -> TrainState:
        """Initial training state without environments."""
        learner_key, _, _, key = jax.random.split(key, 4)
        return TrainState(algorithm=self.algorithm.init(learner_key), envs=(), key=key, steps=jnp.zeros((), jnp.int32))

    def episodes(self, key: Array, training: Bool[Array | np.ndarray, ""]) -> Any:
        """Initial states of all environments, of `create(key)` if `training`, else of every evaluation with `key`.

        Episodes of training are staggered, so that they do not end together.
        """
        _, env_key, stagger_key, _ = jax.random.split(key, 4)
        reset_key = jnp.where(training, env_key, jax.random.fold_in(key, EVALUATION_SEED))
        envs = self.environments.reset(reset_key)
        staggered = self.environments.staggered(envs, stagger_key, self.config.timing.episode_steps)
        return jax.tree.map(lambda new, old: jnp.where(training, new, old), staggered, envs)

    def advance(self, state: TrainState, mode: Mode) -> tuple[TrainState, Statistics, dict[str, Float[Array, ""]]]:
        """Step all environments `mode.steps` times (rounded up to whole collections), and learn.

        Returns the state, sums over all steps, and the metrics of the algorithm's last update. `Population` compiles
        `collect` and `update` separately instead, which takes less time in parallel.
        """

        def body(_: Array, carry: Any) -> Any:
            state, statistics, _ = carry
            state, statistics, keys = self.collect(state, statistics, mode.phase)
            state, metrics = self.update(state, keys, mode.phase)
            return state, statistics, metrics

        metrics = dict.fromkeys(self.algorithm.metrics, jnp.zeros(()))
        start = (state, self.environments.begin(state.envs).statistics, metrics)
        rounds = -(-mode.steps // self.algorithm.steps_per_collect)
        return jax.lax.fori_loop(0, rounds, body, start)

    def collect(
        self, state: TrainState, statistics: Statistics, phase: TrainingPhase
    ) -> tuple[TrainState, Statistics, Array]:
        """One collection of the algorithm: (state, updated `statistics`, keys for the following `update`)."""
        algorithm = self.algorithm
        # One split for all keys, because each split is several kernels to compile and launch.
        keys = jax.random.split(state.key, algorithm.collect_keys + algorithm.update_keys + 1)
        envs = self.environments.begin(state.envs)
        with jax.default_matmul_precision(MATMUL_PRECISION):
            learnt, envs = algorithm.collect(state.algorithm, envs, list(keys[: algorithm.collect_keys]), phase)
        taken = self.schedule.num_envs * algorithm.steps_per_collect
        steps = state.steps + jnp.where(phase.recording, taken, 0)
        collected = self.environments.over_shards(envs.statistics)
        return TrainState(learnt, envs.states, keys[-1], steps), joined(statistics, collected), keys

    def update(
        self, state: TrainState, keys: Array, phase: TrainingPhase
    ) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """One update of the algorithm, with the `keys` of the preceding `collect`: (state, the algorithm's metrics)."""
        progress = jnp.minimum(state.steps / self.schedule.total_steps, 1.0)
        update_keys = list(keys[self.algorithm.collect_keys : -1])
        with jax.default_matmul_precision(MATMUL_PRECISION):
            learnt, metrics = self.algorithm.update(state.algorithm, update_keys, progress, phase)
        return state._replace(algorithm=learnt), self._shards.mean(metrics)

    def evaluation_envs(self, key: Array) -> Any:
        """Initial states of all environments, the same for every evaluation with `key`."""
        return self.episodes(key, np.asarray(False))

    def policy(self, state: TrainState) -> PolicyNetwork:
        """The policy to evaluate and export."""
        return self.algorithm.policy(state.algorithm)

    @property
    def evaluation_steps(self) -> int:
        """Steps of an evaluation, in whole collections: `EVALUATION_SECONDS` of ours, an episode of a foreign one."""
        timing, window = self.config.timing, self.algorithm.steps_per_collect
        steps = timing.episode_steps
        if is_pair(self.env):
            steps = min(round(EVALUATION_SECONDS / timing.control_period), steps)
        return max(steps // window, 1) * window

    def evaluated_return(self, reward: Any, ended: Any) -> Any:
        """Return of an episode, from `Statistics.reward` and `.ended` of an evaluation.

        In our environment, whose rewards are costs, it is the mean reward times the steps of an episode. In a foreign
        one, which may reward survival, that is divided by the number of episodes begun in the time of one.
        """
        episodes = self.config.timing.episode_steps / self.evaluation_steps
        begun = 1 if is_pair(self.env) else 1 + episodes * ended / self.schedule.num_envs
        return episodes * reward / begun

    @property
    def total_rounds(self) -> int:
        """Steps of each environment in the whole training."""
        return math.ceil(self.schedule.total_steps / self.schedule.num_envs)

    @property
    def warmup_rounds(self) -> int:
        """Steps of each environment with random actions; part of `total_rounds`."""
        return math.ceil(self.schedule.warmup_steps / self.schedule.num_envs)
