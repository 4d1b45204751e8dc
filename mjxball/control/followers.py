"""Interfaces of followers: controllers as pure functions on arrays, and `Baseline`, which keeps one flight's state."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjxball.arrays import Array, real_numbers
from mjxball.config import Config
from mjxball.control.observation import OBSERVATION, OBSERVATION_SIZE, copy_command
from mjxball.errors import InputError

# Sum of the absolute numbers of an observation: no flight comes near it, and float32 can filter it.
MAX_OBSERVATION = 1e6


class PrivilegedInfo(NamedTuple):
    """Simulator state that an observation does not contain; every leaf has the observation's batch shape.

    Any follower may read `believed_mass`. The other fields are the present truth, for followers with `needs_privileged`
    alone.
    """

    believed_mass: Array  # (...) mass of the object that the hover thrust assumes [kg]
    # (...) object mass x CG offset on a line; for teams and in the plane (..., 2), in each mount frame [kg m]
    moment: Array
    moment_acceleration: Array  # likewise, object mass x second derivative of the CG offset [kg m/s2]
    total_mass: Array  # (...) of the assembly [kg]
    thrust: Array | None = None  # (..., N) present factor on each drone's rotor forces; None: 1
    moment_rate: Array = None  # as `moment`, object mass x rate of the CG offset [kg m/s]
    rotors: Array = None  # (..., N, 3) lift [N], roll and pitch torque [N m] of each drone's rotors, body axes
    force: Array | None = None  # (..., 3) of wind and pushes on the assembly, in the axes of the observation [N]
    loop_scale: Array | None = None  # (...) factor on the attitude loops' natural frequency; None: 1
    loops: Array = None  # (..., N, 13) of Crazyflies, see `control.crazyflie.Loops`

    @classmethod
    def of_believed(cls, believed_mass: Array) -> PrivilegedInfo:
        """What any follower may read: `believed_mass` (...), and zeros instead of the rest."""
        zero = 0.0 * believed_mass
        return cls(believed_mass, zero, zero, zero)

    def without_truth(self) -> PrivilegedInfo:
        """The same for a follower without `needs_privileged`, so that one which wrongly says so learns nothing."""
        return self.of_believed(self.believed_mass)


class Controller(Protocol):
    """A follower's controller as two pure functions of arrays; `state` is a tuple of arrays (possibly empty)."""

    name: str
    needs_privileged: bool  # it reads the true CG from `PrivilegedInfo`

    def start(self, observation: Array) -> Any:
        """State at the start of a flight whose first observation is `observation` (..., 18)."""

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """(state, command (..., 3): roll, pitch [rad], vertical acceleration [m/s2]) at `observation` (..., 18)."""


