"""The closed form's control step as one GPU kernel (Pallas on Triton): a world's whole state stays in registers."""

from __future__ import annotations

from typing import Any

import jax
from jax.experimental import pallas as pl

from mjxball.config import Config
from mjxball.physics.components import Components
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.fused import make_split_step
from mjxball.physics.step import ControlStep

Array = Any
BLOCK = 128  # worlds of one program, a thread each


def make_kernel_step(config: Config, block: int = BLOCK, interpret: bool = False) -> ControlStep:
    """Return the control step on split state, commands and load of (worlds,) arrays.

    `worlds` must be a multiple of `block`. `interpret` runs it without a GPU, slowly, for tests. It computes
    what `fused.make_split_step` computes, to rounding (Triton's sine, arcsine and arctangent differ in the
    last bits).
    """
    step = make_split_step(config, _loop)

    def control_step(state: PlantState, commands: Components, load: Load) -> PlantState:
        arguments = (state, commands, load)
        inputs, structure = jax.tree_util.tree_flatten(arguments)
        outputs, shape_of_result = jax.tree_util.tree_flatten(state)
        worlds = inputs[0].shape[0]
        if worlds % block:
            raise ValueError(f"worlds must be a multiple of {block}, not {worlds}")

        def kernel(*references: Any) -> None:
            sources, targets = references[: len(inputs)], references[len(inputs) :]
            moved = step(*jax.tree_util.tree_unflatten(structure, [source[...] for source in sources]))
            for target, value in zip(targets, jax.tree_util.tree_leaves(moved), strict=True):
                target[...] = value

        piece = pl.BlockSpec((block,), lambda i: (i,))
        results = pl.pallas_call(
            kernel,
            grid=(worlds // block,),
            in_specs=[piece] * len(inputs),
            out_specs=[piece] * len(outputs),
            out_shape=[jax.ShapeDtypeStruct(value.shape, value.dtype) for value in outputs],
            # In place: a loop that carries the state then copies nothing between two kernels.
            input_output_aliases={number: number for number in range(len(outputs))},
            interpret=interpret,
        )(*inputs)
        return jax.tree_util.tree_unflatten(shape_of_result, results)

    return control_step


def _loop(body: Any, count: int, value: PlantState) -> PlantState:
    """A loop inside the kernel: unrolling would quadruple Triton's compile time."""
    return jax.lax.fori_loop(0, count, lambda _, state: body(state), value)
