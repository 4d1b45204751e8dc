"""Soft actor-critic on problems whose answer is known in closed form."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.algorithms import sac
from mjxball.algorithms.replay import Transitions
from mjxball.config import Sac, preset

SMALL = Sac(policy_layers=(16,), critic_layers=(32, 32), learning_rate=3e-3, alpha_fixed=True)
PAPER = dataclasses.replace(SMALL, state_value=True, num_critics=1)  # the paper's V, Q and pi
ADAPTIVE = dataclasses.replace(SMALL, alpha_fixed=False)
BATCH, UPDATES = 256, 3000
STATE = jnp.zeros((1, 1))  # the only state of every problem here
RATE = jnp.ones(())


class Loop(NamedTuple):
    """A problem with one state and one action a: reward - weight (a - best)^2, then the same state again."""

    reward: float = 0.0
    weight: float = 0.0
    best: float = 0.0
    continues: float = 0.0  # 0: every step terminates

    def batch(self, key: Any) -> Transitions:
        action = jax.random.uniform(key, (BATCH, 1), minval=-1, maxval=1)
        seen, one = jnp.zeros((BATCH, 1)), jnp.ones(BATCH)
        reward = self.reward - self.weight * (action[:, 0] - self.best) ** 2
        return Transitions(seen, action, reward, self.continues * one, seen, 1 - self.continues * one)


@functools.cache
def parts(config: Sac) -> tuple[Any, sac.Learner]:
    """Networks that see one number and act with one, and a fresh learner."""
    networks = sac.make_networks(config, (1.0,), 1)
    return networks, sac.create(networks, config, 1, jax.random.key(0))


@functools.cache
def compiled(config: Sac, updates: int) -> Any:
    """`run(changes, learner, loop, rate)`: `updates` updates; `changes` of the config are traced, to compile once."""

    def run(changes: dict[str, Any], learner: sac.Learner, loop: Loop, rate: Any) -> tuple[sac.Learner, sac.Losses]:
        update = sac.make_update(parts(config)[0], dataclasses.replace(config, **changes), 1)

        def body(learner: sac.Learner, key: Any) -> tuple[sac.Learner, sac.Losses]:
            data_key, update_key = jax.random.split(key)
            return update(learner, loop.batch(data_key), jax.random.normal(update_key, (2, BATCH, 1)), rate)

        return jax.lax.scan(body, learner, jax.random.split(jax.random.key(5), updates))

    return jax.jit(run)


TRACED = ("target_entropy", "tau", "learning_rate")  # settings that differ between tests


def one_update(rate: float = 1.0, config: Sac = ADAPTIVE, **changes: float) -> tuple[sac.Learner, sac.Learner, float]:
    """(learner before, learner after one update, entropy) on a bandit."""
    changes = {name: jnp.asarray(changes.get(name, getattr(config, name))) for name in TRACED}
    before = parts(config)[1]
    # Away from their sources, which they equal at the start.
    shifted = {name: jax.tree.map(lambda leaf: leaf + 0.5, getattr(before, name)) for name in ("target", "average")}
    before = before._replace(**shifted)
    after, losses = compiled(config, 1)(changes, before, Loop(weight=2.0, best=0.3), jnp.asarray(rate))
    return before, after, float(losses.entropy[0])


def learn(
    loop: Loop, alpha: float, discount: float = 0.0, reward_scale: float = 1.0, config: Sac = SMALL
) -> sac.Learner:
    """The learner after `UPDATES` updates with a fixed temperature `alpha`."""
    changes = {"discount": jnp.asarray(discount), "reward_scale": jnp.asarray(reward_scale), "tau": RATE * 0.1}
    learner = parts(config)[1]._replace(log_alpha=jnp.log(jnp.asarray(alpha)))
    loop = Loop(*(jnp.asarray(number) for number in loop))
    return compiled(config, UPDATES)(changes, learner, loop, RATE)[0]


def soft_values(learner: sac.Learner, config: Sac = SMALL) -> np.ndarray:
    """Q (5, critics) at five actions."""
    network = parts(config)[0].q_network
    actions = jnp.linspace(-0.8, 0.8, 5)[:, None]
    return np.asarray(network.apply(learner.normaliser, learner.critic, jnp.zeros((5, 1)), actions))


def largest_difference(first: Any, second: Any) -> float:
    gaps = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), first, second)
    return float(max(jax.tree.leaves(gaps)))


@pytest.mark.parametrize(("target", "direction"), [(0.68, 1), (-3.0, -1)], ids=["too little entropy", "too much"])
def test_alpha_moves_towards_the_target_entropy(target, direction):
    """Entropy on [-1, 1] is at most log 2 = 0.69: a fresh policy lies between the two targets."""
    before, after, entropy = one_update(target_entropy=target)
    assert np.sign(target - entropy) == direction
    assert np.sign(float(after.log_alpha - before.log_alpha)) == direction


def test_fixed_alpha_stays():
    before, after, _ = one_update(config=SMALL, target_entropy=5.0)
    assert float(after.log_alpha) == float(before.log_alpha) == pytest.approx(math.log(SMALL.alpha), rel=1e-6)  # f32


def test_target_critic_moves_by_tau():
    before, after, _ = one_update(tau=0.125)
    expected = jax.tree.map(lambda new, old: 0.125 * new + 0.875 * old, after.critic, before.target)
    assert largest_difference(after.target, expected) < 2e-7  # float32, weights up to 1
    assert largest_difference(after.target, before.target) > 1e-4


def test_the_critic_learns_from_the_slow_copy():
    """What follows is worth what the target says: with all else equal another target is another error."""
    changes = {name: jnp.asarray(getattr(ADAPTIVE, name)) for name in TRACED}
    before = parts(ADAPTIVE)[1]
    errors = []
    for shift in (0.0, 0.5):
        learner = before._replace(target=jax.tree.map(lambda leaf, shift=shift: leaf + shift, before.target))
        errors.append(compiled(ADAPTIVE, 1)(changes, learner, Loop(reward=0.1, continues=1.0), RATE)[1].critic[0])
    assert abs(float(errors[1] - errors[0])) > 1e-2  # the weights of 32 units are half a unit larger


def test_average_policy_moves_by_its_rate():
    before, after, _ = one_update()
    rate = sac.POLICY_EMA_RATE
    expected = jax.tree.map(lambda new, old: rate * new + (1 - rate) * old, after.policy, before.average)
    assert largest_difference(after.average, expected) < 2e-7  # float32, weights up to 1
    assert largest_difference(after.average, before.average) > 1e-4


@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_rate_scales_every_learning_rate(rate):
    """Adam's first step is the learning rate times the gradient's sign, for every parameter."""
    before, after, _ = one_update(rate, learning_rate=1e-2, target_entropy=-3.0)
    for part in ("policy", "critic"):
        moved = largest_difference(getattr(after, part), getattr(before, part))
        assert moved == pytest.approx(rate * 1e-2, rel=1e-3)  # an ulp of a weight of 1 is 1e-5 of the step
    fallen = float(before.log_alpha - after.log_alpha)
    assert fallen == pytest.approx(rate * sac.ALPHA_LEARNING_RATE, rel=1e-3)  # ulp of log 0.02: 2e-4


@pytest.mark.parametrize("config", [SMALL, PAPER], ids=["twin critics", "state value"])
def test_bandit_policy_is_entropy_optimal(config):
    """Reward -w (a - a0)^2: the optimum exp(Q / alpha) is a Gaussian at a0 with variance alpha / 2w."""
    best, weight, alpha = 0.3, 2.0, 0.04
    learner = learn(Loop(weight=weight, best=best), alpha, config=config)
    networks = parts(config)[0]
    parameters = networks.policy_network.apply(learner.normaliser, learner.policy, STATE)
    distribution = networks.parametric_action_distribution
    mean = float(distribution.mode(parameters)[0, 0])
    # A third of the optimum's own deviation of 0.1: the piecewise linear critic is that exact.
    assert mean == pytest.approx(best, abs=0.03)
    deviation = float(distribution.create_dist(parameters).scale[0, 0]) * (1 - mean**2)  # through the slope of tanh
    # 30 % of error in the curvature of the learnt Q makes 15 % in the deviation.
    assert deviation == pytest.approx(math.sqrt(alpha / (2 * weight)), rel=0.15)


@pytest.mark.parametrize("config", [SMALL, PAPER], ids=["twin critics", "state value"])
def test_critic_learns_the_soft_value_of_a_loop(config):
    """Reward r for ever, actions without effect: Q = (r + gamma alpha log 2) / (1 - gamma), the policy uniform."""
    reward, gamma, alpha = 0.1, 0.5, 0.5
    learner = learn(Loop(reward=reward, continues=1.0), alpha, discount=gamma, config=config)
    values = soft_values(learner, config)
    soft = (reward + gamma * alpha * math.log(2)) / (1 - gamma)
    # A tanh-Gaussian misses log 2 by 0.02 nat at its best; the rest is the noise of 256 samples.
    np.testing.assert_allclose(values, soft, rtol=0, atol=0.04)
    assert soft - reward / (1 - gamma) > 4 * 0.04  # the entropy bonus is far larger than the tolerance


def test_state_value_is_the_soft_value():
    """V = Q + alpha H: with the actions of the loop above without effect, (r + alpha log 2) / (1 - gamma)."""
    reward, gamma, alpha = 0.1, 0.5, 0.5
    learner = learn(Loop(reward=reward, continues=1.0), alpha, discount=gamma, config=PAPER)
    network = parts(PAPER)[0].value_network
    for value in (learner.value, learner.target):
        found = float(network.apply(learner.normaliser, value, STATE)[0])
        assert found == pytest.approx((reward + alpha * math.log(2)) / (1 - gamma), abs=0.04)


def test_paper_preset_has_one_critic_and_a_state_value():
    config = preset("paper").sac
    assert (config.state_value, config.num_critics, config.alpha_fixed, config.alpha) == (True, 1, True, 0.3)
    networks = sac.make_networks(config, (1.0,), 1)
    learner = sac.create(networks, config, 1, jax.random.key(0))
    assert networks.q_network.apply(learner.normaliser, learner.critic, STATE, STATE).shape == (1, 1)
    assert jax.tree.structure(learner.value) == jax.tree.structure(learner.target)
    assert parts(SMALL)[1].value == ()


@pytest.mark.parametrize("config", [SMALL, PAPER], ids=["twin critics", "state value"])
def test_termination_is_not_bootstrapped(config):
    values = soft_values(learn(Loop(reward=-0.4, continues=0.0), alpha=0.5, discount=0.9, config=config), config)
    np.testing.assert_allclose(values, -0.4, rtol=0, atol=0.02)  # a regression on a constant; with bootstrap +2.6


def test_reward_scale_multiplies_the_reward_in_the_critic():
    values = soft_values(learn(Loop(reward=0.2), alpha=0.5, reward_scale=3.0))
    np.testing.assert_allclose(values, 0.6, rtol=0, atol=0.02)  # a regression on a constant


@pytest.mark.slow
def test_two_halves_of_a_batch_make_the_update_of_the_whole():
    """Data parallel: gradients averaged over an axis. With gamma = 0 the critic's update has no noise of its own."""
    networks, before = parts(SMALL)
    config = dataclasses.replace(SMALL, discount=0.0)
    batch = Loop(weight=2.0, best=0.3).batch(jax.random.key(1))
    noise = jax.random.normal(jax.random.key(2), (2, BATCH, 1))
    whole = jax.jit(sac.make_update(networks, config, 1))(before, batch, noise, RATE)[0]
    update = sac.make_update(networks, config, 1, lambda tree: jax.lax.pmean(tree, "parts"))
    halves = jax.tree.map(lambda leaf: leaf.reshape(2, BATCH // 2, *leaf.shape[1:]), batch)
    split = jax.vmap(lambda half, noise: update(before, half, noise, RATE)[0], axis_name="parts")
    after = jax.jit(split)(halves, jax.random.normal(jax.random.key(3), (2, 2, BATCH // 2, 1)))
    for leaf in jax.tree.leaves(after.policy):
        np.testing.assert_array_equal(leaf[0], leaf[1])  # both stay the same learner, noise included
    first = jax.tree.map(lambda leaf: leaf[0], after.critic)
    # Adam divides by the gradient's size: rounding can turn the sign of a gradient that is zero but for it.
    moved = jax.tree.map(lambda a, b, c: (jnp.abs(a - b) > 1e-6) & (jnp.abs(c) > 1e-6), first, whole.critic, first)
    assert sum(int(leaf.sum()) for leaf in jax.tree.leaves(moved)) <= 3
    assert largest_difference(first, before.critic) > 1e-3


@pytest.mark.parametrize("layer_norm", [False, True])
def test_stacked_critics_are_brax_critics(layer_norm: bool):
    config = dataclasses.replace(SMALL, critic_layer_norm=layer_norm, num_critics=2, critic_layers=(8, 8))
    network, brax = sac.make_networks(config, [1.0] * 4, 3).q_network, sac.brax
    separate = brax.networks.make_q_network(
        4, 3, hidden_layer_sizes=(8, 8), activation=jax.nn.relu, layer_norm=layer_norm
    )
    key, seen, action = jax.random.key(0), jax.random.normal(jax.random.key(1), (5, 4)), jnp.full((5, 3), 0.3)
    statistics = brax.running_statistics.init_state(brax.specs.Array((4,), jnp.dtype("float32")))
    found = network.apply(statistics, network.init(key), seen, action)
    assert found.shape == (5, 2)
    expected = separate.apply(statistics, separate.init(key), seen, action)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)  # float32
    assert np.ptp(found, axis=-1).min() > 1e-3  # two critics, not one twice


def test_mask_hides_its_slots_from_policy_and_critic():
    networks = sac.make_networks(SMALL, (0.0, 1.0, 0.0, 1.0), 1)
    learner = sac.create(networks, SMALL, 4, jax.random.key(0))

    def outputs(*seen: float) -> np.ndarray:
        policy = networks.policy_network.apply(learner.normaliser, learner.policy, jnp.array([seen]))
        critic = networks.q_network.apply(learner.normaliser, learner.critic, jnp.array([seen]), jnp.full((1, 1), 0.3))
        return np.concatenate([policy, critic], axis=-1)

    base = outputs(1.0, 2.0, 3.0, 4.0)
    np.testing.assert_array_equal(outputs(-9.0, 2.0, 99.0, 4.0), base)
    assert (outputs(1.0, 2.5, 3.0, 4.0) != base).all()  # policy and both critics
    assert (outputs(1.0, 2.0, 3.0, 4.5) != base).all()
