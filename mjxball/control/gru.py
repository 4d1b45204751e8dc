"""A gated recurrent unit, whose state a follower carries from one control period to the next.

Written once, for training and for flight; runs on NumPy and on JAX arrays.
"""

from __future__ import annotations

from typing import Any

Array = Any


def gru_cell(hidden: Array, seen: Array, kernel: Array, recurrent: Array, bias: Array) -> Array:
    """The next state (..., H) of a GRU in state `hidden` (..., H) at the input `seen` (..., n).

    `kernel` (n, 3 H), `recurrent` (H, 3 H) and `bias` (3 H,) hold, side by side, the reset gate, the update gate and
    the candidate. After Cho et al. 2014, the reset gate applied behind the product, as cuDNN and Flax do; an update
    gate of 1 keeps the state.
    """
    xp, size = hidden.__array_namespace__(), hidden.shape[-1]
    given, kept = seen @ kernel + bias, hidden @ recurrent
    # The logistic function as a hyperbolic tangent, which does not overflow.
    gates = 0.5 + 0.5 * xp.tanh(0.5 * (given[..., : 2 * size] + kept[..., : 2 * size]))
    reset, update = gates[..., :size], gates[..., size:]
    candidate = xp.tanh(given[..., 2 * size :] + reset * kept[..., 2 * size :])
    return candidate + update * (hidden - candidate)
