"""A whole control period, stepped and differentiated, as one kernel each: Pallas on a GPU beside what XLA makes of it.

`python benchmarks/period_kernel.py [--worlds 32 256 1024] [--block 32] [--train 120] [--json FILE]`

The environment's step of `transport` in closed form is rewritten number by number (`algorithms/scalar_form.py`); a
kernel keeps every number of a block of worlds in registers, one world a thread: laws, physics steps in a loop, sensors,
reward. A second kernel goes back: it loads the plant's state before each physics step, computes that step again and
pulls the cotangents through it. The network stays with XLA. For each number of worlds: both kernels' gradient of a
window of `gradient.horizon` steps against XLA's own (largest difference over the largest entry), and the median times
of the window with its gradient. `--train N` then trains N gradients both ways, from the same start: seconds without
compiling, and the last windows' loss. `--interpret` runs the kernels on a CPU through Pallas's interpreter; `--lower`
only translates them to Triton, which needs no GPU before jax 0.11.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from mjxball import config as configs
from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.algorithms.scalar_form import _evaluate, _parts
from mjxball.physics import newton_euler
from mjxball.physics.step import make_control_step
from mjxball.train.extensions import Extensions
from mjxball.train.program import Program, train, warmup
from training import say, versions

Numbers = list[Any]  # arrays (block,), one for each number of a tree of arrays


def size_of(tree: Any) -> int:
    """How many numbers a tree of shapes has."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))


def by_numbers(function: Callable[..., Any], *shapes: Any) -> Callable[[Numbers], Numbers]:
    """`function` of trees of `shapes` as one of their numbers, all float32, over a block of worlds."""
    leaves, structure = jax.tree.flatten(shapes)
    closed = jax.make_jaxpr(lambda *own: jax.tree.leaves(function(*jax.tree.unflatten(structure, own))))(*leaves)

    def one(numbers: Numbers) -> Numbers:
        values, rest = [], list(numbers)
        for leaf in leaves:
            parts = np.empty(math.prod(leaf.shape), object)
            for k in range(parts.size):
                parts[k] = rest[k] > 0.5 if leaf.dtype == bool else rest[k].astype(leaf.dtype)
            values.append(parts.reshape(leaf.shape))
            rest = rest[parts.size :]
        found = _evaluate(closed.jaxpr, [np.asarray(one) for one in closed.consts], values)
        return [
            jnp.asarray(number).astype(jnp.float32)
            for value, variable in zip(found, closed.jaxpr.outvars, strict=True)
            for number in _parts(value, variable.aval).ravel()
        ]

    return jax.vmap(one)


