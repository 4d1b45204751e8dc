"""Interface between the trainer and a learning algorithm. Nothing in `train/` depends on which algorithm runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball.config import Config
from mjxball.control.network import Network

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class TrainingPhase(NamedTuple):
    """Purpose of a block of environment steps. The fields are traced, so one compiled program serves all phases."""

    random: Bool[Array | np.ndarray, ""]  # act uniformly at random and record, before learning starts
    evaluate: Bool[Array | np.ndarray, ""]  # act with the policy's mean; nothing is recorded or learnt

    @property
    def recording(self) -> Bool[Array | np.ndarray, ""]:
        """Whether transitions are stored."""
        return ~self.evaluate

    @property
    def learning(self) -> Bool[Array | np.ndarray, ""]:
        """Whether the algorithm updates its parameters."""
        return ~(self.random | self.evaluate)


class Schedule(NamedTuple):
    """Length of a training run. Steps are counted over all environments together."""

    total_steps: int
    num_envs: int
    warmup_steps: int  # with random actions
    num_evaluations: int


class PolicyNetwork(NamedTuple):
    """Exported policy: a tanh-squashed network on normalised observations (`Network`). A pytree of arrays.

    With a GRU, its state follows the network's inputs in an observation, and its next state follows the action in the
    output.
    """

    layers: Any  # Flax's {"hidden_0": {"kernel", "bias"}, ...}; the last gives mean and deviation of the action
    # With a GRU in front of them also "gru": {"kernel", "recurrent", "bias"}.
    mean: Float[Array, " n"]  # of the observations
    deviation: Float[Array, " n"]
    mask: Float[Array, " n"]  # 1 for entries that the policy uses, else 0

    def __call__(self, observation: Float[Array, "... n"]) -> Float[Array, "... answer"]:
        """Mean action in [-1, 1] at `observation`, followed by the next state of a GRU."""
        return self.network()(observation[..., : self.inputs + self.units])

    def outputs(self, observation: Float[Array, "... n"]) -> tuple[Array, Array]:
        """(mean and deviation of the action before tanh, the GRU's next state)."""
        value, state = self.network(deviations=True).outputs(observation[..., : self.inputs + self.units])
        return value, jnp.asarray(state)

    @property
    def inputs(self) -> int:
        """Number of the network's inputs, without a GRU's state."""
        return self.layers["gru"]["kernel"].shape[-2] if "gru" in self.layers else self.mean.shape[-1]

    @property
    def units(self) -> int:
        """Number of units of the GRU, 0 without one."""
        return self.layers["gru"]["recurrent"].shape[-2] if "gru" in self.layers else 0

    def network(self, deviations: bool = False) -> Network:
        """The network as a policy file stores it. With `deviations` it also outputs the action's deviations."""
        names = sorted(self.layers.keys() - {"gru"}, key=lambda name: int(name.rsplit("_", 1)[1]))
        weights, biases = ([self.layers[name][part] for name in names] for part in ("kernel", "bias"))
        columns, inputs, gru = weights[-1].shape[-1], slice(self.inputs), self.layers.get("gru")
        outputs = slice(columns if deviations else columns // 2)
        return Network(
            weights=(*weights[:-1], weights[-1][..., outputs]),
            biases=(*biases[:-1], biases[-1][..., outputs]),
            mean=self.mean[..., inputs],
            scale=(self.mask[..., inputs] / self.deviation[..., inputs]),
            gru=None if gru is None else (gru["kernel"], gru["recurrent"], gru["bias"]),
        )


class Shards(NamedTuple):
    """Division of one learner's environments, replay and batches into `parts` equal parts along a mapped axis.

    Parts that are not `joined` do not exchange anything: means and sums are those of one part, which the host averages
    (`Population`). So it is on the devices of one CPU, where XLA's collectives can wait for each other for ever: they
    block the threads that the other device needs.
    """

    axis: str | None = None
    parts: int = 1
    joined: bool = True

    def own(self, key: Array) -> Array:
        """A key unique to this shard, derived from a `key` that all shards share."""
        return jax.random.fold_in(key, jax.lax.axis_index(self.axis)) if self.axis else key

    def cut(self, whole: Any) -> Any:
        """This shard's part of `whole`, whose first axis runs over all shards."""
        if not self.axis:
            return whole
        count = len(whole) // self.parts
        return jax.lax.dynamic_slice_in_dim(jnp.asarray(whole), jax.lax.axis_index(self.axis) * count, count)

    def gathered(self, part: Array) -> Array:
        """The parts of all shards that are joined, along the first axis."""
        return jax.lax.all_gather(part, self.axis, tiled=True) if self.axis and self.joined else part

    def mean(self, value: Any) -> Any:
        """Mean over the shards."""
        return jax.lax.pmean(value, self.axis) if self.axis and self.joined else value

    def total(self, value: Any) -> Any:
        """Sum over the shards."""
        return jax.lax.psum(value, self.axis) if self.axis and self.joined else value


class Transition(NamedTuple):
    """One step of all environments of a shard, before any reset."""

    observation: Float[Array, "envs n"]
    action: Float[Array, "envs actions"]  # in [-1, 1]
    reward: Float[Array, " envs"]
    terminated: Float[Array, " envs"]  # 1. if the episode ended for another reason than the time limit
    next_observation: Float[Array, "envs n"]
    done: Float[Array, " envs"]  # 1. if the episode ended


class EnvironmentBatch(Protocol):
    """Batch of environments as an algorithm sees it, implemented in `mjxball.train.environments`."""

    count: int  # of this shard
    observation_size: int
    action_size: int  # with the next state of a recurrent policy
    recurrent_slots: slice  # entries of an observation that hold a recurrent policy's state; empty without one
    policy_mask: Any  # (n,) 1 for entries of an observation that the policy may use, else 0
    critic_mask: Any  # (n,) 1 for entries that critics may use, else 0
    turn: Any  # (count,) integer offset of each environment, to stagger the starts of episodes; traced in a shard
    shards: Shards
    smooth: bool  # whether all outputs of a step have a reverse-mode gradient, also those independent of the action

    def restart(self, envs: Any, key: Array, others: Bool[Array, " envs"] | None = None) -> Any:
        """Reset those of `envs` whose episode ended, and `others`, to initial states sampled with `key`."""
        ...

    def rewritten(self, transform: Callable[[Callable[..., Any]], Callable[..., Any]]) -> EnvironmentBatch:
        """The same environments, with the step of a single one batched by `transform`, such as `jax.vmap`."""
        ...

    def reset(self, key: Array) -> Any:
        """Sampled initial states of all environments, which `step` takes for those that ended."""
        ...

    def step(
        self, envs: Any, action: Float[Array, "envs actions"], key: Array | None, fresh: Any = None
    ) -> tuple[Any, Transition]:
        """Step `envs` with `action`, then reset those whose episode ended.

        Initial states are sampled with `key`, or taken from `fresh` (of `reset`), which avoids it at every step.
        With neither, ended episodes go on.
        """
        ...


class Algorithm(Protocol):
    """A learning algorithm. All its functions are pure, and can be jitted and vmapped.

    Optional attributes: `prefers_cpu`, true or a function of configuration and number of members, if training on a CPU
    is faster, or no GPU program can be; `large_products = True` if its matrix products are large enough for a GPU's
    cuBLAS; `long_loops = True` if it loops over many small operations; `averaged`, names of the fields of its state
    that are means over environments after `collect`, so that these can be cut over the devices of a CPU (`Shards`).
    """

    schedule: Schedule
    metrics: tuple[str, ...]  # names of the values that `update` reports
    engines: tuple[str, ...]  # physics engines that it works with, the default first
    collect_keys: int  # number of random keys that `collect` takes
    update_keys: int  # number of random keys that `update` takes
    steps_per_collect: int  # steps of every environment in one `collect`

    def __init__(self, config: Config, environments: EnvironmentBatch): ...

    def init(self, key: Array) -> Any:
        """Initial state: any pytree of arrays, none of them empty."""
        ...

    def collect(self, state: Any, envs: Any, keys: Any, phase: TrainingPhase) -> tuple[Any, Any]:
        """Step the environments and store in the state what `update` learns from: (state, envs)."""
        ...

    def update(
        self, state: Any, keys: Any, progress: Float[Array, ""], phase: TrainingPhase
    ) -> tuple[Any, dict[str, Float[Array, ""]]]:
        """Learn if `phase.learning`: (state, values of `metrics`). `progress` is the share of training done, 0 to 1.

        `train.py` calls it in that phase only. `mjxball.train.train` calls it in every phase, so it must return `state`
        unchanged in the others.
        """
        ...

    def policy(self, state: Any) -> PolicyNetwork:
        """The policy to evaluate and export."""
        ...

    def partition(self, whole: Any, split: Any) -> Any:
        """A prefix of `init`'s pytree: `split` for arrays that are cut by environments, `whole` for the others."""
        ...

    def check_parts(self, parts: int) -> None:
        """Raise InputError unless the work can be cut into `parts` equal parts."""
        ...
