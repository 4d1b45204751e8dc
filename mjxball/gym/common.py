"""What the environments share: spaces, seeds, and what `info` tells."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import jax
import numpy as np
from jax._src import xla_bridge  # whether a device has been made: nothing public says it

from mjxball import config as configs
from mjxball.arrays import Array, real_numbers
from mjxball.config import Config
from mjxball.control.observation import ACTION_SIZE
from mjxball.env import TransportEnv
from mjxball.errors import InputError

THREADS = Path("/proc/self/task")
_home: dict[str, int] = {}  # number of the process in which JAX runs for the environments


def in_float32(method: Callable[..., Any]) -> Callable[..., Any]:
    """`method` with arrays of 32 bits, also where JAX_ENABLE_X64 is set: a seed draws the same worlds then."""

    @functools.wraps(method)
    def call(*arguments: Any, **named: Any) -> Any:
        if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
            return method(*arguments, **named)
        with jax.enable_x64(False):
            return method(*arguments, **named)

    return call


def check_process() -> None:
    """Raise InputError in a process that was forked from one in which JAX has run: it would hang there.

    Its threads are not in the copy: where JAX has a device and the process a single thread, it is a copy.
    """
    process = os.getpid()
    if _home.get("process") == process:
        return
    copied = xla_bridge.backends_are_initialized() and THREADS.is_dir() and len(list(THREADS.iterdir())) == 1
    if copied or _home.setdefault("process", process) != process:
        raise InputError(
            "this process was forked from one in which JAX runs, where it would wait for ever; start it with spawn, "
            "such as gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})"
        )


class Picklable:
    """An environment that is pickled with the state of its worlds, and compiled again where it arrives."""

    _compiled: ClassVar[tuple[str, ...]]  # attributes that `__init__` makes anew: functions and renderers

    def _arguments(self) -> dict[str, Any]:
        """Those of `__init__`."""
        raise NotImplementedError

    def __getstate__(self) -> dict[str, Any]:
        """(arguments, attributes)."""
        own = {name: value for name, value in self.__dict__.items() if name not in self._compiled}
        return {"arguments": self._arguments(), "attributes": own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """See `__getstate__`."""
        self.__init__(**state["arguments"])  # type: ignore[misc]
        self.__dict__.update(state["attributes"])


def settings(preset: str, config: Config | None) -> Config:
    """`config`, validated, or else the preset called `preset`; without a GRU: a trainer brings its own network."""
    found = configs.preset(preset) if config is None else configs.validate(config)
    return configs.replace(found, "follower.recurrent_units", 0)


def pair_settings(preset: str, config: Config | None) -> Config:
    """`settings`; InputError for a team, whose followers are several agents."""
    found = settings(preset, config)
    if found.plant.count > 2:
        followers = found.plant.count - 1
        raise InputError(
            f"this environment has one agent, and the plant {followers} followers; use mjxball.gym.parallel"
        )
    return found


def spaces(pair: TransportEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Spaces of observation (n,) and action (3,): what the follower sees and remembers, and [-1, 1]."""
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (pair.policy_input_size,), np.float32)
    return observations, gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)


def checked_action(action: Array, shape: tuple[int, ...] | None) -> np.ndarray:
    """`action` as float32, which the environment clips to the box [-1, 1].

    Raises InputError unless it is finite and of `shape`, and of real numbers.
    """
    given = real_numbers(action, f"an action of shape {shape}")
    if given.shape != shape:
        found = f"of shape {given.shape}"
    elif not np.isfinite(given).all():
        found = f"of shape {given.shape} with {given[~np.isfinite(given)][0]} in it"
    else:
        return np.clip(given, -1.0, 1.0).astype(np.float32)  # float32 would make infinity of 1e39
    raise InputError(f"an action must be finite numbers of shape {shape}, not {found}")


def seed_number(random: np.random.Generator) -> int:
    """The number that one world's keys come from, drawn from Gymnasium's generator."""
    return int(random.integers(2**32))


def info_of(state: Any) -> dict[str, Array]:
    """What `info` holds of a state: |e_o| [m], the squared command errors, and whether the world has diverged."""
    return {name: state.metrics[name] for name in ("error", "tilt_error", "vertical_error", "diverged")}
