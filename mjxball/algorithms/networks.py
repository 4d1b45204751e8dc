"""Brax's networks of soft actor-critic, and the normalisation of observations that SAC and PPO share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball.algorithms.recurrent import RecurrentPolicy, estimates
from mjxball.config import Sac
from mjxball.quiet import import_brax_training

brax = import_brax_training()


class Networks(NamedTuple):
    """Brax's `SACNetworks` and a state-value network (None unless `state_value`). The policy may be recurrent."""

    policy_network: Any
    q_network: Any
    value_network: Any
    parametric_action_distribution: Any


def make_networks(
    config: Sac, mask: Any, action_size: int, critic_mask: Any = None, recurrent_slots: slice | None = None
) -> Networks:
    """Brax's SAC networks: tanh-squashed Gaussian policy and critics, ReLU, on normalised observations.

    `mask` (n,) is 1 for entries of the observation that the policy uses, else 0; `critic_mask` for critics and value
    (None: the same). With `recurrent_slots` of the observation the policy is a `RecurrentPolicy`.
    """
    distribution = TanhGaussian(event_size=action_size)
    observation_size = len(mask)
    normalise, normalise_all = normaliser(mask), normaliser(mask if critic_mask is None else critic_mask)
    value_network = brax.networks.make_value_network(
        observation_size, preprocess_observations_fn=normalise_all, hidden_layer_sizes=config.critic_layers
    )
    slots = recurrent_slots or slice(observation_size, observation_size)
    estimating = estimates("sac", config.estimation, slots.stop - slots.start, observation_size - slots.stop)
    if recurrent_slots is not None:
        sizes = *config.policy_layers, distribution.param_size
        policy: Any = RecurrentPolicy(recurrent_slots, sizes, mask, estimating)
    else:
        policy = brax.networks.make_policy_network(
            distribution.param_size,
            observation_size,
            preprocess_observations_fn=normalise,
            hidden_layer_sizes=config.policy_layers,
            activation=jax.nn.relu,
        )
    return Networks(
        policy_network=policy,
        q_network=_critics(config, observation_size, action_size, normalise_all),
        value_network=value_network if config.state_value else None,
        parametric_action_distribution=distribution,
    )


def _critics(config: Sac, observation_size: int, action_size: int, normalise: Callable[[Array, Any], Array]) -> Any:
    """Brax's critics with stacked parameters: one matrix product per layer for all critics together."""
    layout: dict[str, Any] = {"activation": jax.nn.relu, "layer_norm": config.critic_layer_norm}
    separate = brax.networks.make_q_network(
        observation_size, action_size, hidden_layer_sizes=config.critic_layers, n_critics=config.num_critics, **layout
    )
    critic = brax.networks.MLP(layer_sizes=[*config.critic_layers, 1], **layout)

    def init(key: Array) -> Any:
        parts = separate.init(key)["params"]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(parts[name] for name in sorted(parts)))

    def apply(statistics: Any, critics: Any, observation: Array, action: Array) -> Array:
        """Q values (..., critics)."""
        inputs = jnp.concatenate([normalise(observation, statistics), action], axis=-1)
        values = jax.vmap(lambda parameters: critic.apply({"params": parameters}, inputs))(critics)
        return jnp.moveaxis(values[..., 0], 0, -1)

    return brax.networks.FeedForwardNetwork(init, apply)


class TanhGaussian(brax.distribution.NormalTanhDistribution):  # type: ignore[name-defined]
    """Brax's distribution, but sampled from given standard normal noise instead of a key."""

    def sample_no_postprocessing(self, parameters: Array, seed: Array) -> Array:
        """A sample before tanh; `seed` is the noise, of the sample's shape."""
        normal = self.create_dist(parameters)
        return normal.loc + normal.scale * seed


def normaliser(mask: Any) -> Callable[[Array, Any], Array]:
    """Function (observation, statistics) that normalises by running statistics and multiplies by `mask` (n,)."""
    factor = np.asarray(mask, np.float32)
    return lambda observation, statistics: brax.running_statistics.normalize(observation, statistics) * factor
