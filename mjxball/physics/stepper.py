"""Choose an engine by name and step a batch of plants on NumPy arrays, in float64."""

from __future__ import annotations

import contextlib
import functools
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import ControlStep, make_control_step

TRAINING_ENGINES = ("mjx", "newton-euler")  # on JAX
ENGINES = (*TRAINING_ENGINES, "mujoco")


def make_stepper(config: Config, physics: str) -> ControlStep:
    """Return a control step for batches (n, ...) of NumPy float64 arrays; raise InputError for an unknown engine."""
    if physics == "mujoco":
        from mjxball.physics.mujoco import make_engine

        return make_control_step(config, make_engine(config.plant, config.attitude))
    if physics not in ENGINES:
        raise InputError(f"unknown physics {physics!r}; choose from {', '.join(ENGINES)}")
    return _jax_stepper(config, physics)


@functools.lru_cache(maxsize=8)  # compiling takes seconds
def _jax_stepper(config: Config, physics: str) -> ControlStep:
    import jax

    from mjxball.cache import enable_compilation_cache
    from mjxball.physics import mjx, newton_euler

    enable_compilation_cache()
    make = mjx.make_engine if physics == "mjx" else newton_euler.make_engine
    with jax.enable_x64(True), on_the_host():
        step = make_control_step(config, make(config.plant, config.attitude), mjx.jax_repeat)
        compiled = jax.jit(jax.vmap(step))

    def stepper(state: PlantState, commands: Any, load: Load) -> PlantState:
        with jax.enable_x64(True), on_the_host():
            return PlantState(*compiled(state, commands, load)).each(np.asarray)

    return stepper


def on_the_host() -> AbstractContextManager[Any]:
    """Compute on the CPU: a GPU takes 4 ms for each control step of a few worlds, most of it waiting."""
    import jax

    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX was told to leave the CPU alone
        return contextlib.nullcontext()
