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
from mjxball.train import program as programs
from mjxball.train.extensions import Extensions
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
) -> tuple[PolicyNetwork, dict[str, Array]]:
    """Train a follower from `key` (`jax.random.PRNGKey(seed)` gives the run of `train.py --seed`) without any file.

    `env`: a Brax environment, or a class or function of (config, physics) that makes one. `reward`: a function of
    (state, action, next state). `algorithm`: a class, see `mjxball.algorithms.base.Algorithm`. `overrides`: numbers by
    the setting's name, which may be traced: `jax.vmap(lambda rate: train(config, key, overrides={"sac.learning_rate":
    rate}))(rates)`. Returns the policy, which can be called with an observation, and of each evaluation
    (`num_evaluations`,): `steps`, `episode_return` (exploring), the algorithm's metrics, `eval_return`, and the
    means of the environment's metrics as `eval_<name>`. Without `evaluate` it trains in one stretch, and what is named
    `eval_` holds nothing. `mjxball.train.compilation.compiler_options()` are the options with which `train.py` compiles
    sooner. `jax.shard_map` of it needs `check_vma=False`. Raises InputError if one of them does not fit.
    """
    with jax.enable_x64(False):  # float32 throughout, also where the user's own program is not
        return _train(config, key, physics, Extensions(env, reward, algorithm), overrides, evaluate)


def _train(
    config: Config,
    key: Array,
    physics: str,
    extensions: Extensions,
    overrides: Mapping[str, Any] | None,
    evaluate: bool,
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
    state, seen = jax.lax.scan(phase, state, modes)
    # Behind the warm-up.
    trained, evaluated = slice(1, None, 2), slice(2, None, 2)
    metrics = {name: seen[name][trained] for name in ("steps", *program.algorithm.metrics)}
    metrics |= {"episode_return": seen["return"][trained], "eval_return": seen["return"][evaluated]}
    metrics |= {name: value[evaluated] for name, value in seen.items() if name.startswith("eval_")}
    return program.policy(state), metrics


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
