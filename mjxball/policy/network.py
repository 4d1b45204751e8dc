"""The policy network's deterministic mean, on NumPy or JAX arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Array = Any


def mean_action(weights: Sequence[Array], biases: Sequence[Array], mean: Array, scale: Array, seen: Array) -> Array:
    """tanh of the network's mean output (..., 3) in [-1, 1] for an input `seen` (..., n).

    ReLU layers on (seen - mean) * scale; the last layer's first half is the mean, its second half belongs
    to the exploration noise and is not computed.
    """
    xp = seen.__array_namespace__()
    hidden = (seen - mean) * scale
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        hidden = xp.maximum(hidden @ weight + bias, 0.0)
    return xp.tanh(hidden @ weights[-1] + biases[-1])
