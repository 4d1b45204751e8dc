"""What flies as a follower: laws as pure functions of NumPy or JAX arrays, and `Baseline`, which remembers for one."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjxball.arrays import Array, real_numbers
from mjxball.config import Config
from mjxball.control.observation import OBSERVATION, OBSERVATION_SIZE, copy_command
from mjxball.errors import InputError

LARGEST = 1e6  # sum of the absolute numbers of an observation: no flight comes near it, and float32 can filter it


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
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18).

        Raises InputError for what is no observation (`checked_observation`), and remembers nothing of it.
        """


def checked_observation(observation: Array) -> np.ndarray:
    """`observation` (..., 18) as float64; InputError, with the name of the number, unless a follower may see it.

    Real numbers, finite, their absolute sum below `LARGEST`. A follower that filters what it sees would otherwise
    remember one such number for the rest of the flight.
    """
    given = real_numbers(observation, "an observation")
    if given.shape[-1:] != (OBSERVATION_SIZE,):
        raise InputError(f"observation must have {OBSERVATION_SIZE} numbers last, not shape {given.shape}")
    seen = given.astype(np.float64)
    if given.ndim == 1:
        sound = sum(map(abs, seen.tolist())) < LARGEST  # of so few numbers a third of the time that NumPy needs
    else:
        sound = bool((np.abs(seen).sum(axis=-1) < LARGEST).all())
    if not sound:
        size = np.where(np.isnan(seen), np.inf, np.abs(seen))
        value, (name, unit) = seen.flat[int(size.argmax())], OBSERVATION[int(size.argmax()) % OBSERVATION_SIZE]
        raise InputError(
            f"an observation has {value:g} for {name} [{unit}], which no flight has; it was not answered, and nothing "
            "of it is remembered: call again with the next good one"
        )
    return seen


def checked_command(name: str, command: Any, observation: np.ndarray) -> np.ndarray:
    """`command` (..., 3) of follower `name` to `observation` (..., 18) as float64; InputError if it is none."""
    array, wanted = real_numbers(command, f"the answer of follower {name}"), (*observation.shape[:-1], 3)
    if array.shape != wanted:
        raise InputError(f"follower {name} answered shape {array.shape} where {wanted} was wanted")
    return array.astype(np.float64)


def check_batch(name: str, remembered: tuple[int, ...], observation: np.ndarray) -> None:
    """Raise InputError unless `observation` (..., 18) is of the flights of shape `remembered` (...) of `name`."""
    if observation.shape[:-1] != remembered:
        wanted = (*remembered, OBSERVATION_SIZE)
        raise InputError(
            f"follower {name} flies on observations of shape {wanted}, not {observation.shape}; reset it before others"
        )


_OF_THREAD = threading.local()


class OneThread:
    """The thread whose flight a follower remembers: the first that calls it after a reset.

    Two threads that call one follower by turns would each be answered from a mixture of both flights. A thread is known
    by an object of its own: its number, and what `threading` says of it, are given to a later one when it has ended.
    """

    def __init__(self) -> None:
        self._of: dict[str, object] = {}

    def check(self, name: str) -> None:
        """Raise RuntimeError if another thread has called follower `name` since its last reset."""
        here = _OF_THREAD.__dict__.setdefault("token", object())
        # `setdefault` is atomic, so that of two first callers one is refused.
        if self._of.setdefault("flight", here) is not here:
            raise RuntimeError(
                f"follower {name} remembers a flight of another thread: give every thread its own (copy.copy), "
                "reset it between flights, or keep the memory yourself (.law, which is pure)"
            )

    def forget(self) -> None:
        """Any thread may be the next."""
        self._of = {}

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which any thread may take."""
        return {"_of": {}}


class Baseline:
    """A `Law` with its state, for one flight of one thread at a time (see `OneThread`); `law` itself is pure.

    Set `privileged` before a call; without it the plant's own mass is believed.
    """

    def __init__(self, law: Law, config: Config):
        self.law, self.name = law, law.name
        self.privileged: PrivilegedInfo | None = None
        self._believed_mass = config.plant.object_mass
        self._state: Any = None
        self._batch: tuple[int, ...] = ()  # shape of the flights in `_state`
        self._thread = OneThread()

    def reset(self) -> None:
        """See `Follower.reset`."""
        self._state, self.privileged = None, None
        self._thread.forget()

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which go on by themselves."""
        return {**self.__dict__, "_thread": OneThread()}

    def __call__(self, observation: Array) -> Array:
        """See `Follower.__call__`. Raises InputError if the law needs `privileged` and it is not set."""
        observation = checked_observation(observation)
        if self._state is None:
            self._state, self._batch = self.law.start(observation), observation.shape[:-1]
        if not isinstance(self._state, tuple) or self._state:
            self._thread.check(self.name)
            check_batch(self.name, self._batch, observation)
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
