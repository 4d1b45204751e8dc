"""The networks of soft actor-critic, Brax's, and the normalisation that all networks share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjxball.algorithms.recurrent import RecurrentPolicy
from mjxball.config import Sac
from mjxball.quiet import import_brax_training

brax = import_brax_training()


class Networks(NamedTuple):
    """Brax's `SACNetworks`, perhaps with a recurrent policy, and a state-value network, None unless `state_value`."""

    policy_network: Any
    q_network: Any
    value_network: Any
    parametric_action_distribution: Any


def make_networks(
    config: Sac, mask: Any, action_size: int, critic_mask: Any = None, recurrent_slots: slice | None = None
) -> Networks:
    """Brax's SAC networks: tanh-squashed Gaussian policy and critics, ReLU, on normalised observations.

    `mask` (n,) of 0 and 1 hides slots of the observation from the policy, `critic_mask` from critics and value
    (None: the same). With `recurrent_slots` of the observation the policy is a `RecurrentPolicy`.
    """
    distribution = TanhGaussian(event_size=action_size)
    observation_size = len(mask)
    normalise, normalise_all = normaliser(mask), normaliser(mask if critic_mask is None else critic_mask)
    value_network = brax.networks.make_value_network(
        observation_size, preprocess_observations_fn=normalise_all, hidden_layer_sizes=config.critic_layers
    )
    if recurrent_slots is not None:
        policy: Any = RecurrentPolicy(recurrent_slots, (*config.policy_layers, distribution.param_size), mask)
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
    """Brax's critics, their parameters stacked: one product a layer for all of them, not one for each."""
    layout: dict[str, Any] = {"activation": jax.nn.relu, "layer_norm": config.critic_layer_norm}
    separate = brax.networks.make_q_network(
        observation_size, action_size, hidden_layer_sizes=config.critic_layers, n_critics=config.num_critics, **layout
    )
    critic = brax.networks.MLP(layer_sizes=[*config.critic_layers, 1], **layout)

    def init(key: Array) -> Any:
        parts = separate.init(key)["params"]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(parts[name] for name in sorted(parts)))

    def apply(statistics: Any, critics: Any, observation: Array, action: Array) -> Array:
        """(..., critics)"""
        seen = jnp.concatenate([normalise(observation, statistics), action], axis=-1)
        found = jax.vmap(lambda parameters: critic.apply({"params": parameters}, seen))(critics)
        return jnp.moveaxis(found[..., 0], 0, -1)

    return brax.networks.FeedForwardNetwork(init, apply)


class TanhGaussian(brax.distribution.NormalTanhDistribution):  # type: ignore[name-defined]
    """Brax's, which where it samples takes standard normal numbers of the sample's shape instead of a key."""

    def sample_no_postprocessing(self, parameters: Array, seed: Array) -> Array:
        """A sample before tanh."""
        made = self.create_dist(parameters)
        return made.loc + made.scale * seed


def normaliser(mask: Any) -> Callable[[Array, Any], Array]:
    """Normalisation of an observation by running statistics, with zeros where `mask` (n,) has them."""
    shown = np.asarray(mask, np.float32)
    return lambda observation, statistics: brax.running_statistics.normalize(observation, statistics) * shown
