"""The control step on split components: XLA fuses the closed form into few large kernels on a GPU."""

from __future__ import annotations

from typing import Any

from mjxball.config import Config
from mjxball.physics import newton_euler
from mjxball.physics.components import Namespace, join, split
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import ControlStep, Repeat, make_control_step, python_repeat

Array = Any
STATE_AXES = PlantState(1, 1, 1, 1, 2, 0, 0, 0, 2)  # trailing axes of every leaf
LOAD_AXES = (0, 0, 0, 0, 0, 1, 1)  # of the leaves that every load has


def split_state(state: PlantState) -> PlantState:
    """Every leaf of `state` as `Components`."""
    return state.each(split, STATE_AXES)


def split_load(load: Load) -> Load:
    """Every leaf of `load` as `Components`."""
    known, optional = load[: len(LOAD_AXES)], load[len(LOAD_AXES) :]
    if any(leaf is not None for leaf in optional):
        raise ValueError("the split road knows no push, and no rotors, inertia or CG path of a world's own")
    return Load(*map(split, known, LOAD_AXES))


def join_state(state: PlantState) -> PlantState:
    """The inverse of `split_state`."""
    return state.each(join)


def make_split_step(config: Config, repeat: Repeat = python_repeat) -> ControlStep:
    """Return the closed form's control step on split state, commands and load."""
    engine = newton_euler.make_engine(config.plant, config.attitude)

    def arrays_only(body: Any, count: int, value: PlantState) -> PlantState:
        return repeat(lambda state: body(state).each(Namespace.asarray), count, value)

    step = make_control_step(config, engine, arrays_only)

    def control_step(state: PlantState, commands: Array, load: Load) -> PlantState:
        return step(state, commands, load).each(Namespace.asarray)

    return control_step


def make_fused_step(config: Config) -> ControlStep:
    """Return the closed form's control step for JAX arrays of any batch shape; equal to the plain one to rounding.

    A waveform's table look-up and a Crazyflie's loops do not split: they take the plain road.
    """
    if config.motion.kind == "waveform" or config.autopilot.kind != "ideal":
        engine = newton_euler.make_engine(config.plant, config.attitude)
        return make_control_step(config, engine, python_repeat)
    step = make_split_step(config)

    def control_step(state: PlantState, commands: Array, load: Load) -> PlantState:
        return join_state(step(split_state(state), split(commands, 2), split_load(load)))

    return control_step
