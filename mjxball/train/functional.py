"""Training as a pure function: `policy, metrics = train(config, key)`; can be jitted, and vmapped over many runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball.algorithms.base import Phase, PolicyNetwork
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.terminal import warn
from mjxball.train import program as programs
from mjxball.train.extensions import Extensions
from mjxball.train.live import LiveCurve, Report, in_notebook
from mjxball.train.loop import Plan
from mjxball.train.program import Mode, Program, TrainState


def train(
    config: Config,
    key: Array,
    *,
    physics: str = "mjx",
    env: Any = None,
    reward: Any = None,
    algorithm: Any = None,
    overrides: Mapping[str, Any] | None = None,
    evaluate: bool = True,
    on_progress: bool | Report | None = None,
) -> tuple[PolicyNetwork, dict[str, Array]]:
    """Train a follower from `key` (`jax.random.PRNGKey(seed)` gives the run of `train.py --seed`) without any file.

    `env`: a Brax environment, or a class or function of (config, physics) that makes one. `reward`: a function of
    (state, action, next state). `algorithm`: a class, see `mjxball.algorithms.base.Algorithm`. `overrides`: numbers by
    the setting's name, which may be traced: `jax.vmap(lambda rate: train(config, key, overrides={"sac.learning_rate":
    rate}))(rates)`. Returns the policy, which can be called with an observation, and of each evaluation
    (`num_evaluations`,): `steps`, `episode_return` (exploring), the algorithm's metrics, `eval_return`, and the
    means of the environment's metrics as `eval_<name>`. Without `evaluate` it trains in one stretch, and what is named
    `eval_` holds nothing. `mjxball.train.compilation.compiler_options()` are the options with which `train.py` compiles
    sooner. `jax.shard_map` of it needs `check_vma=False`. `on_progress`: True for a live curve in a notebook, which is
    the default there, or a function that is told how it goes (`live.Report`); then it cannot be traced, and steps in
    turns; Ctrl-C ends it with the policy and the metrics so far.
    Raises InputError if one of them does not fit.
    """
    traced = any(isinstance(value, jax.core.Tracer) for value in (key, *(overrides or {}).values()))
    if traced and on_progress:
        raise InputError(
            "train() is traced, by jax.jit or jax.vmap, and cannot show its progress: leave on_progress out"
        )
    if on_progress and not callable(on_progress) and not in_notebook():
        raise InputError("train(on_progress=True) draws in a notebook; elsewhere give a function that is told the rows")
    if on_progress is None:
        on_progress = in_notebook() and not traced
    report = on_progress if callable(on_progress) else LiveCurve(f"training {config.preset}") if on_progress else None
    with jax.enable_x64(False):  # float32 throughout, also where the user's own program is not
        return _train(config, key, physics, Extensions(env, reward, algorithm), overrides, evaluate, report)


def _train(
    config: Config,
    key: Array,
    physics: str,
    extensions: Extensions,
    overrides: Mapping[str, Any] | None,
    evaluate: bool,
    report: Report | None,
) -> tuple[PolicyNetwork, dict[str, Array]]:
    program = Program(config, physics, overrides, extensions=extensions)
    program.algorithm.check_parts(1)
    state = program.create(key)
    fresh = program.evaluation_envs(jax.random.PRNGKey(0)) if evaluate else state.envs
    episode = config.timing.episode_steps

    def phase(carry: TrainState, mode: Mode) -> tuple[TrainState, dict[str, Array]]:
        evaluating = mode.phase.evaluate
        envs = jax.tree.map(lambda new, old: jnp.where(evaluating, new, old), fresh, carry.envs)
        after, statistics, metrics = program.advance(carry._replace(envs=envs), mode)
        kept = jax.tree.map(lambda old, new: jnp.where(evaluating, old, new), carry, after)
        explored = statistics.reward / jnp.maximum(mode.steps, 1) * episode
        evaluated = program.evaluated_return(statistics.reward, statistics.ended)
        returned = jnp.where(evaluating, evaluated, explored)
        count = mode.steps * program.schedule.num_envs
        own = {f"eval_{name}": total / jnp.maximum(count, 1) for name, total in statistics.totals.items()}
        return kept, {"steps": kept.steps, "return": returned, **metrics, **own}

    modes = _phases(program, evaluate)
    if report:
        state, seen = _in_turns(phase, state, modes, program, report)
    else:
        state, seen = jax.lax.scan(phase, state, modes)
    # Behind the warm-up.
    trained, evaluated = slice(1, None, 2), slice(2, None, 2)
    metrics = {name: seen[name][trained] for name in ("steps", *program.algorithm.metrics)}
    metrics |= {"episode_return": seen["return"][trained], "eval_return": seen["return"][evaluated]}
    metrics |= {name: value[evaluated] for name, value in seen.items() if name.startswith("eval_")}
    return program.policy(state), metrics


def _in_turns(phase: Any, state: TrainState, modes: Mode, program: Program, report: Report) -> tuple[TrainState, Any]:
    """As `jax.lax.scan` of `phase`, with training in the parts of `loop.Plan`, after each of which there is a `report`.

    Ctrl-C ends it with what is trained by then; before anything is, it is raised.
    """
    turn, most = jax.jit(phase), Plan.of(program).chunk
    seen: list[dict[str, Array]] = []
    try:
        for number in range(len(modes.steps)):
            mode = jax.tree.map(lambda leaf, number=number: leaf[number], modes)
            left, total, returned = int(mode.steps), int(mode.steps), 0.0
            while True:
                part = min(left, most) if mode.phase.learning else left
                state, found = turn(state, mode._replace(steps=np.int32(part)))
                left, returned = left - part, returned + found["return"] * part / max(total, 1)
                name = "eval_return" if mode.phase.evaluate else "episode_return"
                if total:
                    told = {"steps": float(found["steps"]), name: float(found["return"])}
                    report({**told, "total": float(program.schedule.total_steps)})
                if left <= 0:
                    break
            seen.append({**found, "return": returned})
    except KeyboardInterrupt:
        if not seen:
            raise
        warn(f"stopped after {int(state.steps):,} of {program.schedule.total_steps:,} steps: the policy is that of now")
    return state, jax.tree.map(lambda *values: jnp.stack(values), *seen)


def _phases(program: Program, evaluate: bool) -> Mode:
    """The warm-up, then training and evaluation in turns, or training alone; stacked."""
    first, total = program.warmup_rounds, max(program.total_rounds, program.warmup_rounds)
    window = program.algorithm.steps_per_collect
    stretches = program.schedule.num_evaluations if evaluate else 1
    ends = np.round(np.linspace(first, total, stretches + 1) / window).astype(int) * window
    found = [programs.warmup(first)]
    for steps in np.diff(ends):
        found += [programs.train(int(steps)), programs.evaluate(program.evaluation_steps)][: 1 + evaluate]
    return Mode(
        np.stack([mode.steps for mode in found]),
        Phase(*(np.stack(list(flags)) for flags in zip(*(mode.phase for mode in found), strict=True))),
    )
