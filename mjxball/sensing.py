"""What comes between a flight and its follower: sensor noise, a relayed object error, delay; and gusts on the object.

Everything is drawn from the scenario's seed before the flight, so a scenario is the same in every batch and on every
engine. Only the follower's senses are disturbed; the leader flies on the truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mjxball.control.observation import ERROR, ERROR_RATE, OBSERVATION_SIZE
from mjxball.errors import InputError

# Standard deviation of each observation slot at noise level 1: motion capture and a small drone's inertial sensors.
NOISE = np.array([*[0.003] * 3, *[0.005] * 3, *[0.02] * 3, *[0.02] * 3, *[0.003] * 3, *[0.02] * 3])
GUST_TIME = 1.0  # [s] over which a gust is correlated
Array = Any
Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Disturbance:
    """What disturbs one flight. The default is nothing."""

    noise: float = 0.0  # standard deviations of the follower's measurements, in units of `NOISE`
    delay: float = 0.0  # of the follower's measurements, a multiple of the control period [s]
    relay_rate: float = 0.0  # e_o and its rate reach the follower this often, held in between; 0: at once [Hz]
    relay_bias: Vector3 = (0.0, 0.0, 0.0)  # added to the relayed e_o [m]
    relay_loss: float = 0.0  # share of the relayed messages that is lost
    gust: float = 0.0  # rms of a random force on O, each axis of the world [N]
    seed: int = 0


def check(disturbance: Disturbance, period: float) -> None:
    """Raise InputError with one sentence if `disturbance` makes no sense."""
    numbers = (disturbance.noise, disturbance.delay, disturbance.relay_rate, disturbance.gust, *disturbance.relay_bias)
    if not np.isfinite(numbers).all():
        raise InputError("every number of a disturbance must be finite")
    if min(disturbance.noise, disturbance.delay, disturbance.relay_rate, disturbance.gust) < 0:
        raise InputError("noise, delay, relay rate and gust must not be negative")
    if abs(disturbance.delay / period - round(disturbance.delay / period)) > 1e-6:
        raise InputError(f"delay must be a multiple of the control period {period:g} s, not {disturbance.delay:g} s")
    if not 0 <= disturbance.relay_loss < 1:
        raise InputError(f"relay loss must be at least 0 and below 1, not {disturbance.relay_loss:g}")


class Memory(NamedTuple):
    """What the senses of n flights carry from step to step."""

    relayed: Array  # (n, 6) object error and its rate as last relayed
    past: Array  # (longest delay + 1, n, 18) newest first


class Senses:
    """The disturbances of n flights of `count` control steps, drawn. `step` runs on NumPy and on JAX arrays."""

    def __init__(self, disturbances: Sequence[Disturbance], count: int, period: float):
        self.noise = _stack([_noise(d, count) for d in disturbances])  # (count + 1, n, 18), None: none
        self.arrives = _stack([_arrivals(d, count, period) for d in disturbances])  # (count + 1, n), None: always
        self.pushes = _stack([_gusts(d, count, period) for d in disturbances])  # (count + 1, n, 3) on O [N]
        self.bias = np.array([d.relay_bias for d in disturbances])
        self.delays = np.array([round(d.delay / period) for d in disturbances])

    def start(self, seen: Array) -> Memory:
        """Memory before the first step, at which the truth is `seen` (n, 18)."""
        xp = seen.__array_namespace__()
        return Memory(seen[:, ERROR.start :], xp.stack([seen] * (int(self.delays.max()) + 1)))

    def step(
        self, memory: Memory, number: Array, seen: Array, noise: Array | None, arrives: Array | None
    ) -> tuple[Memory, Array]:
        """(memory, what the followers get to see (n, 18)) of the truth `seen` at step `number` with its draws."""
        xp = seen.__array_namespace__()
        if noise is not None:
            seen = seen + noise
        error = seen[:, ERROR] + xp.asarray(self.bias, dtype=seen.dtype)
        object_part = xp.concat([error, seen[:, ERROR_RATE]], axis=-1)
        if arrives is not None:
            object_part = xp.where(arrives[:, None], object_part, memory.relayed)
        seen = xp.concat([seen[:, : ERROR.start], object_part], axis=-1)
        if not self.delays.any():
            return Memory(object_part, memory.past), seen
        past = xp.concat([seen[None], memory.past[:-1]], axis=0)
        past = xp.where(number == 0, xp.broadcast_to(seen, past.shape), past)
        return Memory(object_part, past), past[self.delays, np.arange(len(self.delays))]


def _stack(tables: list[np.ndarray | None]) -> np.ndarray | None:
    """Tables of all flights along axis 1, with what 'nothing' means where one has none; None if nobody has one."""
    given = [table for table in tables if table is not None]
    if not given:
        return None
    nothing = np.ones_like(given[0]) if given[0].dtype == bool else np.zeros_like(given[0])
    return np.stack([nothing if table is None else table for table in tables], axis=1)


def _random(disturbance: Disturbance, stream: int) -> np.random.Generator:
    return np.random.default_rng([disturbance.seed, stream])


def _noise(disturbance: Disturbance, count: int) -> np.ndarray | None:
    if not disturbance.noise:
        return None
    drawn = _random(disturbance, 1).standard_normal((count + 1, OBSERVATION_SIZE), np.float32)
    return drawn * (disturbance.noise * NOISE).astype(np.float32)


def _arrivals(disturbance: Disturbance, count: int, period: float) -> np.ndarray | None:
    """True at the steps where a relayed message arrives; the first one always does."""
    if not disturbance.relay_rate:
        return None
    sent = np.floor(np.arange(count + 1) * period * disturbance.relay_rate + 1e-9)
    arrives = np.diff(sent, prepend=-1.0) > 0
    arrives &= _random(disturbance, 2).random(count + 1) >= disturbance.relay_loss
    arrives[0] = True
    return arrives


def _gusts(disturbance: Disturbance, count: int, period: float) -> np.ndarray | None:
    """A first-order Gauss-Markov force (count + 1, 3) that starts in its steady state."""
    if not disturbance.gust:
        return None
    drawn = _random(disturbance, 3).standard_normal((count + 1, 3))
    keep = math.exp(-period / GUST_TIME)
    force = np.empty_like(drawn)
    force[0] = drawn[0]
    for number in range(1, count + 1):
        force[number] = keep * force[number - 1] + math.sqrt(1 - keep * keep) * drawn[number]
    return disturbance.gust * force
