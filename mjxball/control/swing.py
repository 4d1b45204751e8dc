"""Loads that swing: what a load's torque will be when rotors act on what is known of it now (ours).

An estimate of a load follows it late, and rotors act later still. Of a torque that swings at one frequency the delay is
an angle. J observers, each of a constant and of a swing of its own frequency, run on the estimate about roll and about
pitch; by how little each leaves unexplained it gets a weight, and what it says of the swing is turned ahead by the
angle of that frequency. Needs NumPy alone; `baselines.swing_design` makes the numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

Array = Any
STATES = 4  # of each swing about an axis: constant, in phase, in quadrature [rad], energy of what is left [rad2]
SHARPNESS = 3  # weights go with the energies to the power -2^3
LEAST_ENERGY = 1e-6  # [rad2]


class Swinging(NamedTuple):
    """What observers know, of J swings about roll and about pitch."""

    constant: Array  # (..., 2, J)
    phase: Array  # (..., 2, J) the swing
    across: Array  # (..., 2, J) in quadrature
    energy: Array  # (..., 2, J)
    weights: Array  # (..., 2, J) that sum to 1


def swings_seen(swing: Array, keep: Array, memory: Array, load: Array) -> Swinging:
    """What is known once `load` (..., 2) [rad] is estimated; `memory` (..., 2 J 4) as predicted.

    `swing` (J, 5): cos, sin of the angle of a step, gains on the constant, in phase, in quadrature.
    """
    xp = memory.__array_namespace__()
    gains = xp.asarray(swing[:, 2:], dtype=memory.dtype)
    before = xp.reshape(memory, (*memory.shape[:-1], 2, STATES, len(swing)))
    constant, phase, across, energy = (before[..., k, :] for k in range(STATES))
    left = load[..., None] - constant - phase
    energy = float(keep) * energy + (1.0 - float(keep)) * left * left
    odds = 1.0 / (energy + LEAST_ENERGY)
    odds = odds / xp.max(odds, axis=-1, keepdims=True)
    for _ in range(SHARPNESS):
        odds = odds * odds
    constant, phase, across = (state + gains[:, k] * left for k, state in enumerate((constant, phase, across)))
    return Swinging(constant, phase, across, energy, odds / odds.sum(axis=-1, keepdims=True))


def swings_grown(ahead: Array, found: Swinging, models: Array) -> Array:
    """What the swings will have grown by (..., 2) [rad].

    `ahead` (M, J, 2): the factor, as a complex number, from the swing of an estimate to what rotors must be told, less
    1; of each of M models, with weights `models` (..., 2, M).
    """
    xp = models.__array_namespace__()
    ahead = xp.asarray(ahead, dtype=models.dtype)
    along, across = (models @ ahead[..., k] for k in (0, 1))
    return (found.weights * (along * found.phase - across * found.across)).sum(axis=-1)


def swings_advanced(swing: Array, found: Swinging) -> Array:
    """The memory (..., 2 J 4) a step later."""
    xp = found.energy.__array_namespace__()
    cos, sin = (xp.asarray(swing[:, k], dtype=found.energy.dtype) for k in (0, 1))
    turned = cos * found.phase - sin * found.across, sin * found.phase + cos * found.across
    every = xp.stack([found.constant, *turned, found.energy], axis=-2)
    return xp.reshape(every, (*every.shape[:-3], -1))
