"""Follower baselines: `follower(observation) -> command`, on NumPy or JAX arrays of any batch shape."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from mjxball.config import Config
from mjxball.control.observation import copy_command
from mjxball.errors import InputError

Array = Any


class Follower(Protocol):
    """What flies as the follower: a baseline here, or `mjxball.policy.Policy`."""

    name: str

    def reset(self) -> None:
        """Start an episode: forget the past."""

    def __call__(self, observation: Array) -> Array:
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18)."""


class Copy:
    """The leader's PD law on the follower's own observation: the optimum of the paper's reward (design section 5)."""

    name = "copy"

    def __init__(self, config: Config):
        law = config.leader
        self._law = (law.kp, law.kd, config.plant.gravity, law.tilt_limit, law.vertical_limit)

    def reset(self) -> None:
        """Nothing to forget."""

    def __call__(self, observation: Array) -> Array:
        """See `Follower.__call__`."""
        return copy_command(observation, *self._law)


BASELINES: dict[str, Callable[[Config], Follower]] = {"copy": Copy}


def make_baseline(name: str, config: Config) -> Follower:
    """The baseline called `name` with the gains that follow from `config`; raise InputError if unknown."""
    if name not in BASELINES:
        raise InputError(f"unknown follower {name!r}; baselines are {', '.join(BASELINES)}")
    return BASELINES[name](config)
