"""Reference followers without sense, as lower bounds: `stay` and `random`."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import ACTION_SIZE, scale_action

RANDOM_COMMANDS = 4096  # after which `random` repeats itself


class Stay:
    """Level at hover thrust: the zero command."""

    name = "stay"
    needs_privileged = False

    def __init__(self, config: Config):
        pass

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        return state, observation.__array_namespace__().zeros_like(observation[..., :ACTION_SIZE])


class Random:
    """Uniform commands within a policy's action scale, the same in every flight."""

    name = "random"
    needs_privileged = False

    def __init__(self, config: Config):
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_COMMANDS, ACTION_SIZE))
        self._commands = scale_action(actions, config.follower.action_scale_tilt, config.follower.action_scale_vertical)

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        xp = observation.__array_namespace__()
        return (xp.zeros_like(observation[..., 0], dtype=xp.int32),)

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        xp = observation.__array_namespace__()
        (count,) = state
        return (count + 1,), xp.asarray(self._commands, dtype=observation.dtype)[count % RANDOM_COMMANDS]
