"""The training program: it continues exactly, evaluates without a trace, repeats itself, and learns."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import with_settings

from mjxball import config as configs
from mjxball.train import program as programs
from mjxball.train.environments import Statistics
from mjxball.train.program import TrainingProgram, TrainState

pytestmark = pytest.mark.slow  # trainings
WORLDS = 128


class Compiled(NamedTuple):
    """A program with its jitted functions."""

    program: TrainingProgram
    create: Any  # key -> TrainState
    advance: Any  # (TrainState, Mode) -> (TrainState, Statistics)
    fresh: Any  # key -> worlds


@pytest.fixture(scope="module")
def compiled(transport) -> Compiled:
    """The transport preset, shortened to 128 000 environment steps, on closed-form physics."""
    steps = 128_000
    program = TrainingProgram(
        with_settings(
            transport, sac={"total_steps": steps, "replay_size": steps, "num_envs": WORLDS, "updates_per_step": 4}
        ),
        "newton-euler",
    )
    return Compiled(program, *map(jax.jit, (program.create, program.advance, program.environments.reset)))


@pytest.fixture(scope="module")
def prefilled(compiled) -> TrainState:
    """A state with enough transitions to learn from."""
    return compiled.advance(compiled.create(jax.random.key(0)), programs.warmup_mode(20))[0]


def raw(tree: Any) -> Any:
    """`tree` with its typed random keys as plain numbers."""
    return jax.tree.map(
        lambda leaf: jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf, tree
    )


def assert_identical(first: Any, second: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, raw(first), raw(second))


@pytest.mark.parametrize("name", configs.PRESETS)
def test_a_training_state_has_no_array_without_elements(name: str) -> None:
    """Over several GPUs XLA's partitioner ends the process by a segfault on one."""
    state = jax.eval_shape(TrainingProgram(configs.preset(name), "newton-euler").create, jax.random.PRNGKey(0))
    assert all(leaf.size for leaf in jax.tree.leaves(state))


def with_learner(state: TrainState, **parts: Any) -> TrainState:
    """`state` with parts of the learner replaced."""
    known = state.algorithm
    return state._replace(algorithm=known._replace(learner=known.learner._replace(**parts)))


def recorded(state: TrainState) -> np.ndarray:
    """The replay's rows without the scratch rows behind them."""
    return np.asarray(state.algorithm.replay.rows[:-WORLDS])


def evaluated_return(compiled: Compiled, state: TrainState, steps: int = 500) -> float:
    """Mean reward per step on the same fresh worlds every time."""
    worlds = compiled.fresh(jax.random.key(99))
    _, statistics, *_ = compiled.advance(state._replace(envs=worlds), programs.evaluate_mode(steps))
    assert int(statistics.totals["diverged"]) == 0
    return float(statistics.reward) / steps


def test_prefill_records_every_step_and_learns_nothing(compiled, prefilled):
    fresh = compiled.create(jax.random.key(0))
    assert int(prefilled.steps) == int(prefilled.algorithm.replay.inserted) == 20 * WORLDS
    assert_identical(prefilled.algorithm.learner.policy, fresh.algorithm.learner.policy)
    rows = recorded(prefilled)
    assert (np.abs(rows[: 20 * WORLDS]).sum(axis=1) > 0).all()
    np.testing.assert_array_equal(rows[20 * WORLDS :], 0)


def test_normaliser_holds_the_statistics_of_what_was_seen(compiled, prefilled):
    seen = recorded(prefilled)[: 20 * WORLDS, : compiled.program.environments.observation_size].astype(np.float64)
    # Float32 sums over 2560 rows, against float64.
    np.testing.assert_allclose(prefilled.algorithm.learner.normaliser.mean, seen.mean(axis=0), rtol=0, atol=1e-5)
    np.testing.assert_allclose(prefilled.algorithm.learner.normaliser.std, seen.std(axis=0), rtol=1e-3, atol=1e-5)


def test_training_counts_its_updates_and_changes_the_policy(compiled, prefilled):
    after, *_ = compiled.advance(prefilled, programs.train_mode(3))
    assert int(after.steps - prefilled.steps) == 3 * WORLDS
    moved = jax.tree.map(
        lambda a, b: float(jnp.abs(a - b).max()), after.algorithm.learner.policy, prefilled.algorithm.learner.policy
    )
    assert min(jax.tree.leaves(moved)) > 0


def test_two_calls_equal_one_bit_for_bit(compiled, prefilled):
    """A resumed run is the run."""
    whole, *_ = compiled.advance(prefilled, programs.train_mode(5))
    half, *_ = compiled.advance(prefilled, programs.train_mode(2))
    both, *_ = compiled.advance(half, programs.train_mode(3))
    assert_identical(both, whole)


