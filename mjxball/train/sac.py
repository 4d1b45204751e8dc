"""Soft actor-critic: one gradient update on Brax's networks and losses, or on the paper's with a state value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
    value: Any  # of a state, () unless `state_value`
    target: Any  # slow copy of the critic, or of the value if there is one
    log_alpha: Array
    policy_adam: Any
    critic_adam: Any
    value_adam: Any
    alpha_adam: Any
    normaliser: Any  # running mean and deviation of the observations
    average: Any  # running average of the policy: what is evaluated and exported
    updates: Array  # () gradient updates so far


class Networks(NamedTuple):
    """Brax's `SACNetworks` and a state-value network, None unless `state_value`."""

    policy_network: Any
    q_network: Any
    value_network: Any
    parametric_action_distribution: Any


class Losses(NamedTuple):
    """Diagnostics of the last update."""

    critic: Array
    policy: Array
    entropy: Array  # of the policy [nat], in [-1, 1] action units


def make_networks(config: Sac, mask: Any, action_size: int, critic_mask: Any = None) -> Networks:
    """Brax's SAC networks: tanh-squashed Gaussian policy and critics, ReLU, on normalised observations.

    `mask` (n,) of 0 and 1 hides slots of the observation from the policy, `critic_mask` from critics and value
    (None: the same).
    """
    distribution = brax.distribution.NormalTanhDistribution(event_size=action_size)
    observation_size = len(mask)
    normalise, normalise_all = _normaliser(mask), _normaliser(mask if critic_mask is None else critic_mask)
    value_network = brax.networks.make_value_network(
        observation_size, preprocess_observations_fn=normalise_all, hidden_layer_sizes=config.critic_layers
    )
    return Networks(
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
            preprocess_observations_fn=normalise_all,
            hidden_layer_sizes=config.critic_layers,
            activation=jax.nn.relu,
            layer_norm=config.critic_layer_norm,
            n_critics=config.critics,
        ),
        value_network=value_network if config.state_value else None,
        parametric_action_distribution=distribution,
    )


def _normaliser(mask: Any) -> Callable[[Array, Any], Array]:
    """Normalisation of an observation by running statistics, with zeros where `mask` (n,) has them."""
    shown = np.asarray(mask, np.float32)
    return lambda seen, statistics: brax.running_statistics.normalize(seen, statistics) * shown


def create(networks: Networks, config: Sac, observation_size: int, key: Array) -> Learner:
    """A fresh learner."""
    policy_key, critic_key = jax.random.split(key)
    policy, critic = networks.policy_network.init(policy_key), networks.q_network.init(critic_key)
    value = networks.value_network.init(jax.random.fold_in(critic_key, 1)) if config.state_value else ()
    log_alpha = jnp.log(jnp.asarray(config.alpha, jnp.float32))
    specification = brax.specs.Array((observation_size,), jnp.dtype("float32"))
    return Learner(
        policy=policy,
        critic=critic,
        value=value,
        target=value if config.state_value else critic,
        log_alpha=log_alpha,
        policy_adam=ADAM.init(policy),
        critic_adam=ADAM.init(critic),
        value_adam=ADAM.init(value),
        alpha_adam=ADAM.init(log_alpha),
        normaliser=brax.running_statistics.init_state(specification),
        average=policy,
        updates=jnp.zeros((), jnp.int32),
    )