class Period:
    """One control period of all worlds: `step(states, action)` as `jax.vmap(env.step)`, by the kernels."""

    def __init__(self, env: Any, block: int, interpret: bool):
        self._block, self._interpret = block, interpret
        self._state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        action = jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
        world = self._state.pipeline_state
        plant, load = world.loop.plant, world.load
        commands, _ = jax.eval_shape(env.commands, self._state, action)
        self._count = env.config.timing.physics_steps
        engine = newton_euler.make_engine(env.config.plant, env.config.attitude)
        once = make_control_step(env.config, engine, lambda body, count, value: body(value))
        self._pre = by_numbers(lambda state, action: env.commands(state, action)[0], self._state, action)
        self._step = by_numbers(once, plant, commands, load)
        self._post = by_numbers(
            lambda state, action, moved: env.step(state, action, lambda *_: moved), self._state, action, plant
        )
        # Where plant and load stand among the numbers of a state.
        names = jax.tree.unflatten(jax.tree.structure(self._state), self._rows())
        self._plant = np.concatenate(jax.tree.leaves(names.pipeline_state.loop.plant))
        self._load = np.concatenate(jax.tree.leaves(names.pipeline_state.load))
        self.size, self._actions, self._commands = size_of(self._state), env.action_size, size_of(commands)
        self._packed_step = jax.custom_vjp(lambda packed, action: self._forward(packed, action)[0])
        self._packed_step.defvjp(self._with_residuals, self._backward)

    def _rows(self) -> list[np.ndarray]:
        sizes = [math.prod(leaf.shape) for leaf in jax.tree.leaves(self._state)]
        ends = np.cumsum(sizes)
        return [np.arange(end - size, end) for end, size in zip(ends, sizes, strict=True)]

    def step(self, states: Any, action: Any) -> Any:
        """States of all worlds (worlds, ...) one control period later at `action` (worlds, 3)."""
        leaves = [leaf.astype(jnp.float32).reshape(len(action), -1) for leaf in jax.tree.leaves(states)]
        packed = self._packed_step(jnp.concatenate(leaves, axis=1).T, action.T)
        moved = [
            (packed[rows[0] : rows[-1] + 1].T.reshape(leaf.shape) > 0.5)
            if leaf.dtype == bool
            else packed[rows[0] : rows[-1] + 1].T.reshape(leaf.shape).astype(leaf.dtype)
            for rows, leaf in zip(self._rows(), jax.tree.leaves(states), strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(states), moved)

    def _call(self, kernel: Callable[..., None], rows: Sequence[int], *arrays: Any) -> Any:
        worlds = arrays[0].shape[1]

        def own(count: int) -> pl.BlockSpec:
            return pl.BlockSpec((count, self._block), lambda number: (0, number))

        return pl.pallas_call(
            kernel,
            grid=(worlds // self._block,),
            in_specs=[own(array.shape[0]) for array in arrays],
            out_specs=[own(count) for count in rows],
            out_shape=[jax.ShapeDtypeStruct((count, worlds), jnp.float32) for count in rows],
            compiler_params=None if self._interpret else triton.CompilerParams(num_warps=max(self._block // 32, 1)),
            interpret=self._interpret,
        )(*arrays)

    def _forward(self, packed: Any, action: Any) -> Any:
        size = len(self._plant)

        def kernel(packed: Any, action: Any, out: Any, middle: Any) -> None:
            state, given = _read(packed, self.size), _read(action, self._actions)
            commands, load = self._pre([*state, *given]), [state[k] for k in self._load]

            def once(number: Any, plant: Numbers) -> Numbers:
                _write(middle, plant, number * size)
                return self._step([*plant, *commands, *load])

            plant = jax.lax.fori_loop(0, self._count, once, [state[k] for k in self._plant])
            _write(middle, plant, self._count * size)
            _write(out, self._post([*state, *given, *plant]))

        return self._call(kernel, (self.size, (self._count + 1) * size), packed, action)

    def _with_residuals(self, packed: Any, action: Any) -> Any:
        out, middle = self._forward(packed, action)
        return out, (packed, action, middle)

    def _backward(self, kept: Any, slope: Any) -> Any:
        size, commanded = len(self._plant), self._commands

        def kernel(packed: Any, action: Any, middle: Any, slope: Any, to_state: Any, to_action: Any) -> None:
            state, given = _read(packed, self.size), _read(action, self._actions)
            moved = _read(middle, size, self._count * size)
            _, back = jax.vjp(self._post, [*state, *given, *moved])
            (found,) = back(_read(slope, self.size))
            along, to_plant = found[: self.size + self._actions], found[self.size + self._actions :]
            commands, back = jax.vjp(self._pre, [*state, *given])
            load = [state[k] for k in self._load]

            def once(number: Any, carry: tuple[Numbers, Numbers]) -> tuple[Numbers, Numbers]:
                plant = _read(middle, size, (self._count - 1 - number) * size)
                _, pull = jax.vjp(self._step, [*plant, *commands, *load])
                (found,) = pull(carry[0])
                summed = [a + b for a, b in zip(carry[1], found[size : size + commanded], strict=True)]
                return found[:size], summed

            to_plant, to_commands = jax.lax.fori_loop(
                0, self._count, once, (to_plant, [jnp.zeros_like(one) for one in commands])
            )
            (more,) = back(to_commands)
            along = [a + b for a, b in zip(along, more, strict=True)]
            for k, own in zip(self._plant, to_plant, strict=True):
                along[k] = along[k] + own
            _write(to_state, along[: self.size])
            _write(to_action, along[self.size :])

        return tuple(self._call(kernel, (self.size, self._actions), *kept, slope))


def _read(ref: Any, count: int, first: Any = 0) -> Numbers:
    return [ref[first + k, :] for k in range(count)]


def _write(ref: Any, numbers: Numbers, first: Any = 0) -> None:
    for k, number in enumerate(numbers):
        ref[first + k, :] = number


def make_program(worlds: int, period: Callable[[Any], Period] | None) -> Program:
    """The training program of first-order gradients on `worlds`, with XLA's own step or the kernels'."""

    class Algorithm(FirstOrderGradient):
        def __init__(self, config: Any, environments: Any):
            super().__init__(config, environments)
            if period and environments.count == worlds:
                self._environments = environments.rewritten(lambda step: step)
                self._environments._step = period(environments.env).step

    settings = configs.replace(configs.preset("transport"), "gradient.num_envs", worlds)
    return Program(settings, "newton-euler", extensions=Extensions(algorithm=Algorithm))


def window(program: Program) -> Any:
    """`f(state)`: loss of a window and its gradient."""
    algorithm: Any = program.algorithm

    def differentiate(state: Any) -> Any:
        envs = program.environments.begin(state.envs, 1.0)
        with jax.default_matmul_precision("highest"):
            (loss, _), slope = jax.value_and_grad(algorithm._window, has_aux=True)(
                state.algorithm.layers, state.algorithm, envs
            )
        return loss, slope

    return differentiate


def timed(function: Callable[..., Any], *arguments: Any, times: int = 9) -> float:
    """Median seconds of `function`."""
    found = []
    for _ in range(times):
        began = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        found.append(time.perf_counter() - began)
    return statistics.median(found)


def compare(worlds: int, period: Callable[[Any], Period], times: int) -> dict[str, Any]:
    """Times and gradients of one window both ways, from the same state of a policy that is no longer the first."""
    row: dict[str, Any] = {"worlds": worlds}
    state = jax.jit(make_program(worlds, None).create)(jax.random.PRNGKey(0))
    moved = jax.tree.map(
        lambda leaf: leaf + 0.05 * jnp.sin(jnp.arange(leaf.size)).reshape(leaf.shape), state.algorithm.layers
    )
    state = state._replace(algorithm=state.algorithm._replace(layers=moved))
    found = {}
    for name, own in (("xla", None), ("kernel", period)):
        began = time.perf_counter()
        compiled = jax.jit(window(make_program(worlds, own))).lower(state).compile()
        row[f"{name}_compile"] = time.perf_counter() - began
        found[name] = jax.device_get(compiled(state))
        row[f"{name}_window"] = timed(compiled, state, times=times)
    (loss, slope), (own_loss, own_slope) = found["xla"], found["kernel"]
    largest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(slope))
    differences = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), slope, own_slope)
    row |= {"loss": float(loss), "loss_difference": abs(float(loss - own_loss))}
    row |= {"largest": largest, "difference": max(jax.tree.leaves(differences)) / largest}
    row["ratio"] = row["xla_window"] / row["kernel_window"]
    return row


def trained(worlds: int, gradients: int, period: Callable[[Any], Period] | None) -> dict[str, Any]:
    """Seconds of a training of `gradients` without compiling, and the mean loss of its last ten windows."""
    program = make_program(worlds, period)
    create, horizon = jax.jit(program.create), program.algorithm.steps_per_collect
    advance = jax.jit(program.advance)
    state = create(jax.random.PRNGKey(0))
    began = time.perf_counter()
    jax.block_until_ready(advance(state, train(0)))
    compiled = time.perf_counter() - began
    began = time.perf_counter()
    state, *_ = advance(state, warmup(horizon))
    state, *_ = advance(state, train((gradients - 10) * horizon))
    losses = []
    for _ in range(10):
        state, _, metrics = advance(state, train(horizon))
        losses.append(float(metrics["loss"]))
    return {
        "worlds": worlds,
        "kernel": period is not None,
        "compile": compiled,
        "train": time.perf_counter() - began,
        "loss": statistics.mean(losses),
    }


def main() -> None:
    """Compare, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=[32, 256, 1024])
    parser.add_argument("--block", type=int, default=32, help="worlds of one program of a kernel")
    parser.add_argument("--times", type=int, default=9)
    parser.add_argument("--train", type=int, default=0, metavar="N", help="gradients of a training both ways")
    parser.add_argument("--interpret", action="store_true")
    parser.add_argument("--lower", action="store_true")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()

    def period(env: Any) -> Period:
        return Period(env, options.block, options.interpret)

    if options.lower:
        program = make_program(options.worlds[0], period)
        state = jax.eval_shape(program.create, jax.random.PRNGKey(0))
        text = jax.jit(window(program)).trace(state).lower(lowering_platforms=("cuda",)).as_text()
        print(f"{text.count('custom_call')} calls of kernels and others, {len(text)} characters")
        return
    found: dict[str, Any] = {"block": options.block, "windows": [], "training": []}
    for worlds in options.worlds:
        found["windows"].append(compare(worlds, period, options.times))
        say(found["windows"][-1])
    for own in (None, period) if options.train else ():
        for worlds in options.worlds if own else options.worlds[:1]:
            found["training"].append(trained(worlds, options.train, own))
            say(found["training"][-1])
    found["versions"] = versions()
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
