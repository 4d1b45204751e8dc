"""Soft actor-critic: one gradient update on Brax's networks and losses."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from mjxball.config import Sac
from mjxball.quiet import import_brax_training
from mjxball.train.replay import Transitions

Array = Any
brax = import_brax_training()
ADAM = optax.scale_by_adam()


class Learner(NamedTuple):
    """Everything that an update changes."""

    policy: Any
    critic: Any
    target: Any  # slow copy of the critic
    log_alpha: Array
    policy_adam: Any
    critic_adam: Any
    alpha_adam: Any
    normaliser: Any  # running mean and deviation of the observations
    average: Any  # running average of the policy: what is evaluated and exported
    updates: Array  # () gradient updates so far


class Losses(NamedTuple):
    """Diagnostics of the last update."""

    critic: Array
    policy: Array
    entropy: Array  # of the policy [nat], in [-1, 1] action units


def make_networks(config: Sac, mask: Any, action_size: int) -> Any:
    """Brax's SAC networks: tanh-squashed Gaussian policy and twin critics, ReLU, on normalised observations.

    `mask` (n,) of 0 and 1 hides slots of the observation from all networks.
    """
    distribution = brax.distribution.NormalTanhDistribution(event_size=action_size)
    mask = jnp.asarray(mask, jnp.float32)
    observation_size = mask.size

    def normalise(seen: Array, statistics: Any) -> Array:
        return brax.running_statistics.normalize(seen, statistics) * mask

    return brax.sac_networks.SACNetworks(
        policy_network=brax.networks.make_policy_network(
            distribution.param_size,
            observation_size,
            preprocess_observations_fn=normalise,
            hidden_layer_sizes=config.policy_layers,
            activation=jax.nn.relu,
        ),
        q_network=brax.networks.make_q_network(
            observation_size,
            action_size,
            preprocess_observations_fn=normalise,
            hidden_layer_sizes=config.critic_layers,
            activation=jax.nn.relu,
            layer_norm=config.critic_layer_norm,
        ),
        parametric_action_distribution=distribution,
    )


def create(networks: Any, config: Sac, observation_size: int, key: Array) -> Learner:
    """A fresh learner."""
    policy_key, critic_key = jax.random.split(key)
    policy, critic = networks.policy_network.init(policy_key), networks.q_network.init(critic_key)
    log_alpha = jnp.log(jnp.asarray(config.alpha, jnp.float32))
    specification = brax.specs.Array((observation_size,), jnp.dtype("float32"))
    return Learner(
        policy=policy,
        critic=critic,
        target=critic,
        log_alpha=log_alpha,
        policy_adam=ADAM.init(policy),
        critic_adam=ADAM.init(critic),
        alpha_adam=ADAM.init(log_alpha),
        normaliser=brax.running_statistics.init_state(specification),
        average=policy,
        updates=jnp.zeros((), jnp.int32),
    )


def make_update(networks: Any, config: Sac, action_size: int) -> Any:
    """Return `update(learner, transitions, key, rate) -> (learner, losses)`; `rate` scales all learning rates."""
    _, critic_loss, policy_loss = brax.losses.make_losses(networks, config.reward_scale, config.discount, action_size)
    distribution = networks.parametric_action_distribution
    target_entropy = config.target_entropy * action_size

    def log_probability(policy: Any, normaliser: Any, seen: Array, key: Array) -> Array:
        parameters = networks.policy_network.apply(normaliser, policy, seen)
        return distribution.log_prob(parameters, distribution.sample_no_postprocessing(parameters, key))

    def update(learner: Learner, batch: Transitions, key: Array, rate: Array) -> tuple[Learner, Losses]:
        alpha_key, critic_key, policy_key = jax.random.split(key, 3)
        transitions = _brax_transitions(batch)
        alpha = jnp.exp(learner.log_alpha)
        entropy = -jnp.mean(log_probability(learner.policy, learner.normaliser, batch.observation, alpha_key))
        critic_value, critic_gradient = jax.value_and_grad(critic_loss)(
            learner.critic, learner.policy, learner.normaliser, learner.target, alpha, transitions, critic_key
        )
        policy_value, policy_gradient = jax.value_and_grad(policy_loss)(
            learner.policy, learner.normaliser, learner.critic, alpha, transitions, policy_key
        )
        step = rate * config.learning_rate
        critic, critic_adam = _descend(learner.critic, critic_gradient, learner.critic_adam, step)
        policy, policy_adam = _descend(learner.policy, policy_gradient, learner.policy_adam, step)
        # d(alpha loss)/d(log alpha) of SAC's eq. 18: alpha (H - target).
        alpha_gradient = 0.0 * alpha if config.alpha_fixed else alpha * (entropy - target_entropy)
        log_alpha, alpha_adam = _descend(
            learner.log_alpha, alpha_gradient, learner.alpha_adam, rate * config.alpha_learning_rate
        )
        moved = Learner(
            policy=policy,
            critic=critic,
            target=optax.incremental_update(critic, learner.target, config.target_rate),
            log_alpha=log_alpha,
            policy_adam=policy_adam,
            critic_adam=critic_adam,
            alpha_adam=alpha_adam,
            normaliser=learner.normaliser,
            average=optax.incremental_update(policy, learner.average, config.policy_average),
            updates=learner.updates + 1,
        )
        return moved, Losses(critic_value, policy_value, entropy)

    return update


def _descend(value: Any, gradient: Any, adam: Any, step: Array) -> tuple[Any, Any]:
    direction, adam = ADAM.update(gradient, adam)
    return jax.tree.map(lambda v, d: v - step * d, value, direction), adam


def _brax_transitions(batch: Transitions) -> Any:
    """Brax's container. `truncation` stays 0: a time limit bootstraps from the true last observation instead."""
    truncation = jnp.zeros_like(batch.reward)
    return brax.types.Transition(
        observation=batch.observation,
        action=batch.action,
        reward=batch.reward,
        discount=batch.discount,
        next_observation=batch.next_observation,
        extras={"state_extras": {"truncation": truncation}, "policy_extras": {}},
    )
