"""The training program: batched environments, and collect and update, separately or as one compiled function."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball import config as configs
from mjxball.algorithms import ALGORITHMS
from mjxball.algorithms.base import Algorithm, PolicyNetwork, Schedule, Shards, TrainingPhase
from mjxball.config import Config
from mjxball.train.environments import Environments, Statistics, added
from mjxball.train.extensions import DEFAULTS, Extensions, find, is_transport_env, make_env

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

MATMUL_PRECISION = "highest"  # float32 throughout: by default GPUs round products to TF32
EVALUATION_SECONDS = 16.0  # of which the last half counts as steady state
EVALUATION_SEED = 20_261_121  # folded into the key, so that no seed trains on the evaluation's environments


class Mode(NamedTuple):
    """Number of steps and phase of a call of `Population.advance`. The phase is traced: one executable serves all."""

    steps: Int[Array | np.ndarray, ""]  # of each environment
    phase: TrainingPhase


def warmup_mode(steps: int) -> Mode:
    """Mode with random actions, which are recorded."""
    return _mode(steps, random=True, evaluate=False)


def train_mode(steps: int) -> Mode:
    """Mode with actions sampled from the policy, which are recorded, and updates."""
    return _mode(steps, random=False, evaluate=False)


def evaluate_mode(steps: int) -> Mode:
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
    total: Float[Array, ""]  # of the whole training, by which learning rates fall


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
        learner, total = self.algorithm.init(learner_key), jnp.asarray(self.schedule.total_steps, jnp.float32)
        return TrainState(learner, (), key, jnp.zeros((), jnp.int32), total)

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
        return TrainState(learnt, envs.states, keys[-1], steps, state.total), added(statistics, collected), keys

    def update(
        self, state: TrainState, keys: Array, phase: TrainingPhase
    ) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
        """One update of the algorithm, with the `keys` of the preceding `collect`: (state, the algorithm's metrics)."""
        progress = jnp.minimum(state.steps / state.total, 1.0)
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
        if is_transport_env(self.env):
            steps = min(round(EVALUATION_SECONDS / timing.control_period), steps)
        return max(steps // window, 1) * window

    def evaluated_return(self, reward: Any, ended: Any) -> Any:
        """Return of an episode, from `Statistics.reward` and `.ended` of an evaluation.

        In our environment, whose rewards are costs, it is the mean reward times the steps of an episode. In a foreign
        one, which may reward survival, that is divided by the number of episodes begun in the time of one.
        """
        episodes = self.config.timing.episode_steps / self.evaluation_steps
        begun = 1 if is_transport_env(self.env) else 1 + episodes * ended / self.schedule.num_envs
        return episodes * reward / begun

    @property
    def total_steps_each(self) -> int:
        """Steps of each environment in the whole training."""
        return math.ceil(self.schedule.total_steps / self.schedule.num_envs)

    @property
    def warmup_steps_each(self) -> int:
        """Steps of each environment with random actions; part of `total_rounds`."""
        return math.ceil(self.schedule.warmup_steps / self.schedule.num_envs)
