"""What the trainer asks of a learning algorithm, and what it gives it. Nothing in `train/` knows which one runs."""

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


class Phase(NamedTuple):
    """What the environments are stepped for. Traced, so that one compiled program serves all phases."""

    random: Bool[Array | np.ndarray, ""]  # act uniformly at random and record, before anything is learnt
    evaluate: Bool[Array | np.ndarray, ""]  # act with the policy's mean; nothing is recorded or learnt

    @property
    def recording(self) -> Bool[Array | np.ndarray, ""]:
        """Whether what happens is remembered."""
        return ~self.evaluate

    @property
    def learning(self) -> Bool[Array | np.ndarray, ""]:
        """Whether the algorithm updates what it has learnt."""
        return ~(self.random | self.evaluate)


class Schedule(NamedTuple):
    """How the trainer runs an algorithm. Counted in environment steps, of all environments together."""

    total_steps: int
    num_envs: int
    warmup_steps: int  # with random actions
    num_evaluations: int


class PolicyNetwork(NamedTuple):
    """What is exported: a tanh-squashed network on normalised observations (`Network`). A pytree of arrays.

    With a GRU an observation holds its state behind the network's inputs, and an answer the next state behind the
    action.
    """

    layers: Any  # Flax's {"hidden_0": {"kernel", "bias"}, ...}; the last gives mean and deviation of the action
    # and perhaps a GRU below them, "gru": {"kernel", "recurrent", "bias"}
    mean: Float[Array, " n"]  # of the observations
    deviation: Float[Array, " n"]
    mask: Float[Array, " n"]  # 0 for a slot that the policy does not use, else 1

    def __call__(self, observation: Float[Array, "... n"]) -> Float[Array, "... answer"]:
        """Mean action in [-1, 1] at `observation`, and the next state of a GRU."""
        return self.network()(observation[..., : self.inputs + self.units])

    def outputs(self, observation: Float[Array, "... n"]) -> tuple[Array, Array]:
        """(mean and deviation of the action before tanh, the GRU's next state)."""
        value, state = self.network(deviations=True).outputs(observation[..., : self.inputs + self.units])
        return value, jnp.asarray(state)

    @property
    def inputs(self) -> int:
        """Of the network, a GRU's state not counted."""
        return self.layers["gru"]["kernel"].shape[-2] if "gru" in self.layers else self.mean.shape[-1]

    @property
    def units(self) -> int:
        """Of the GRU, 0 without one."""
        return self.layers["gru"]["recurrent"].shape[-2] if "gru" in self.layers else 0

    def network(self, deviations: bool = False) -> Network:
        """As a policy file has it, without the `deviations` of the action."""
        names = sorted(self.layers.keys() - {"gru"}, key=lambda name: int(name.rsplit("_", 1)[1]))
        weights, biases = ([self.layers[name][part] for name in names] for part in ("kernel", "bias"))
        columns, own, gru = weights[-1].shape[-1], slice(self.inputs), self.layers.get("gru")
        told = slice(columns if deviations else columns // 2)
        return Network(
            weights=(*weights[:-1], weights[-1][..., told]),
            biases=(*biases[:-1], biases[-1][..., told]),
            mean=self.mean[..., own],
            scale=(self.mask[..., own] / self.deviation[..., own]),
            gru=None if gru is None else (gru["kernel"], gru["recurrent"], gru["bias"]),
        )


class Shards(NamedTuple):
    """One learner's environments, memory and batches cut into `parts` equal parts along a mapped axis."""

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


class Transition(NamedTuple):
    """One step of all environments of a shard, before any of them starts anew."""

    observation: Float[Array, "envs n"]
    action: Float[Array, "envs actions"]  # in [-1, 1]
    reward: Float[Array, " envs"]
    terminated: Float[Array, " envs"]  # 1. if the episode ended other than by the time limit
    next_observation: Float[Array, "envs n"]
    done: Float[Array, " envs"]  # 1. if the episode ended


class Environments(Protocol):
    """Environments side by side, as an algorithm sees them (`mjxball.train.program`)."""

    count: int  # of this shard
    observation_size: int
    action_size: int  # with the next state of a recurrent policy
    recurrent_slots: slice  # of an observation: the state of a recurrent policy; empty if it has none
    policy_mask: Any  # (n,) 1 for what the policy may use of an observation, else 0
    critic_mask: Any  # (n,) the same for what is needed in training only
    turn: Any  # (count,) in which of several turns, again and again, each is to start anew where all do so in turn
    shards: Shards
    smooth: bool  # whether all of a step has a gradient backwards, also what no action has a part in

    def restart(self, envs: Any, key: Array, others: Bool[Array, " envs"] | None = None) -> Any:
        """Those of `envs` whose episode ended start anew, at states drawn with `key`, and so do `others`."""
        ...

    def rewritten(self, transform: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Environments:
        """The same environments, which `transform` of the step of a single one steps, such as `jax.vmap`."""
        ...

    def drawn(self, envs: Any, key: Array) -> Any:
        """States to start anew from, one for each of `envs`, for `step`."""
        ...

    def step(
        self, envs: Any, action: Float[Array, "envs actions"], key: Array | None, fresh: Any = None
    ) -> tuple[Any, Transition]:
        """Step `envs` with `action`, then `restart` them; with a `key` of None those that ended go on.

        Those that ended begin at `fresh` if it is given, which spares a draw at every step.
        """
        ...


class Algorithm(Protocol):
    """A learning algorithm. All its functions are pure, and can be jitted and vmapped.

    One that is done on a CPU before it could be compiled well, or at all for a GPU, may say so: `prefers_cpu = True`.
    One whose products of matrices are large enough for a GPU's cuBLAS: `large_products = True`.
    """

    schedule: Schedule
    metrics: tuple[str, ...]  # names of what `update` reports
    engines: tuple[str, ...]  # physics engines that it works with, the default first
    collect_keys: int  # random keys that `collect` takes
    update_keys: int  # and that `update` takes
    steps_per_collect: int  # steps of every environment in one `collect`

    def __init__(self, config: Config, environments: Environments): ...

    def init(self, key: Array) -> Any:
        """What is known at the start: any pytree of arrays without empty ones."""
        ...

    def collect(self, state: Any, envs: Any, keys: Any, phase: Phase) -> tuple[Any, Any]:
        """Step the environments and remember what is to be learnt from: (state, envs)."""
        ...

    def update(
        self, state: Any, keys: Any, progress: Float[Array, ""], phase: Phase
    ) -> tuple[Any, dict[str, Float[Array, ""]]]:
        """Learn, if `phase.learning`: (state, `metrics`). `progress` is the share of training done, 0 to 1.

        `train.py` calls it then alone; in a whole program (`mjxball.train.train`) it must leave `state` as it is else.
        """
        ...

    def policy(self, state: Any) -> PolicyNetwork:
        """The policy to evaluate and export."""
        ...

    def partition(self, whole: Any, split: Any) -> Any:
        """What `init` returns (or parts of it) with `split` for arrays cut by environments, `whole` for the others."""
        ...

    def check_parts(self, parts: int) -> None:
        """Raise InputError unless the work can be cut into `parts`."""
        ...
