"""What the network sees besides the newest observation."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.control.observation import OBSERVATION, OWN_STATE, STALE, ObservationHistory

FULL = ObservationHistory(previous_action=True, filters=(0.1, 0.5), period=0.02)
NOTICING = FULL._replace(stale=True)


@pytest.mark.parametrize(
    ("history", "size", "shown"),
    [
        (ObservationHistory(), 0, 0),
        (ObservationHistory(previous_action=True), 3, 3),
        (ObservationHistory(filters=(0.1,)), 21, 21),
        (FULL, 42 + 3, 42 + 3),
        (ObservationHistory(stale=True), 12, 1),
        (NOTICING, 42 + 3 + 12, 42 + 3 + 1),
    ],
)
def test_size_is_what_the_memory_holds(history: ObservationHistory, size: int, shown: int) -> None:
    seen = np.arange(18.0)
    memory = history.start(seen)
    assert history.size == size
    assert memory.shape == (size,)
    assert history.next(memory, seen, np.zeros(3)).shape == (size,)
    assert history.input_size == shown
    assert history.network_input(seen, memory).shape == (18 + shown,)
    assert len(history.mask(ignore_position=True)) == 18 + shown


def test_memory_starts_as_if_the_first_observation_had_always_been() -> None:
    seen = np.arange(18.0)
    memory = FULL.start(seen)
    np.testing.assert_array_equal(memory, [*seen, 0, 0, 0, *seen, 0, 0, 0, 0, 0, 0])
    shown = FULL.network_input(seen, memory)
    np.testing.assert_array_equal(shown, [*seen, *[0] * 42, 0, 0, 0])


def test_the_last_action_stands_at_the_end() -> None:
    memory = FULL.next(FULL.start(np.zeros(18)), np.zeros(18), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(memory[-3:], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(FULL.network_input(np.zeros(18), memory)[-3:], [0.1, 0.2, 0.3])


def test_the_slowest_action_is_that_of_the_longest_average() -> None:
    """After one step with the action 1 an average of tau has come 1 - exp(-T / tau) of the way, whatever the order."""
    for filters in ((0.1, 0.5), (0.5, 0.1)):
        history = FULL._replace(filters=filters)
        memory = history.next(history.start(np.zeros(18)), np.zeros(18), np.ones(3))
        np.testing.assert_allclose(history.slowest_action(memory), 1 - math.exp(-0.02 / 0.5), rtol=1e-12)


def test_a_ramp_lags_its_average_by_the_time_constant() -> None:
    """In the long run the average of k t is k (t - tau_d), with tau_d = T q / (1 - q) of the sampled filter."""
    history = ObservationHistory(filters=(0.1,), period=0.02)
    memory = history.start(np.zeros(18))
    for number in range(200):
        memory = history.next(memory, np.full(18, 0.02 * number), np.full(3, 0.5))
    shown = history.network_input(np.full(18, 0.02 * 200), memory)
    q = math.exp(-0.02 / 0.1)
    np.testing.assert_allclose(shown[18:36], -0.02 / (1 - q), rtol=1e-12)
    np.testing.assert_allclose(shown[36:], 0.5, rtol=1e-12)


def test_memory_without_extras_is_empty_and_the_network_sees_the_observation_alone() -> None:
    seen = np.arange(18.0)
    np.testing.assert_array_equal(ObservationHistory().network_input(seen, ObservationHistory().start(seen)), seen)


def test_memory_of_a_batch_is_the_memory_of_each() -> None:
    random = np.random.default_rng(0)
    seen, action, first = random.normal(size=(4, 18)), random.normal(size=(4, 3)), random.normal(size=(4, 18))
    memory = FULL.start(first)
    batch = FULL.next(memory, seen, action)
    np.testing.assert_array_equal(batch[2], FULL.next(memory[2], seen[2], action[2]))
    np.testing.assert_array_equal(FULL.network_input(seen, batch)[2], FULL.network_input(seen[2], batch[2]))


def test_a_measurement_that_repeats_the_last_is_told() -> None:
    """Not the first one, nor one that differs in a single number by one bit; the goal does not matter."""
    random = np.random.default_rng(2)
    for history in (ObservationHistory(stale=True), NOTICING):
        plain = history._replace(stale=False)
        for dtype in (np.float32, np.float64):
            first = random.normal(size=18).astype(dtype)
            memory = history.start(first)
            assert history.network_input(first, memory)[-1] == 0
            action = random.normal(size=3).astype(dtype)
            memory = history.next(memory, first, action)
            for other_goal in (False, True):
                seen = first.copy()
                seen[OWN_STATE:] += other_goal
                shown = history.network_input(seen, memory)
                assert shown[-1] == dtype(STALE)
                assert shown.dtype == memory.dtype == dtype
                np.testing.assert_array_equal(shown[:-1], plain.network_input(seen, memory[: plain.size]))
            for slot in range(OWN_STATE):
                seen = first.copy()
                seen[slot] = np.nextafter(seen[slot], dtype(9))
                assert history.network_input(seen, memory)[-1] == 0
                after = history.next(memory, seen, action)
                assert history.network_input(first, after)[-1] == 0  # the last measurement counts, not one before
                assert history.network_input(seen, after)[-1] == dtype(STALE)


def test_each_of_a_batch_is_told_of_its_own_repeats_in_numpy_and_jax() -> None:
    random = np.random.default_rng(3)
    first, action = (random.normal(size=(2, 3, size)).astype(np.float32) for size in (18, 3))
    seen = first + np.float32([[[0], [1], [0]], [[1], [0], [1]]])
    memory = NOTICING.next(NOTICING.start(first), first, action)
    shown = NOTICING.network_input(seen, memory)
    np.testing.assert_array_equal(shown[..., -1], np.float32([[STALE, 0, STALE], [0, STALE, 0]]))
    traced = jax.jit(NOTICING.network_input)(jnp.asarray(seen), jnp.asarray(memory))
    assert traced.dtype == np.float32
    np.testing.assert_array_equal(traced, shown)


def test_mask_hides_every_absolute_position_and_nothing_else() -> None:
    names = [name for name, _ in OBSERVATION] + ["average"] * 42 + ["action"] * 3
    mask = FULL.mask(ignore_position=True)
    hidden = [name for name, used in zip(names, mask, strict=True) if used == 0.0]
    assert hidden == ["follower_x", "follower_y", "follower_z"]
    assert set(mask) == {0.0, 1.0}
    assert FULL.mask(ignore_position=False) == [1.0] * len(names)


def test_moving_the_whole_flight_changes_no_number_that_is_shown() -> None:
    random = np.random.default_rng(1)
    history = FULL
    shift = np.array([5.0, -3.0, 2.0, *[0.0] * 15])
    here, there = history.start(np.zeros(18)), history.start(shift)
    for _ in range(20):
        seen, action = random.normal(size=18), random.normal(size=3)
        here, there = history.next(here, seen, action), history.next(there, seen + shift, action)
    mask = np.array(history.mask(ignore_position=True))
    first, second = (history.network_input(s, m) * mask for s, m in ((seen, here), (seen + shift, there)))
    np.testing.assert_allclose(first, second, atol=1e-12)
