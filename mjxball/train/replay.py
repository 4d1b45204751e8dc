"""Ring-buffer replay: rows are overwritten in place, nothing is ever copied or rolled."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Array = Any


class Transitions(NamedTuple):
    """A batch of transitions. `discount` is 0 after a termination, 1 otherwise (a time limit is no end)."""

    observation: Array  # (..., n)
    action: Array  # (..., 3) in [-1, 1]
    reward: Array  # (...)
    discount: Array  # (...)
    next_observation: Array  # (..., n), the true one, before any reset


class Replay(NamedTuple):
    """`rows` holds the capacity and, behind it, one step of scratch rows for steps that are not recorded."""

    rows: Array  # (capacity + worlds, 2 n + 5)
    inserted: Array  # () transitions ever recorded


def create(capacity: int, worlds: int, observation_size: int, action_size: int) -> Replay:
    """An empty buffer; `capacity` must be a multiple of `worlds`."""
    width = 2 * observation_size + action_size + 2
    return Replay(jnp.zeros((capacity + worlds, width), jnp.float32), jnp.zeros((), jnp.int32))


def insert(replay: Replay, transitions: Transitions, record: Array) -> Replay:
    """Write one step of all worlds (worlds, ...) over the oldest rows, or to scratch unless `record`."""
    rows = jnp.concatenate(
        [
            transitions.observation,
            transitions.action,
            transitions.reward[:, None],
            transitions.discount[:, None],
            transitions.next_observation,
        ],
        axis=-1,
    )
    worlds = rows.shape[0]
    capacity = replay.rows.shape[0] - worlds
    slot = jnp.where(record, replay.inserted % capacity, capacity)
    # A counter past 2 x capacity is folded back, so that int32 never overflows and `% capacity` is unchanged.
    count = replay.inserted + jnp.where(record, worlds, 0)
    count = jnp.where(count >= 2 * capacity, count - capacity, count)
    return Replay(jax.lax.dynamic_update_slice_in_dim(replay.rows, rows, slot, axis=0), count)


def sample(replay: Replay, key: Array, batch: int, worlds: int, observation_size: int, action_size: int) -> Transitions:
    """Draw `batch` transitions uniformly, with replacement, from those recorded."""
    capacity = replay.rows.shape[0] - worlds
    index = jax.random.randint(key, (batch,), 0, jnp.maximum(jnp.minimum(replay.inserted, capacity), 1))
    rows = replay.rows[index]
    n, a = observation_size, action_size
    return Transitions(
        observation=rows[:, :n],
        action=rows[:, n : n + a],
        reward=rows[:, n + a],
        discount=rows[:, n + a + 1],
        next_observation=rows[:, n + a + 2 :],
    )