class Follower(Protocol):
    """A follower that keeps its state: a `Baseline`, or `mjxball.policy.Policy`.

    The followers of a team are called at once along one more batch axis, each with values in its mount frame.
    """

    name: str

    def reset(self) -> None:
        """Start an episode with a fresh state."""

    def __call__(self, observation: Array) -> Array:
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18).

        Raises InputError for an invalid observation (`checked_observation`) and leaves the state as it was.
        """


def checked_observation(observation: Array) -> np.ndarray:
    """`observation` (..., 18) as float64. Raises InputError that names the bad component if it is invalid.

    Valid are finite real values with an absolute sum below `MAX_OBSERVATION`. A follower that filters observations
    would otherwise carry one bad value for the rest of the flight.
    """
    given = real_numbers(observation, "an observation")
    if given.shape[-1:] != (OBSERVATION_SIZE,):
        raise InputError(f"observation must have {OBSERVATION_SIZE} numbers last, not shape {given.shape}")
    values = given.astype(np.float64)
    if given.ndim == 1:
        valid = sum(map(abs, values.tolist())) < MAX_OBSERVATION  # for so few values three times as fast as NumPy
    else:
        valid = bool((np.abs(values).sum(axis=-1) < MAX_OBSERVATION).all())
    if not valid:
        size = np.where(np.isnan(values), np.inf, np.abs(values))
        value, (name, unit) = values.flat[int(size.argmax())], OBSERVATION[int(size.argmax()) % OBSERVATION_SIZE]
        raise InputError(
            f"an observation has {value:g} for {name} [{unit}], which no flight has; it was not answered, and nothing "
            "of it is remembered: call again with the next good one"
        )
    return values


def checked_command(name: str, command: Any, observation: np.ndarray) -> np.ndarray:
    """`command` (..., 3) of follower `name` to `observation` (..., 18) as float64; InputError if it is not one."""
    array, wanted = real_numbers(command, f"the answer of follower {name}"), (*observation.shape[:-1], 3)
    if array.shape != wanted:
        raise InputError(f"follower {name} answered shape {array.shape} where {wanted} was wanted")
    return array.astype(np.float64)


def check_batch(name: str, remembered: tuple[int, ...], observation: np.ndarray) -> None:
    """Raise InputError unless `observation` (..., 18) has the batch shape `remembered` of the flights of `name`."""
    if observation.shape[:-1] != remembered:
        wanted = (*remembered, OBSERVATION_SIZE)
        raise InputError(
            f"follower {name} flies on observations of shape {wanted}, not {observation.shape}; reset it before others"
        )


_OF_THREAD = threading.local()


class OneThread:
    """The thread whose flight a follower keeps state for: the first that calls it after a reset.

    Two threads that call one follower in turn would each get answers from a mixture of both flights. Each thread is
    known by an object in its thread-local storage, because thread numbers are reused when a thread has ended.
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
                "reset it between flights, or keep the memory yourself (.controller, which is pure)"
            )

    def forget(self) -> None:
        """Let any thread be the next to call."""
        self._of = {}

    def __getstate__(self) -> dict[str, Any]:
        """A copy may be called by any thread."""
        return {"_of": {}}


class Baseline:
    """A `Controller` with its state, for one flight of one thread at a time (see `OneThread`); `controller` itself is
    pure.

    Set `privileged` before a call; without it the mass of `config.plant` is assumed.
    """

    def __init__(self, controller: Controller, config: Config):
        self.controller, self.name = controller, controller.name
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
        """A copy keeps the flight's state and may be called by any thread."""
        return {**self.__dict__, "_thread": OneThread()}

    def __call__(self, observation: Array) -> Array:
        """See `Follower.__call__`. Raises InputError if the controller needs `privileged` and it is not set."""
        observation = checked_observation(observation)
        if self._state is None:
            self._state, self._batch = self.controller.start(observation), observation.shape[:-1]
        if not isinstance(self._state, tuple) or self._state:
            self._thread.check(self.name)
            check_batch(self.name, self._batch, observation)
        privileged = self.privileged or self._nominal(observation)
        self._state, command = self.controller.step(self._state, observation, privileged)
        return command

    def _nominal(self, observation: Array) -> PrivilegedInfo:
        if self.controller.needs_privileged:
            raise InputError(f"follower {self.name!r} needs to know where the CG is; it flies in simulation only")
        zero = observation.__array_namespace__().zeros_like(observation[..., 0])
        return PrivilegedInfo.of_believed(zero + self._believed_mass)


class Copy:
    """The leader's PD controller on the follower's own observation: the optimum of the paper's reward."""

    name = "copy"
    needs_privileged = False

    def __init__(self, config: Config):
        self._gains = copy_gains(config)

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        return state, copy_command(observation, *self._gains)


def copy_gains(config: Config) -> tuple[Any, ...]:
    """The arguments of `observation.copy_command` after the observation, for the configured leader."""
    leader, limits = config.leader, config.command
    return leader.kp, leader.kd, config.plant.gravity, limits.tilt_limit, limits.vertical_limit
