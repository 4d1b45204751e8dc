"""Rewards: the paper's by hand, and what the task reward's shape promises near the goal and far from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.config import Reward
from mjxball.rewards import RewardInputs, paper_reward, reward, task_reward

ZERO = np.zeros(3)
ERROR_ONLY = Reward(error=2.0, error_scale=0.1, velocity=0, tilt=0, rates=0, effort=0, smoothness=0)


STILL = RewardInputs(
    *[ZERO] * 10, tilt_disagreement=0.0, spread=ZERO, ball=ZERO[:1], rotors=None, terminated=np.array(False)
)


def task(weights=ERROR_ONLY, **parts):
    return task_reward(weights, STILL._replace(**{name: np.asarray(value, float) for name, value in parts.items()}))


def test_paper_reward_is_ten_times_the_absolute_differences():
    leader, follower = np.array([0.1, -0.2, 1.0]), np.array([0.15, 0.1, 0.4])
    assert paper_reward(leader, follower) == pytest.approx(-10 * (0.05 + 0.3 + 0.6), rel=1e-15)
    assert paper_reward(leader, leader) == 0
    np.testing.assert_array_equal(
        paper_reward(np.stack([leader, leader]), np.stack([follower, leader])),
        [paper_reward(leader, follower), 0],
    )


def test_task_reward_is_zero_at_the_goal_and_nowhere_positive():
    assert task(Reward()) == 0
    random = np.random.default_rng(0)
    everything = Reward(tilt=1.0)
    names = ("error", "velocity", "euler", "rates", "action", "last_action")
    rewards = [task(everything, **dict(zip(names, random.normal(size=(6, 3)), strict=True))) for _ in range(20)]
    assert max(rewards) < 0


def test_rotors_cost_only_within_a_tenth_of_their_largest_force_of_a_limit():
    weights = Reward(error=0, rotor_limits=3.0)
    assert task(weights, rotors=[0.1, 0.5, 0.9]) == 0
    assert task(weights, rotors=[0.04, 0.5, 1.0]) == pytest.approx(-3.0 * (0.06**2 + 0.1**2), rel=1e-12)


def test_error_cost_is_quadratic_near_the_goal():
    distance = 1e-3
    # w (e/s)^2 / 2; the next term of the series is smaller by (e/s)^2 / 4 = 2.5e-5.
    assert task(error=[distance, 0, 0]) == pytest.approx(-2.0 * (distance / 0.1) ** 2 / 2, rel=5e-5)


def test_error_cost_is_linear_far_from_the_goal():
    far, farther = task(error=[0, 10.0, 0]), task(error=[0, 11.0, 0])
    # Slope w/s, less by (s/e)^2 / 2 = 5e-5.
    assert far - farther == pytest.approx(2.0 / 0.1, rel=1e-4)
    assert far == pytest.approx(-2.0 * (10.0 / 0.1 - 1), rel=1e-4)


def test_error_cost_depends_on_the_distance_alone():
    assert task(error=[0.3, 0, 0]) == pytest.approx(task(error=[0.1, -0.2, 0.2]), rel=1e-14)


def test_error_cost_has_a_finite_gradient_at_the_goal():
    zero = jnp.zeros(3)
    still = jax.tree.map(jnp.asarray, STILL)
    gradient = jax.jit(jax.grad(lambda error: task_reward(Reward(), still._replace(error=error))))(zero)
    np.testing.assert_array_equal(gradient, zero)


@pytest.mark.parametrize(
    ("weights", "values", "expected"),
    [
        ({"velocity": 3.0}, {"velocity": [1.0, 2.0, -2.0]}, -27.0),
        ({"tilt": 3.0}, {"euler": [1.0, 2.0, 100.0]}, -15.0),  # yaw is no tilt
        ({"rates": 3.0}, {"rates": [1.0, 2.0, -2.0]}, -27.0),
        ({"effort": 3.0}, {"action": [1.0, 0.0, -1.0], "last_action": [1.0, 0.0, -1.0]}, -6.0),
        ({"steady_action": 3.0}, {"action_average": [1.0, 0.5, 0.0]}, -3.75),
        ({"tilt_disagreement": 3.0}, {"tilt_disagreement": -0.5}, -0.75),
        ({"spread": 3.0}, {"spread": [1.0, -0.5, 2.0]}, -3.87),
        ({"ball": 3.0}, {"ball": [-0.5]}, -0.75),
        ({"command_change": 3.0}, {"command_change": [1.0, -0.5, 0.0]}, -3.75),
        ({"command_change": 3.0}, {"command_change": [0.0, 0.0, 2.0]}, -0.12),  # a hundredth for 1 (m/s2)^2
        ({"smoothness": 3.0}, {"action": [1.0, 0.5, 0.0], "last_action": [0.0, 0.5, -1.0]}, -6.0),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_each_weight_scales_its_own_square(weights, values, expected):
    off = {"error": 0.0, "velocity": 0.0, "tilt": 0.0, "rates": 0.0, "effort": 0.0, "smoothness": 0.0}
    assert task(Reward(**{**off, **weights}), **values) == pytest.approx(expected, rel=1e-15)


def test_a_termination_costs_its_weight_once_and_for_both_kinds():
    ended = STILL._replace(terminated=np.array([True, False]))
    for kind in ("task", "paper"):
        np.testing.assert_array_equal(reward(Reward(kind=kind, termination=7.0), ended), [-7.0, 0.0])
