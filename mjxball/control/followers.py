"""Followers that fly: `follower(observation) -> command`, on NumPy or JAX arrays of any batch shape."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from mjxball.config import Config
from mjxball.control.baselines import Adaptive, Copy, Lqg, Memoryless, Oracle, PairLqg, Random, SlowLqg, Stay
from mjxball.control.baselines.law import Brief, Law
from mjxball.errors import InputError

Array = Any


class Follower(Protocol):
    """What flies as the follower: a baseline here, or `mjxball.policy.Policy`."""

    name: str

    def reset(self) -> None:
        """Start an episode: forget the past."""

    def __call__(self, observation: Array) -> Array:
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18)."""


class Baseline:
    """A `Law` that remembers. Whoever flies it may set `brief` before a call; else the plant's own mass is believed."""

    def __init__(self, law: Law, config: Config):
        self.law, self.name = law, law.name
        self.brief: Brief | None = None
        self._believed_mass = config.plant.object_mass
        self._memory: Any = None

    def reset(self) -> None:
        """See `Follower.reset`."""
        self._memory, self.brief = None, None

    def __call__(self, observation: Array) -> Array:
        """See `Follower.__call__`."""
        if self._memory is None:
            self._memory = self.law.start(observation)
        brief = self.brief or self._plain(observation)
        self._memory, command = self.law.step(self._memory, observation, brief)
        return command

    def _plain(self, observation: Array) -> Brief:
        if self.law.needs_truth:
            raise InputError(f"follower {self.name!r} must be told where the CG is; it flies in simulation only")
        zero = observation.__array_namespace__().zeros_like(observation[..., 0])
        return Brief(zero + self._believed_mass, zero, zero, zero)


LAWS: dict[str, Callable[[Config], Law]] = {
    "stay": Stay,
    "random": Random,
    "copy": Copy,
    "adaptive": Adaptive,
    "adaptive-mass": lambda config: Adaptive(config, adapts_mass=True),
    "oracle": Oracle,
    "memoryless": Memoryless,
    "lqg": lambda config: PairLqg(config) if config.autopilot.kind == "crazyflie" else Lqg(config),
    "lqg-slow": SlowLqg,
}


def make_law(name: str, config: Config) -> Law:
    """The classical follower called `name` with the gains that follow from `config`; raise InputError if unknown."""
    if name not in LAWS:
        raise InputError(f"unknown follower {name!r}; baselines are {', '.join(LAWS)}")
    return LAWS[name](config)


def make_baseline(name: str, config: Config) -> Baseline:
    """`make_law`, ready to fly."""
    return Baseline(make_law(name, config), config)


# What is flown when nobody names followers; the others are variants, flown by name and by the judge.
BASELINES = tuple(name for name in LAWS if name not in ("adaptive-mass", "lqg-slow"))
