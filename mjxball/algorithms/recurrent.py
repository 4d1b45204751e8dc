"""Gated recurrent unit (GRU) in front of a policy's layers: initial weights, and outputs over sequences of steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.custom_batching
import jax.numpy as jnp
import numpy as np

from mjxball.algorithms.base import PolicyNetwork
from mjxball.arrays import Array
from mjxball.errors import InputError
from mjxball.rewards import used

SHORTEST_MEMORY, LONGEST_MEMORY = 1.5, 150.0  # initial time constants of a GRU's units [control steps]
RECURRENT_GAIN = 0.7  # gain of a GRU's initial, orthogonal recurrent weights
ESTIMATE = "estimate"  # layer that estimates what critics alone observe from a GRU's state; not exported
FAR = 5.0  # deviations beyond which an estimated number is cut: one of a world that diverges would outweigh all others
FINE_ESTIMATE = 20.0  # an estimated number of deviation 1 is also estimated as the tanh of this multiple


def fresh_layers(key: Array, inputs: int, units: int, sizes: Sequence[int]) -> dict[str, Any]:
    """Initial weights as Flax samples them (LeCun uniform), times 0.01 in the last layer: actions start close to 0.

    `sizes`: outputs of each layer; the last layer gives mean and deviation of the action. With `units` the first layer
    takes a GRU's state and the `inputs`, and the last layer takes that state too.
    """
    layers = {}
    if units:
        key, layer_key = jax.random.split(key)
        layers["gru"] = _fresh_gru(layer_key, inputs, units)
    rows = units + inputs
    for index, columns in enumerate(sizes):
        key, layer_key = jax.random.split(key)
        last = index == len(sizes) - 1
        kernel = jax.nn.initializers.lecun_uniform()(layer_key, (rows + (units if last else 0), columns))
        layers[f"hidden_{index}"] = {"kernel": kernel * (0.01 if last else 1.0), "bias": jnp.zeros(columns)}
        rows = columns
    return layers


def _fresh_square(key: Array, units: int) -> Array:
    """Orthogonal matrix (units, units) times `RECURRENT_GAIN`.

    One after the other under `vmap`. jaxlib's QR factorisation shares the matrices of a batch among the threads of
    XLA's pool and waits for them in one of these: as many batches as threads at once wait for ever.
    """

    @jax.custom_batching.sequential_vmap
    def square(key: Array) -> Array:
        return jax.nn.initializers.orthogonal(RECURRENT_GAIN)(key, (units, units))

    return square(key)


def _fresh_gru(key: Array, inputs: int, units: int) -> dict[str, Array]:
    """Initial GRU: orthogonal recurrent weights, time constants log-uniform in 1.5 to 150 control steps."""
    kernel, recurrent, memory = jax.random.split(key, 3)
    blocks = [_fresh_square(block_key, units) for block_key in jax.random.split(recurrent, 3)]
    low, high = np.log(SHORTEST_MEMORY), np.log(LONGEST_MEMORY)
    steps = jnp.exp(jax.random.uniform(memory, (units,), minval=low, maxval=high))
    return {
        "kernel": jax.nn.initializers.lecun_uniform()(kernel, (inputs, 3 * units)),
        "recurrent": jnp.concatenate(blocks, axis=1),
        "bias": jnp.concatenate([jnp.zeros(units), jnp.log(steps - 1.0), jnp.zeros(units)]),
    }


def estimates(section: str, weight: Any, units: int, known: int) -> bool:
    """Whether a memory of so many `units` is trained to estimate `known` numbers: the `weight` in `section` is not 0.

    Raises InputError if there is no memory, or nothing to estimate.
    """
    if used(weight) and not (units and known):
        raise InputError(
            f"{section}.estimation needs a recurrent network and something to estimate: "
            "--follower.recurrent_units 48 --follower.privileged_critic true"
        )
    return used(weight)


def exported(layers: dict[str, Any]) -> dict[str, Any]:
    """`layers` without the one that estimates."""
    return {name: layer for name, layer in layers.items() if name != ESTIMATE}


def fresh_estimate(units: int, known: int) -> dict[str, Array]:
    """Initial layer of the estimates of `known` numbers and of their fine form."""
    return {"kernel": jnp.zeros((units, 2 * known)), "bias": jnp.zeros(2 * known)}


def estimation_cost(layer: dict[str, Array], memory: Array, known: Array) -> Array:
    """(...) mean squared error of the linear estimates from a GRU's state `memory` (..., H).

    `known` (..., k) are the true numbers, each less its mean and over its deviation, and cut at `FAR`; no gradient
    passes through them.
    """
    known = jax.lax.stop_gradient(jnp.clip(known, -FAR, FAR))
    true = jnp.concatenate([known, jnp.tanh(FINE_ESTIMATE * known)], axis=-1)
    return ((memory @ layer["kernel"] + layer["bias"] - true) ** 2).mean(axis=-1)


class RecurrentPolicy(NamedTuple):
    """Replacement of Brax's policy network (`init`, `apply`) for observations that contain the GRU's state."""

    slots: slice  # entries of an observation that hold the state; they follow the network's inputs
    sizes: tuple[int, ...]  # of all layers, see `fresh_layers`
    mask: Any  # (n,) 1 for entries of an observation that the policy uses, else 0
    estimates: bool = False  # with a layer `ESTIMATE` of what follows the state in an observation

    @property
    def units(self) -> int:
        """Number of units of the GRU."""
        return self.slots.stop - self.slots.start

    def init(self, key: Array) -> Any:
        """Initial parameters."""
        layers = fresh_layers(key, self.slots.start, self.units, self.sizes)
        if self.estimates:
            layers[ESTIMATE] = fresh_estimate(self.units, len(self.mask) - self.slots.stop)
        return {"params": layers}

    def step(self, statistics: Any, policy: Any, observation: Array) -> tuple[Array, Array]:
        """(parameters of the action's distribution (..., 2 a), next state (..., H)) at `observation` (..., n)."""
        layers, mask = exported(policy["params"]), jnp.asarray(self.mask, jnp.float32)
        return PolicyNetwork(layers, statistics.mean, statistics.std, mask).outputs(observation)

    def apply(self, statistics: Any, policy: Any, observation: Array) -> Array:
        """Parameters of the action's distribution (..., 2 a), from the state in each `observation` (..., n)."""
        return self.step(statistics, policy, observation)[0]

    def unroll(self, statistics: Any, policy: Any, observations: Array) -> tuple[Array, Array]:
        """(parameters of the action's distribution (T, B, 2 a), next states (T, B, H)) along `observations` (T, B, n).

        Only the first stored state of a sequence is used. The following states are computed with `policy`, so that
        gradients flow back through them. A stored state of zeros marks the start of an episode and resets the state.
        """
        stored = observations[..., self.slots]

        def one(state: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            observation, stored_state = inputs
            state = jnp.where((stored_state == 0).all(axis=-1, keepdims=True), 0.0, state)
            parts = [observation[..., : self.slots.start], state, observation[..., self.slots.stop :]]
            parameters, state = self.step(statistics, policy, jnp.concatenate(parts, axis=-1))
            return state, (parameters, state)

        return jax.lax.scan(one, stored[0], (observations, stored))[1]

    def estimation(self, statistics: Any, policy: Any, memory: Array, observations: Array) -> Array:
        """() mean of `estimation_cost` for next states `memory` (T, B, H) at `observations` (T, B, n)."""
        known = slice(self.slots.stop, None)
        true = (observations[..., known] - statistics.mean[known]) / statistics.std[known]
        return estimation_cost(policy["params"][ESTIMATE], memory, true).mean()


def answer(network: Any, statistics: Any, policy: Any, observation: Array) -> tuple[Array, Array]:
    """(parameters of the action's distribution, next state (..., H)) of any policy network; H is 0 without a GRU."""
    if isinstance(network, RecurrentPolicy):
        return network.step(statistics, policy, observation)
    return network.apply(statistics, policy, observation), observation[..., :0]
