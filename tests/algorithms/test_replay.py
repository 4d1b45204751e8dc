"""The replay against a log that forgets nothing: ring buffer, n-step returns, endings, the write head."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.algorithms import replay
from mjxball.algorithms.replay import Transitions

WORLDS, CAPACITY, SEEN, ACTIONS = 3, 12, 2, 1
GAMMA = 0.5  # powers of two: returns of small integers are exact in float32


def label(world, time):
    """A number that says which world and step a row belongs to."""
    return 100.0 * world + time


def step_at(time: int, terminated=(), truncated=()) -> Transitions:
    """One recorded step of all worlds; `terminated` and `truncated` list worlds whose episode ends here."""
    worlds = np.arange(WORLDS)
    here = label(worlds, time)
    ended = np.isin(worlds, terminated)
    return Transitions(
        observation=jnp.asarray(np.stack([here, -here], axis=1), jnp.float32),
        action=jnp.asarray(0.25 * here[:, None], jnp.float32),
        reward=jnp.asarray(here, jnp.float32),
        discount=jnp.asarray(1.0 - ended, jnp.float32),
        next_observation=jnp.asarray(np.stack([here + 0.5, -here], axis=1), jnp.float32),
        last=jnp.asarray(ended | np.isin(worlds, truncated), jnp.float32),
    )


def empty() -> replay.Replay:
    return replay.create(CAPACITY, WORLDS, SEEN, ACTIONS)


def filled(steps: int, **endings) -> replay.Replay:
    """A buffer after `steps` recorded steps; `terminated={time: worlds}`, `truncated={time: worlds}`."""
    buffer = empty()
    for time in range(steps):
        here = {kind: by_time.get(time, ()) for kind, by_time in endings.items()}
        buffer = replay.insert(buffer, step_at(time, **here), jnp.asarray(True))
    return buffer


def draw(buffer: replay.Replay, steps: int, batch: int = 2000) -> Transitions:
    draws = jax.random.bits(jax.random.key(0), (batch,))
    sampled = replay.sample(buffer, draws, WORLDS, SEEN, ACTIONS, steps, GAMMA)
    return Transitions(*map(np.asarray, sampled))


def starts(sampled: Transitions) -> set[tuple[int, int]]:
    """(world, time) of every transition drawn."""
    return {divmod(int(number), 100) for number in sampled.observation[:, 0]}


def one_from(sampled: Transitions, world: int, time: int) -> Transitions:
    """A drawn transition that starts at (world, time)."""
    index = np.flatnonzero(sampled.observation[:, 0] == label(world, time))[0]
    return Transitions(*(column[index] for column in sampled))


@pytest.mark.parametrize("recorded", [1, 3, 4, 5, 7, 8, 9, 23])
def test_holds_the_newest_steps_and_nothing_else(recorded):
    """Capacity is 4 steps of 3 worlds; 2000 draws miss one of 12 rows with probability 1e-75."""
    kept = range(max(0, recorded - CAPACITY // WORLDS), recorded)
    assert starts(draw(filled(recorded), steps=1)) == {(world, time) for world in range(WORLDS) for time in kept}


def test_draws_uniformly():
    sampled = draw(filled(9), steps=1, batch=12_000)
    _, counts = np.unique(sampled.observation[:, 0], return_counts=True)
    # 1000 expected each; a binomial deviation is 30, six of them never happen by chance.
    assert np.abs(counts - 1000).max() < 180


def test_one_step_transition_comes_back_as_written():
    sampled = draw(filled(6, terminated={4: (1,)}, truncated={5: (2,)}), steps=1)
    for world in range(WORLDS):
        for time in range(2, 6):
            written = step_at(time, terminated=(1,) if time == 4 else (), truncated=(2,) if time == 5 else ())
            expected = Transitions(*(np.asarray(column)[world] for column in written))
            jax.tree.map(np.testing.assert_array_equal, one_from(sampled, world, time), expected)


@pytest.mark.parametrize("recorded", [0, 2, 4, 6])
def test_unrecorded_step_leaves_the_contents_alone(recorded):
    buffer = filled(recorded)
    after = replay.insert(buffer, step_at(77), jnp.asarray(False))
    np.testing.assert_array_equal(after.rows[:CAPACITY], buffer.rows[:CAPACITY])
    assert int(after.inserted) == int(buffer.inserted)


def test_return_of_three_steps_by_hand():
    transition = one_from(draw(filled(6), steps=3), world=1, time=2)
    assert transition.reward == 102 + GAMMA * 103 + GAMMA**2 * 104
    assert transition.discount == GAMMA**2  # the critic's own gamma makes it gamma^3
    np.testing.assert_array_equal(transition.observation, [102, -102])
    np.testing.assert_array_equal(transition.next_observation, [104.5, -104])
    assert transition.action == 0.25 * 102


def test_return_stops_at_a_termination_and_does_not_bootstrap():
    transition = one_from(draw(filled(6, terminated={3: (1,)}), steps=3), world=1, time=2)
    assert transition.reward == 102 + GAMMA * 103
    assert transition.discount == 0
    assert transition.last == 1


def test_return_stops_at_a_time_limit_and_bootstraps_there():
    transition = one_from(draw(filled(6, truncated={3: (1,)}), steps=3), world=1, time=2)
    assert transition.reward == 102 + GAMMA * 103
    assert transition.discount == GAMMA
    np.testing.assert_array_equal(transition.next_observation, [103.5, -103])  # not the world after the reset


@pytest.mark.parametrize(("kind", "discount"), [("terminated", 0.0), ("truncated", 1.0)])
def test_return_of_an_episode_that_ends_at_once_is_one_reward(kind, discount):
    transition = one_from(draw(filled(6, **{kind: {2: (1,)}}), steps=3), world=1, time=2)
    assert transition.reward == 102
    assert transition.discount == discount
    np.testing.assert_array_equal(transition.next_observation, [102.5, -102])


def test_ending_of_one_world_does_not_end_its_neighbours():
    sampled = draw(filled(6, terminated={3: (1,)}), steps=3)
    for world in (0, 2):
        transition = one_from(sampled, world, 2)
        assert transition.reward == label(world, 2) + GAMMA * label(world, 3) + GAMMA**2 * label(world, 4)
        assert transition.discount == GAMMA**2


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
@pytest.mark.parametrize("recorded", [4, 5, 6, 7, 8, 13])
def test_returns_never_mix_worlds_nor_cross_the_write_head(recorded, steps):
    """Every draw against the log: each return uses its own world's next steps, all of them still recorded."""
    sampled = draw(filled(recorded), steps)
    oldest, newest = max(0, recorded - CAPACITY // WORLDS), recorded - 1
    assert starts(sampled) == {(w, t) for w in range(WORLDS) for t in range(oldest, newest - steps + 2)}
    world, time = np.divmod(sampled.observation[:, 0], 100)
    expected = sum(GAMMA**k * label(world, time + k) for k in range(steps))
    np.testing.assert_array_equal(sampled.reward, expected)
    np.testing.assert_array_equal(sampled.next_observation[:, 0], label(world, time + steps - 1) + 0.5)


def test_counter_is_folded_and_the_ring_goes_on():
    buffer = empty()
    insert = jax.jit(replay.insert)
    for time in range(50):
        buffer = insert(buffer, step_at(time), jnp.asarray(True))
        recorded = (time + 1) * WORLDS
        assert int(buffer.inserted) % CAPACITY == recorded % CAPACITY
        assert int(buffer.inserted) == recorded or CAPACITY <= int(buffer.inserted) < 2 * CAPACITY
    assert starts(draw(buffer, steps=1)) == {(world, time) for world in range(WORLDS) for time in range(46, 50)}
