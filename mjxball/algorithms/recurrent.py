"""A gated recurrent unit below a policy's layers: how it starts, and how it answers in sequences of steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.algorithms.base import PolicyNetwork
from mjxball.arrays import Array

SHORTEST_MEMORY, LONGEST_MEMORY = 1.5, 150.0  # control steps that units of a GRU keep their state for at the start
RECURRENT_GAIN = 0.7  # of a GRU's orthogonal recurrent weights at the start


def fresh_layers(key: Array, inputs: int, units: int, sizes: Sequence[int]) -> dict[str, Any]:
    """Weights as Flax draws them (LeCun's), near 0 in the last layer: the first policy adds hardly anything.

    `sizes` of all layers, the last of which gives mean and deviation of the action. With `units` the first layer sees a
    GRU's state and `inputs`, and the last one that state as well.
    """
    layers = {}
    if units:
        key, own = jax.random.split(key)
        layers["gru"] = _fresh_gru(own, inputs, units)
    rows = units + inputs
    for number, columns in enumerate(sizes):
        key, own = jax.random.split(key)
        last = number == len(sizes) - 1
        kernel = jax.nn.initializers.lecun_uniform()(own, (rows + (units if last else 0), columns))
        layers[f"hidden_{number}"] = {"kernel": kernel * (0.01 if last else 1.0), "bias": jnp.zeros(columns)}
        rows = columns
    return layers


def _fresh_gru(key: Array, inputs: int, units: int) -> dict[str, Array]:
    """A GRU at the start: orthogonal recurrent weights, and units that forget within 1.5 to 150 control steps."""
    kernel, recurrent, memory = jax.random.split(key, 3)
    square = jax.nn.initializers.orthogonal(RECURRENT_GAIN)
    blocks = [square(own, (units, units)) for own in jax.random.split(recurrent, 3)]
    low, high = np.log(SHORTEST_MEMORY), np.log(LONGEST_MEMORY)
    steps = jnp.exp(jax.random.uniform(memory, (units,), minval=low, maxval=high))
    return {
        "kernel": jax.nn.initializers.lecun_uniform()(kernel, (inputs, 3 * units)),
        "recurrent": jnp.concatenate(blocks, axis=1),
        "bias": jnp.concatenate([jnp.zeros(units), jnp.log(steps - 1.0), jnp.zeros(units)]),
    }


class RecurrentPolicy(NamedTuple):
    """In place of Brax's policy network (`init`, `apply`) for observations that hold the GRU's state."""

    slots: slice  # of an observation that hold the state; the network's inputs stand before them
    sizes: tuple[int, ...]  # of all layers, see `fresh_layers`
    mask: Any  # (n,) of observations

    @property
    def units(self) -> int:
        """Of the GRU."""
        return self.slots.stop - self.slots.start

    def init(self, key: Array) -> Any:
        """Fresh parameters."""
        return {"params": fresh_layers(key, self.slots.start, self.units, self.sizes)}

    def step(self, statistics: Any, policy: Any, observation: Array) -> tuple[Array, Array]:
        """(parameters of the action's distribution (..., 2 a), next state (..., H)) at `observation` (..., n)."""
        network = PolicyNetwork(policy["params"], statistics.mean, statistics.std, jnp.asarray(self.mask, jnp.float32))
        return network.outputs(observation)

    def apply(self, statistics: Any, policy: Any, observation: Array) -> Array:
        """The first of `step`, by the state that every `observation` (..., n) holds."""
        return self.step(statistics, policy, observation)[0]

    def unroll(self, statistics: Any, policy: Any, observations: Array) -> Array:
        """The same (T, B, 2 a) of sequences (T, B, n), whose states follow from the first ones that they hold.

        So the states are those of `policy`, and gradients go back through them. An episode begins with a state of
        zeros, which stays.
        """
        held = observations[..., self.slots]

        def one(state: Array, seen: tuple[Array, Array]) -> tuple[Array, Array]:
            observation, kept = seen
            state = jnp.where((kept == 0).all(axis=-1, keepdims=True), 0.0, state)
            parts = [observation[..., : self.slots.start], state, observation[..., self.slots.stop :]]
            found, state = self.step(statistics, policy, jnp.concatenate(parts, axis=-1))
            return state, found

        return jax.lax.scan(one, held[0], (observations, held))[1]


def answer(network: Any, statistics: Any, policy: Any, observation: Array) -> tuple[Array, Array]:
    """(parameters of the action's distribution, next state) of any policy network; without a GRU a state (..., 0)."""
    if isinstance(network, RecurrentPolicy):
        return network.step(statistics, policy, observation)
    return network.apply(statistics, policy, observation), observation[..., :0]
