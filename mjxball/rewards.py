"""Rewards of one control step, on NumPy or JAX arrays."""

from __future__ import annotations

from typing import Any

from mjxball.config import Reward

Array = Any


def paper_reward(leader_command: Array, follower_command: Array) -> Array:
    """-10 (|az_l - az_f| + |phi_l - phi_f| + |theta_l - theta_f|) of two commands (..., 3) -> (...) (the paper's)."""
    xp = leader_command.__array_namespace__()
    return -10.0 * xp.abs(leader_command - follower_command).sum(axis=-1)


def task_reward(
    weights: Reward, error: Array, velocity: Array, euler: Array, rates: Array, action: Array, last_action: Array
) -> Array:
    """What the user wants (ours): minus a weighted sum of costs, all vectors (..., 3) -> (...).

    The error's cost is a pseudo-Huber: |e| / scale far away, (e / scale)^2 / 2 near the goal.
    """
    xp = error.__array_namespace__()

    def square(vector: Array) -> Array:
        return (vector * vector).sum(axis=-1)

    distance = xp.sqrt(1.0 + square(error) / weights.error_scale**2) - 1.0
    return -(
        weights.error * distance
        + weights.velocity * square(velocity)
        + weights.tilt * square(euler[..., :2])
        + weights.rates * square(rates)
        + weights.effort * square(action)
        + weights.smoothness * square(action - last_action)
    )
