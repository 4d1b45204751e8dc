"""Replay as a ring buffer: the oldest rows are overwritten in place, and no row is ever moved."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt


class Transitions(NamedTuple):
    """A batch of transitions. `discount` is 0 after a termination (not after a time limit), else gamma^(n-1)."""

    observation: Float[Array, "... n"]
    action: Float[Array, "... actions"]  # in [-1, 1]
    reward: Float[Array, "..."]
    discount: Float[Array, "..."]
    next_observation: Float[Array, "... n"]  # the true one, before any reset
    last: Float[Array, "..."]  # 1 if the episode ended here, by termination or time limit


class Replay(NamedTuple):
    """The ring buffer, followed by scratch rows for one step that is not recorded."""

    rows: Float[Array, "rows width"]  # capacity + environments, 2 n + 6
    inserted: Int[Array, ""]  # transitions recorded so far, kept below twice the capacity


def create(capacity: int, num_envs: int, observation_size: int, action_size: int) -> Replay:
    """An empty buffer; `capacity` must be a multiple of `num_envs`."""
    width = 2 * observation_size + action_size + 3
    return Replay(jnp.zeros((capacity + num_envs, width), jnp.float32), jnp.zeros((), jnp.int32))


def insert(replay: Replay, transitions: Transitions, record: Bool[Array | np.ndarray, ""]) -> Replay:
    """Write one step of all environments (envs, ...) over the oldest rows, or to the scratch rows unless `record`."""
    columns = [column if column.ndim == 2 else column[:, None] for column in transitions]
    rows = jnp.concatenate(columns, axis=-1)
    num_envs = rows.shape[0]
    capacity = replay.rows.shape[0] - num_envs
    slot = jnp.where(record, replay.inserted % capacity, capacity)
    # Subtracting the capacity leaves `% capacity` unchanged, and int32 never overflows.
    count = replay.inserted + jnp.where(record, num_envs, 0)
    count = jnp.where(count >= 2 * capacity, count - capacity, count)
    return Replay(jax.lax.dynamic_update_slice_in_dim(replay.rows, rows, slot, axis=0), count)


def sample(
    replay: Replay,
    draws: UInt[Array, " batch"],
    num_envs: int,
    observation_size: int,
    action_size: int,
    steps: int,
    discount: Float[Array, ""] | float,
) -> Transitions:
    """Sampled n-step transitions, one for each of `draws`, which are uniform 32-bit integers.

    Rewards are summed with `discount` (gamma) until `steps` or the episode's end, whichever comes first.
    The buffer must hold at least `steps` steps of all environments.
    """
    capacity = replay.rows.shape[0] - num_envs
    first = _starts(replay, draws, num_envs, steps)
    rows = _unpack(replay.rows[first % capacity], observation_size, action_size)
    reward, factor, last, bootstrap = rows.reward, jnp.ones(len(draws)), rows.last, rows
    for step in range(1, steps):
        rows_k = _unpack(replay.rows[(first + step * num_envs) % capacity], observation_size, action_size)
        going = last == 0
        factor = jnp.where(going, factor * discount, factor)
        reward = reward + jnp.where(going, factor * rows_k.reward, 0.0)
        bootstrap = jax.tree.map(
            lambda new, old, going=going: jnp.where(going.reshape((-1,) + (1,) * (new.ndim - 1)), new, old),
            rows_k,
            bootstrap,
        )
        last = jnp.where(going, rows_k.last, last)
    return Transitions(
        observation=rows.observation,
        action=rows.action,
        reward=reward,
        discount=factor * bootstrap.discount,
        next_observation=bootstrap.next_observation,
        last=last,
    )


def observations(
    replay: Replay, draws: UInt[Array, " batch"], num_envs: int, observation_size: int, steps: int
) -> Float[Array, "steps batch n"]:
    """Observations of `steps` consecutive steps of one environment for each of `draws`. Its episode may end within."""
    capacity = replay.rows.shape[0] - num_envs
    following = _starts(replay, draws, num_envs, steps) + num_envs * jnp.arange(steps)[:, None]
    return replay.rows[following % capacity, :observation_size]


def _starts(replay: Replay, draws: UInt[Array, " batch"], num_envs: int, steps: int) -> Int[Array, " batch"]:
    """Sampled indices of rows, to be taken modulo the capacity, each followed by `steps` - 1 recorded steps."""
    capacity = replay.rows.shape[0] - num_envs
    size = jnp.minimum(replay.inserted, capacity)
    oldest = jnp.where(replay.inserted < capacity, 0, replay.inserted)
    eligible = jnp.maximum(size - (steps - 1) * num_envs, 1)
    # The remainder deviates from a uniform distribution by less than `eligible` / 2^32.
    return oldest + (draws % eligible.astype(draws.dtype)).astype(eligible.dtype)


def _unpack(rows: Float[Array, "batch width"], observation_size: int, action_size: int) -> Transitions:
    n, a = observation_size, action_size
    return Transitions(
        observation=rows[:, :n],
        action=rows[:, n : n + a],
        reward=rows[:, n + a],
        discount=rows[:, n + a + 1],
        next_observation=rows[:, n + a + 2 : 2 * n + a + 2],
        last=rows[:, 2 * n + a + 2],
    )
