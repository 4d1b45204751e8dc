"""Copying the leader, and two followers that anything must beat."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.control.baselines.gains import copied_law
from mjxball.control.baselines.law import Brief
from mjxball.control.observation import ACTION_SIZE, copy_command, scale_action

Array = Any
DRAWS = 4096


class Copy:
    """The leader's PD law on the follower's own observation: the optimum of the paper's reward."""

    name = "copy"
    needs_truth = False

    def __init__(self, config: Config):
        self._law = copied_law(config)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """See `Law.step`."""
        return memory, copy_command(observation, *self._law)


class Stay:
    """Level, at hover thrust, whatever happens."""

    name = "stay"
    needs_truth = False

    def __init__(self, config: Config):
        pass

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """See `Law.step`."""
        return memory, observation.__array_namespace__().zeros_like(observation[..., :ACTION_SIZE])


class Random:
    """Uniform noise within the reach of a network's action, the same in every flight."""

    name = "random"
    needs_truth = False

    def __init__(self, config: Config):
        drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (DRAWS, ACTION_SIZE))
        self._commands = scale_action(drawn, config.follower.tilt_limit, config.follower.vertical_limit)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        xp = observation.__array_namespace__()
        return (xp.zeros_like(observation[..., 0], dtype=xp.int32),)

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        (count,) = memory
        return (count + 1,), xp.asarray(self._commands, dtype=observation.dtype)[count % DRAWS]
