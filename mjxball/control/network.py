"""A follower's network: normalised inputs, ReLU layers, and optionally a gated recurrent unit (GRU) below them.

The same code serves training and flight, on NumPy and JAX arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjxball.arrays import Array, matmul


def gru_cell(hidden: Array, inputs: Array, kernel: Array, recurrent: Array, bias: Array) -> Array:
    """The next state (..., H) of a GRU in state `hidden` (..., H) for `inputs` (..., n).

    `kernel` (n, 3 H), `recurrent` (H, 3 H) and `bias` (3 H,) hold the reset gate, the update gate and the candidate
    side by side. After Cho et al. 2014, with the reset gate applied after the product, as cuDNN and Flax do; an update
    gate of 1 keeps the state.
    """
    xp, size = hidden.__array_namespace__(), hidden.shape[-1]
    from_input, from_state = matmul(inputs, kernel) + bias, matmul(hidden, recurrent)
    # The logistic function as a hyperbolic tangent, which does not overflow.
    gates = 0.5 + 0.5 * xp.tanh(0.5 * (from_input[..., : 2 * size] + from_state[..., : 2 * size]))
    reset, update = gates[..., :size], gates[..., size:]
    candidate = xp.tanh(from_input[..., 2 * size :] + reset * from_state[..., 2 * size :])
    return candidate + update * (hidden - candidate)


class Network(NamedTuple):
    """The network of a policy file, for inputs of any batch shape and array namespace.

    Without `gru` inputs (..., n) go through ReLU layers. With it their last H values are the GRU's state: the first
    layer gets the next state and the normalised input, the last one the layer below and that state.
    """

    weights: Sequence[Array]
    biases: Sequence[Array]
    mean: Array  # (n,) of the inputs, without the GRU's state
    scale: Array  # (n,) 1 / deviation, 0 for an input that is not used
    gru: tuple[Array, Array, Array] | None = None  # `gru_cell`'s kernel, recurrent, bias

    def __call__(self, inputs: Array) -> Array:
        """Action in [-1, 1] (..., 3) for `inputs` (..., n), followed by the next state (..., H) of a GRU."""
        xp = inputs.__array_namespace__()
        value, hidden = self.outputs(inputs)
        return xp.tanh(value) if hidden is None else xp.concat([xp.tanh(value), hidden], axis=-1)

    def outputs(self, inputs: Array) -> tuple[Array, Array | None]:
        """Output of the last layer before its tanh (..., 3), and the next state of a GRU (..., H) or None."""
        xp, width = inputs.__array_namespace__(), self.mean.shape[-1]
        below = (inputs[..., :width] - self.mean) * self.scale
        if self.gru is None:
            return self._head(below), None
        hidden = gru_cell(inputs[..., width:], below, *self.gru)
        return self._head(xp.concat([hidden, below], axis=-1), hidden), hidden

    def _head(self, below: Array, hidden: Array | None = None) -> Array:
        xp = below.__array_namespace__()
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            below = xp.maximum(matmul(below, weight) + bias, 0.0)
        if hidden is not None:
            below = xp.concat([below, hidden], axis=-1)
        return matmul(below, self.weights[-1]) + self.biases[-1]

    def like(self, inputs: Array) -> Network:
        """The same network with arrays of the namespace and dtype of `inputs`."""
        if isinstance(inputs, np.ndarray) and inputs.dtype == self.mean.dtype:
            return self
        xp = inputs.__array_namespace__()

        def one(array: Array) -> Array:
            return xp.asarray(array, dtype=inputs.dtype)

        gru = None if self.gru is None else (one(self.gru[0]), one(self.gru[1]), one(self.gru[2]))
        weights, biases = tuple(map(one, self.weights)), tuple(map(one, self.biases))
        return Network(weights, biases, one(self.mean), one(self.scale), gru)
