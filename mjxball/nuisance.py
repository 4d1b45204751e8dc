"""What training disturbs in every world: noisy and delayed senses, gusts. Drawn anew by each reset; JAX, one world.

The judge's disturbances (`sensing.py`) are drawn before a flight and the same for everybody; these are drawn as the
world goes, from a key that it carries.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjxball.config import Config
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.sensing import GUST_TIME, NOISE

Array = Any


class Nuisance(NamedTuple):
    """What one world carries of it."""

    key: Array
    noise: Array  # () in units of `sensing.NOISE`
    delay: Array  # () whole control steps
    gust: Array  # () rms of each axis of `push` [N]
    push: Array  # (3,) force on O in the world, now [N]
    past: Array  # (longest delay + 1, 18) observations as they were measured, newest first


class Nuisances:
    """Starts and steps the nuisances of one world. Without any in `config` the world carries `()`."""

    def __init__(self, config: Config):
        scenario, self._period = config.scenario, config.timing.control_period
        self._ranges = (scenario.noise, scenario.delay, scenario.gust)
        self.present = any(high > 0 for _, high in self._ranges)
        self._longest = math.floor(scenario.delay[1] / self._period + 0.5)
        self._keep = math.exp(-self._period / GUST_TIME)

    def start(self, key: Array, seen: Array) -> tuple[Any, Array]:
        """(nuisance, what the follower sees) at a reset where the truth is `seen` (18,)."""
        if not self.present:
            return (), seen
        draw_key, key = jax.random.split(key)
        share = jax.random.uniform(draw_key, (3,))
        noise, delay, gust = (low + (high - low) * u for (low, high), u in zip(self._ranges, share, strict=True))
        key, noise_key, push_key = jax.random.split(key, 3)
        measured = self._measured(noise_key, noise, seen)
        past = jnp.broadcast_to(measured, (self._longest + 1, OBSERVATION_SIZE))
        steps = jnp.round(delay / self._period).astype(jnp.int32)
        push = gust * jax.random.normal(push_key, (3,))
        return Nuisance(key, noise, steps, gust, push, past), measured

    def step(self, nuisance: Any, seen: Array) -> tuple[Any, Array]:
        """(nuisance, what the follower sees) one control period on, where the truth is `seen` (18,)."""
        if not self.present:
            return (), seen
        key, noise_key, push_key = jax.random.split(nuisance.key, 3)
        past = jnp.concatenate([self._measured(noise_key, nuisance.noise, seen)[None], nuisance.past[:-1]])
        fresh = jax.random.normal(push_key, (3,))
        push = self._keep * nuisance.push + nuisance.gust * math.sqrt(1 - self._keep**2) * fresh
        return nuisance._replace(key=key, past=past, push=push), past[nuisance.delay]

    @staticmethod
    def _measured(key: Array, noise: Array, seen: Array) -> Array:
        return seen + noise * jnp.asarray(NOISE, seen.dtype) * jax.random.normal(key, seen.shape, seen.dtype)
