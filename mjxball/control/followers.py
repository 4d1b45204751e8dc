"""What flies as a follower: laws as pure functions of NumPy or JAX arrays, and `Baseline`, which remembers for one."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from mjxball.config import Config
from mjxball.control.observation import copy_command
from mjxball.errors import InputError

Array = Any


class PrivilegedInfo(NamedTuple):
    """What the simulator knows and an observation does not show; every leaf has the observation's batch shape.

    Followers may read `believed_mass`. The rest is the truth, of the load half a control step and one rotor lag ahead,
    for followers with `needs_privileged` alone.
    """

    believed_mass: Array  # (...) mass of the object that the hover thrust assumes [kg]
    # (...) object mass x CG offset along the line; of teams and in the plane (..., 2) in each mount frame [kg m]
    moment: Array
    moment_acceleration: Array  # likewise, object mass x second derivative of the CG offset [kg m/s2]
    total_mass: Array  # (...) of the assembly [kg]
    thrust: Array | None = None  # (..., N) share of its asked forces that each drone gives now; None: all of them


class Law(Protocol):
    """A follower as two pure functions of arrays; `state` is a tuple of arrays (possibly empty)."""

    name: str
    needs_privileged: bool  # it reads the true CG from `PrivilegedInfo`

    def start(self, observation: Array) -> Any:
        """State at the start of a flight whose first observation is `observation` (..., 18)."""

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """(state, command (..., 3): roll, pitch [rad], vertical acceleration [m/s2]) at `observation` (..., 18)."""


class Follower(Protocol):
    """What flies as the follower: a `Baseline`, or `mjxball.policy.Policy`.

    Several followers of a team are called at once, as one batch axis more, each in its mount frame.
    """

    name: str

    def reset(self) -> None:
        """Start an episode with a fresh state."""

    def __call__(self, observation: Array) -> Array:
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18)."""


class Baseline:
    """A `Law` with its state. Set `privileged` before a call; without it the plant's own mass is believed."""

    def __init__(self, law: Law, config: Config):
        self.law, self.name = law, law.name
        self.privileged: PrivilegedInfo | None = None
        self._believed_mass = config.plant.object_mass
        self._state: Any = None

    def reset(self) -> None:
        """See `Follower.reset`."""
        self._state, self.privileged = None, None

    def __call__(self, observation: Array) -> Array:
        """See `Follower.__call__`. Raises InputError if the law needs `privileged` and it is not set."""
        if self._state is None:
            self._state = self.law.start(observation)
        privileged = self.privileged or self._nominal(observation)
        self._state, command = self.law.step(self._state, observation, privileged)
        return command

    def _nominal(self, observation: Array) -> PrivilegedInfo:
        if self.law.needs_privileged:
            raise InputError(f"follower {self.name!r} needs to know where the CG is; it flies in simulation only")
        zero = observation.__array_namespace__().zeros_like(observation[..., 0])
        return PrivilegedInfo(zero + self._believed_mass, zero, zero, zero)


class Copy:
    """The leader's PD law on the follower's own observation: the optimum of the paper's reward."""

    name = "copy"
    needs_privileged = False

    def __init__(self, config: Config):
        self._gains = copy_gains(config)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Law.step`."""
        return state, copy_command(observation, *self._gains)


def copy_gains(config: Config) -> tuple[Any, ...]:
    """The arguments of `observation.copy_command` after the observation, for the configured leader."""
    law, limits = config.leader, config.command
    return law.kp, law.kd, config.plant.gravity, limits.tilt_limit, limits.vertical_limit
