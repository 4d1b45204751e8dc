"""What the follower's network sees besides the newest observation: older ones, filtered ones, its own actions.

Written once, for training and for flight; every function runs on NumPy and on JAX arrays.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from mjxball.config import Config
from mjxball.control.observation import ACTION_SIZE, OBSERVATION_SIZE

Array = Any


class Recall(NamedTuple):
    """How much a follower remembers. The default is nothing: its network sees the 18 observations alone.

    Its memory (..., m) holds, in this order: `history` - 1 older observations, newest first; for each time constant
    of `filters` an exponential average of the observations (18) and one of the network's actions (3); the last
    action (3) if `previous_action`. Averages are what a linear observer of disturbances needs of the past, in a
    tenth of the numbers of a history.
    """

    history: int = 1  # observations, the newest included
    previous_action: bool = False
    filters: tuple[float, ...] = ()  # time constants [s]
    period: float = 0.02  # between two observations [s]

    @property
    def size(self) -> int:
        """Length m of the memory, and what `network_input` is longer than an observation."""
        averages = len(self.filters) * (OBSERVATION_SIZE + ACTION_SIZE)
        return self._older + averages + (ACTION_SIZE if self.previous_action else 0)

    @property
    def _older(self) -> int:
        return (self.history - 1) * OBSERVATION_SIZE

    def start(self, observation: Array) -> Array:
        """Memory (..., m) at the start of an episode: always this `observation` (..., 18), and zero actions."""
        xp = observation.__array_namespace__()
        still = xp.zeros_like(observation[..., :ACTION_SIZE])
        parts = [observation] * (self.history - 1) + [observation, still] * len(self.filters)
        parts += [still] * self.previous_action
        return xp.concat(parts, axis=-1) if parts else observation[..., :0]

    def next(self, memory: Array, observation: Array, scaled_action: Array) -> Array:
        """Memory for the next step, after `observation` was answered by `scaled_action` (..., 3) in [-1, 1]."""
        xp = observation.__array_namespace__()
        if not self.size:
            return memory
        parts = [xp.concat([observation, memory[..., : self._older]], axis=-1)[..., : self._older]]
        for average, tau in zip(self._averages(memory), self.filters, strict=True):
            new = xp.concat([observation, scaled_action], axis=-1)
            parts.append(average - math.expm1(-self.period / tau) * (new - average))
        parts += [scaled_action] * self.previous_action
        return xp.concat(parts, axis=-1)

    def network_input(self, observation: Array, memory: Array) -> Array:
        """Input of the network (..., 18 + m): the observation, then the memory, averages less the observation.

        The difference to an average is a filtered derivative; normalised on its own it keeps its small numbers.
        """
        xp = observation.__array_namespace__()
        if not self.filters:
            return xp.concat([observation, memory], axis=-1)
        parts = [observation, memory[..., : self._older]]
        for average in self._averages(memory):
            parts += [average[..., :OBSERVATION_SIZE] - observation, average[..., OBSERVATION_SIZE:]]
        return xp.concat([*parts, memory[..., self.size - ACTION_SIZE * self.previous_action :]], axis=-1)

    def mask(self, ignore_position: bool) -> list[float]:
        """1 for each number of `network_input` that the network uses, 0 for absolute positions if it ignores them."""
        shown = [0.0 if ignore_position else 1.0] * 3 + [1.0] * (OBSERVATION_SIZE - 3)
        # How an absolute position differs from its average does not depend on where that is.
        filtered = [1.0] * (OBSERVATION_SIZE + ACTION_SIZE)
        return shown * self.history + filtered * len(self.filters) + [1.0] * (ACTION_SIZE * self.previous_action)

    def slowest_action(self, memory: Array) -> Array:
        """(..., 3) the network's own action in [-1, 1], averaged over the longest of `filters`."""
        slowest = self.filters.index(max(self.filters))
        return self._averages(memory)[slowest][..., OBSERVATION_SIZE:]

    def _averages(self, memory: Array) -> list[Array]:
        width = OBSERVATION_SIZE + ACTION_SIZE
        first = [self._older + k * width for k in range(len(self.filters))]
        return [memory[..., k : k + width] for k in first]


def recall_of(config: Config) -> Recall:
    """What the follower of `config` remembers."""
    follower, period = config.follower, config.timing.control_period
    return Recall(follower.history, follower.previous_action, follower.observation_averages, period)