def make_update(
    networks: Networks, config: Sac, action_size: int, mean: Callable[[Any], Any] = lambda value: value
) -> Any:
    """Return `update(learner, transitions, three keys, rate) -> (learner, losses)`; `rate` scales all learning rates.

    `mean` averages gradients and entropies over learners that share their parameters (data parallel).
    """
    _, critic_loss, policy_loss = brax.losses.make_losses(networks, config.reward_scale, config.discount, action_size)
    value_loss, q_loss = make_value_losses(networks, config)
    distribution = networks.parametric_action_distribution
    target_entropy = config.target_entropy * action_size

    def entropy_of(learner: Learner, seen: Array, key: Array) -> Array:
        parameters = networks.policy_network.apply(learner.normaliser, learner.policy, seen)
        return -jnp.mean(distribution.log_prob(parameters, distribution.sample_no_postprocessing(parameters, key)))

    def value_step(learner: Learner, batch: Any, key: Array, step: Array) -> tuple[Learner, Array]:
        """The paper's eqs. 6 and 7: V follows Q and the entropy, Q follows the reward and the slow V."""
        value_gradient = mean(jax.grad(value_loss)(learner.value, learner, batch, key))
        loss, gradient = jax.value_and_grad(q_loss)(learner.critic, learner, batch)
        value, value_adam = _descend(learner.value, _clip(value_gradient, config), learner.value_adam, step)
        critic, adam = _descend(learner.critic, _clip(mean(gradient), config), learner.critic_adam, step)
        target = optax.incremental_update(value, learner.target, config.target_rate)
        moved = learner._replace(value=value, critic=critic, target=target, value_adam=value_adam, critic_adam=adam)
        return moved, loss

    def critic_step(learner: Learner, batch: Any, key: Array, step: Array) -> tuple[Learner, Array]:
        alpha = jnp.exp(learner.log_alpha)
        value, gradient = jax.value_and_grad(critic_loss)(
            learner.critic, learner.policy, learner.normaliser, learner.target, alpha, batch, key
        )
        critic, adam = _descend(learner.critic, _clip(mean(gradient), config), learner.critic_adam, step)
        target = optax.incremental_update(critic, learner.target, config.target_rate)
        return learner._replace(critic=critic, critic_adam=adam, target=target), value

    def policy_step(before: Learner, learner: Learner, batch: Any, keys: Any, rate: Array) -> tuple[Learner, Losses]:
        """Policy and temperature move against the critic `before` the batch's own critic step, as in Brax."""
        alpha_key, policy_key = keys
        alpha, entropy = jnp.exp(before.log_alpha), mean(entropy_of(before, batch.observation, alpha_key))
        value, gradient = jax.value_and_grad(policy_loss)(
            before.policy, before.normaliser, before.critic, alpha, batch, policy_key
        )
        step = rate * config.learning_rate
        policy, policy_adam = _descend(before.policy, _clip(mean(gradient), config), before.policy_adam, step)
        # d(alpha loss)/d(log alpha) of SAC's eq. 18: alpha (H - target).
        slope = 0.0 * alpha if config.alpha_fixed else alpha * (entropy - target_entropy)
        log_alpha, alpha_adam = _descend(before.log_alpha, slope, before.alpha_adam, rate * config.alpha_learning_rate)
        moved = learner._replace(
            policy=policy,
            log_alpha=log_alpha,
            policy_adam=policy_adam,
            alpha_adam=alpha_adam,
            average=optax.incremental_update(policy, learner.average, config.policy_average),
        )
        return moved, Losses(jnp.zeros(()), value, entropy)

    def update(learner: Learner, batch: Transitions, keys: Array, rate: Array) -> tuple[Learner, Losses]:
        alpha_key, critic_key, policy_key = keys
        transitions = _brax_transitions(batch)
        evaluate = value_step if config.state_value else critic_step
        moved, critic_value = evaluate(learner, transitions, critic_key, rate * config.learning_rate)

        def due(moved: Learner) -> tuple[Learner, Losses]:
            return policy_step(learner, moved, transitions, (alpha_key, policy_key), rate)

        def not_due(moved: Learner) -> tuple[Learner, Losses]:
            return moved, Losses(*jnp.zeros(3))

        if config.policy_delay == 1:
            moved, losses = due(moved)
        else:
            moved, losses = jax.lax.cond(learner.updates % config.policy_delay == 0, due, not_due, moved)
        return moved._replace(updates=learner.updates + 1), losses._replace(critic=critic_value)

    return update


def make_value_losses(networks: Networks, config: Sac) -> tuple[Any, Any]:
    """`(value_loss(value, learner, batch, key), q_loss(critic, learner, batch))`, the paper's eqs. 6 and 7.

    The paper prints them without the temperature; here it stands where Haarnoja et al. (2018) put it:
    V(s) -> E[min Q(s, a) - alpha log pi(a|s)], Q(s, a) -> r + gamma V'(s'), with V' the slow copy of V.
    """
    distribution = networks.parametric_action_distribution

    def value_loss(value: Any, learner: Learner, batch: Any, key: Array) -> Array:
        parameters = networks.policy_network.apply(learner.normaliser, learner.policy, batch.observation)
        action = distribution.sample_no_postprocessing(parameters, key)
        log_probability = distribution.log_prob(parameters, action)
        chosen = distribution.postprocess(action)
        q = networks.q_network.apply(learner.normaliser, learner.critic, batch.observation, chosen).min(axis=-1)
        wanted = q - jnp.exp(learner.log_alpha) * log_probability
        return 0.5 * jnp.mean(
            (networks.value_network.apply(learner.normaliser, value, batch.observation) - wanted) ** 2
        )

    def q_loss(critic: Any, learner: Learner, batch: Any) -> Array:
        q = networks.q_network.apply(learner.normaliser, critic, batch.observation, batch.action)
        after = networks.value_network.apply(learner.normaliser, learner.target, batch.next_observation)
        wanted = batch.reward * config.reward_scale + batch.discount * config.discount * after
        return 0.5 * jnp.mean((q - wanted[:, None]) ** 2)

    return value_loss, q_loss


def _clip(gradient: Any, config: Sac) -> Any:
    """`gradient` scaled to a global norm of at most `config.gradient_clip`, 0: untouched."""
    if not config.gradient_clip:
        return gradient
    return optax.clip_by_global_norm(config.gradient_clip).update(gradient, optax.EmptyState())[0]


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
