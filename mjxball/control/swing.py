"""Loads that swing: what a load's torque will be when rotors act on what is known of it now (ours).

An estimate of a load follows it late, and rotors act later still. Of a torque that swings at one frequency the delay is
an angle. J observers, each of a constant and of a swing of its own frequency, run on the estimate about roll and about
pitch; by how little each leaves unexplained it gets a weight, and what it says of the swing is turned ahead by the
angle of that frequency. Needs NumPy alone; `baselines.swing_design` makes the numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.plant.parts import joined

Array = Any
STATES = 4  # of each swing about an axis: constant, in phase, in quadrature [rad], energy of what is left [rad2]
SHARPNESS = 3  # weights go with the energies to the power -2^3
LEAST_ENERGY = 1e-6  # [rad2]


class Swinging(NamedTuple):
    """What observers know, of J swings about roll and about pitch."""

    states: Array  # (..., 2, J, 3)
    energy: Array  # (..., 2, J)
    weights: Array  # (..., 2, J) that sum to 1


def swings_seen(swing: Array, keep: Array, memory: Array, load: Array) -> Swinging:
    """What is known once `load` (..., 2) [rad] is estimated; `memory` (..., 2 J 4) as predicted.

    `swing` (J, 5): cos, sin of the angle of a step, gains on the constant, in phase, in quadrature.
    """
    xp, count = memory.__array_namespace__(), len(swing)
    gains = xp.asarray(swing[:, 2:], dtype=memory.dtype)
    parts = [memory[..., k * count : (k + 1) * count] for k in range(2 * STATES)]
    before = [joined(parts[k::STATES], axis=-2) for k in range(STATES)]
    left = load[..., None] - before[0] - before[1]
    states = joined(before[:3]) + gains * left[..., None]
    energy = float(keep) * before[3] + (1.0 - float(keep)) * left * left
    odds = 1.0 / (energy + LEAST_ENERGY)
    odds = odds / xp.max(odds, axis=-1, keepdims=True)
    for _ in range(SHARPNESS):
        odds = odds * odds
    return Swinging(states, energy, odds / odds.sum(axis=-1, keepdims=True))


def swings_grown(ahead: Array, found: Swinging, models: Array) -> Array:
    """What the swings will have grown by (..., 2) [rad].

    `ahead` (M, J, 2): the factor, as a complex number, from the swing of an estimate to what rotors must be told, less
    1; of each of M models, with weights `models` (..., 2, M).
    """
    xp = models.__array_namespace__()
    ahead = xp.asarray(ahead, dtype=models.dtype)
    along, across = (models @ ahead[..., k] for k in (0, 1))
    return (found.weights * (along * found.states[..., 1] - across * found.states[..., 2])).sum(axis=-1)


def swings_advanced(swing: Array, found: Swinging) -> Array:
    """The memory (..., 2 J 4) a step later."""
    xp = found.energy.__array_namespace__()
    cos, sin = (xp.asarray(swing[:, k], dtype=found.energy.dtype) for k in (0, 1))
    constant, phase, across = (found.states[..., k] for k in range(3))
    every = constant, cos * phase - sin * across, sin * phase + cos * across, found.energy
    return xp.concat([part[..., axis, :] for axis in (0, 1) for part in every], axis=-1)