def test_evaluation_leaves_learner_and_replay_untouched(compiled, prefilled):
    trained, *_ = compiled.advance(prefilled, programs.train_mode(2))
    after, *_ = compiled.advance(trained, programs.evaluate_mode(30))
    assert_identical(after.algorithm.learner, trained.algorithm.learner)
    np.testing.assert_array_equal(recorded(after), recorded(trained))
    assert int(after.algorithm.replay.inserted) == int(trained.algorithm.replay.inserted)
    assert int(after.steps) == int(trained.steps)


def test_evaluation_does_not_depend_on_the_exploration_key(compiled, prefilled):
    """The deterministic mean of the averaged policy: the key decides nothing before the first reset."""
    keys = [prefilled._replace(key=jax.random.key(seed)) for seed in (1, 2)]
    first, second = (evaluated_return(compiled, state, steps=50) for state in keys)
    assert first == second


def test_evaluation_flies_the_averaged_policy(compiled, prefilled):
    shifted = jax.tree.map(lambda leaf: leaf + 0.1, prefilled.algorithm.learner.policy)
    base = evaluated_return(compiled, prefilled, steps=50)
    policy = with_learner(prefilled, policy=shifted)
    average = with_learner(prefilled, average=shifted)
    assert evaluated_return(compiled, policy, steps=50) == base
    assert evaluated_return(compiled, average, steps=50) != base


def run(state: TrainState, advance: Any) -> TrainState:
    """Ten random steps and two of training."""
    state, *_ = advance(state, programs.warmup_mode(10))
    return advance(state, programs.train_mode(2))[0]


def test_same_seed_same_run_and_another_seed_another(compiled):
    first, second, other = (run(compiled.create(jax.random.key(seed)), compiled.advance) for seed in (3, 3, 4))
    assert_identical(first, second)
    assert (recorded(first)[:WORLDS] != recorded(other)[:WORLDS]).any(axis=1).all()


class Ending(NamedTuple):
    """What the program recorded of one step in which every world ended."""

    after: TrainState
    statistics: Statistics
    discount: np.ndarray  # (worlds,)
    next_observation: np.ndarray  # (worlds, n)
    last: np.ndarray  # (worlds,)


def end_all_worlds(compiled: Compiled, prefilled: TrainState, **parts: Any) -> Ending:
    """Step all worlds once after replacing `parts` of them, and read the newest rows."""
    worlds = prefilled.envs
    ending = worlds.replace(pipeline_state=worlds.pipeline_state._replace(**parts))
    after, statistics, *_ = compiled.advance(prefilled._replace(envs=ending), programs.warmup_mode(1))
    newest = recorded(after)[20 * WORLDS : 21 * WORLDS]
    seen = compiled.program.environments.observation_size
    np.testing.assert_array_equal(after.envs.pipeline_state.steps, 0)  # all start anew
    np.testing.assert_array_equal(after.envs.pipeline_state.plant.position, 0.0)
    return Ending(after, statistics, newest[:, seen + 4], newest[:, seen + 5 : 2 * seen + 5], newest[:, 2 * seen + 5])


def test_lost_worlds_are_terminations(compiled, prefilled):
    """Every world beyond d_term: nothing to bootstrap from, and the recorded next observation is the lost one."""
    loop = prefilled.envs.pipeline_state.loop
    lost = loop._replace(plant=loop.plant._replace(position=loop.plant.position + 10.0))
    ending = end_all_worlds(compiled, prefilled, loop=lost)
    assert (int(ending.statistics.ended), int(ending.statistics.totals["diverged"])) == (WORLDS, 0)
    np.testing.assert_array_equal(ending.discount, 0)
    np.testing.assert_array_equal(ending.last, 1)
    assert (ending.next_observation[:, :3] > 5).all()


def test_time_limits_are_bootstrapped(compiled, prefilled):
    """The episode ends, its value does not: the next observation is the true one, not the fresh world's."""
    steps = prefilled.envs.pipeline_state.steps
    limit = compiled.program.config.timing.episode_steps
    ending = end_all_worlds(compiled, prefilled, steps=jnp.full_like(steps, limit - 1))
    assert int(ending.statistics.ended) == 0
    np.testing.assert_array_equal(ending.discount, 1)
    np.testing.assert_array_equal(ending.last, 1)
    assert (ending.next_observation != np.asarray(ending.after.envs.obs)).any(axis=1).all()


def test_short_training_improves_the_evaluation(compiled):
    state, *_ = compiled.advance(compiled.create(jax.random.key(0)), programs.warmup_mode(100))
    before = evaluated_return(compiled, state)
    state, _, metrics = compiled.advance(state, programs.train_mode(900))
    after = evaluated_return(compiled, state)
    assert np.isfinite(list(metrics.values())).all()
    # Seen: -20 before and -2 after. A quarter is far beyond the noise of 128 worlds and far from what fails.
    assert after > before / 4
