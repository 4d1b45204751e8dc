"""Training as a pure function, `policy, metrics = train(config, key)`, which can be jitted and vmapped over runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball.algorithms.base import PolicyNetwork, TrainingPhase
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.terminal import warn
from mjxball.train import program as programs
from mjxball.train.extensions import Extensions
from mjxball.train.live import LiveCurve, Report, in_notebook
from mjxball.train.loop import Plan
from mjxball.train.program import Mode, TrainingProgram, TrainState


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
    """Train a follower from `key` without writing files. `jax.random.PRNGKey(seed)` gives the run of `train.py --seed`.

    `env`: a Brax environment, or a class or function of (config, physics) that makes one. `reward`: a function of
    (state, action, next state). `algorithm`: a class, see `mjxball.algorithms.base.Algorithm`. `overrides`: values by
    the setting's name, which may be traced: `jax.vmap(lambda rate: train(config, key, overrides={"sac.learning_rate":
    rate}))(rates)`. `on_progress`: a function that is called with the progress (`live.Report`), or True for a live
    curve in a notebook, the default there; the call then cannot be traced, and Ctrl-C ends it early.

    Returns the policy, a function of an observation, and metrics, one entry per evaluation (`num_evaluations`,):
    `steps`, `episode_return` (exploring), the algorithm's metrics, `eval_return`, and means of the environment's
    metrics as `eval_<name>`. Without `evaluate` there is one entry, and arrays named `eval_` are empty. Raises
    InputError for arguments that do not fit.

    `mjxball.train.compilation.compiler_options()` shortens compilation. `jax.shard_map` of it needs `check_vma=False`.
    """
    traced = any(isinstance(value, jax.core.Tracer) for value in (key, *(overrides or {}).values()))
    if traced and on_progress:
        raise InputError(
            "train() is traced, by jax.jit or jax.vmap, and cannot show its progress: leave on_progress out"
        )
    if on_progress and not callable(on_progress) and not in_notebook():
        raise InputError(
            "train(on_progress=True) draws in a notebook; elsewhere give a function that is called with the rows"
        )
    if on_progress is None:
        on_progress = in_notebook() and not traced
    report = on_progress if callable(on_progress) else LiveCurve(f"training {config.preset}") if on_progress else None
    with jax.enable_x64(False):  # float32 throughout, even if the calling program uses float64
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
    program = TrainingProgram(config, physics, overrides, extensions=extensions)
    program.algorithm.check_parts(1)
    state = program.create(key)
    fresh = program.evaluation_envs(jax.random.PRNGKey(0)) if evaluate else state.envs
    episode = config.timing.episode_steps

    def phase(carry: TrainState, mode: Mode) -> tuple[TrainState, dict[str, Array]]:
        evaluating = mode.phase.evaluate
        envs = jax.tree.map(lambda new, old: jnp.where(evaluating, new, old), fresh, carry.envs)
        after, statistics, metrics = program.advance(carry._replace(envs=envs), mode)
        following = jax.tree.map(lambda old, new: jnp.where(evaluating, old, new), carry, after)
        explored = statistics.reward / jnp.maximum(mode.steps, 1) * episode
        evaluated = program.evaluated_return(statistics.reward, statistics.ended)
        returned = jnp.where(evaluating, evaluated, explored)
        count = mode.steps * program.schedule.num_envs
        means = {f"eval_{name}": total / jnp.maximum(count, 1) for name, total in statistics.totals.items()}
        return following, {"steps": following.steps, "return": returned, **metrics, **means}

    modes = _phases(program, evaluate)
    if report:
        state, seen = _in_turns(phase, state, modes, program, report)
    else:
        state, seen = jax.lax.scan(phase, state, modes)
    # The first entry is the warm-up.
    trained, evaluated = slice(1, None, 2), slice(2, None, 2)
    metrics = {name: seen[name][trained] for name in ("steps", *program.algorithm.metrics)}
    metrics |= {"episode_return": seen["return"][trained], "eval_return": seen["return"][evaluated]}
    metrics |= {name: value[evaluated] for name, value in seen.items() if name.startswith("eval_")}
    return program.policy(state), metrics


def _in_turns(
    phase: Any, state: TrainState, modes: Mode, program: TrainingProgram, report: Report
) -> tuple[TrainState, Any]:
    """`jax.lax.scan` of `phase` as a loop in Python, with a `report` after each chunk of training (`loop.Plan`).

    Ctrl-C returns the state and the metrics so far; before the first phase has ended it is raised.
    """
    compiled, chunk = jax.jit(phase), Plan.of(program).chunk
    seen: list[dict[str, Array]] = []
    try:
        for index in range(len(modes.steps)):
            mode = jax.tree.map(lambda leaf, index=index: leaf[index], modes)
            left, total, returned = int(mode.steps), int(mode.steps), 0.0
            while True:
                part = min(left, chunk) if mode.phase.learning else left
                state, metrics = compiled(state, mode._replace(steps=np.int32(part)))
                left, returned = left - part, returned + metrics["return"] * part / max(total, 1)
                name = "eval_return" if mode.phase.evaluate else "episode_return"
                if total:
                    row = {"steps": float(metrics["steps"]), name: float(metrics["return"])}
                    report({**row, "total": float(program.schedule.total_steps)})
                if left <= 0:
                    break
            seen.append({**metrics, "return": returned})
    except KeyboardInterrupt:
        if not seen:
            raise
        warn(f"stopped after {int(state.steps):,} of {program.schedule.total_steps:,} steps: the policy is that of now")
    return state, jax.tree.map(lambda *values: jnp.stack(values), *seen)


def _phases(program: TrainingProgram, evaluate: bool) -> Mode:
    """Stacked modes of a whole training: the warm-up, then training and evaluation alternating, or training alone."""
    first, total = program.warmup_steps_each, max(program.total_steps_each, program.warmup_steps_each)
    window = program.algorithm.steps_per_collect
    stretches = program.schedule.num_evaluations if evaluate else 1
    ends = np.round(np.linspace(first, total, stretches + 1) / window).astype(int) * window
    modes = [programs.warmup_mode(first)]
    for steps in np.diff(ends):
        modes += [programs.train_mode(int(steps)), programs.evaluate_mode(program.evaluation_steps)][: 1 + evaluate]
    return Mode(
        np.stack([mode.steps for mode in modes]),
        TrainingPhase(*(np.stack(list(flags)) for flags in zip(*(mode.phase for mode in modes), strict=True))),
    )
