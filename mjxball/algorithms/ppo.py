"""Proximal policy optimisation (Schulman et al. 2017) on Brax's networks and loss."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjxball.algorithms.base import EnvironmentBatch, PolicyNetwork, Schedule, TrainingPhase, Transition
from mjxball.algorithms.networks import normaliser
from mjxball.algorithms.recurrent import RecurrentPolicy, answer
from mjxball.config import Config, Ppo
from mjxball.errors import InputError
from mjxball.quiet import import_brax_ppo, import_brax_training

if TYPE_CHECKING:
    from jaxtyping import Int

brax = import_brax_training()
brax_ppo = import_brax_ppo()
ADAM = optax.scale_by_adam()
EPOCHS = 8  # passes over the rollout in an update
VALUE_LAYERS = (64, 64)  # hidden layers of the state value
FINAL_RATE = 0.02  # ratio of the last learning rate to the first
GAE_LAMBDA = 0.95  # of the generalised advantage estimate
CLIPPING = 0.2  # epsilon of the clipped surrogate objective
REWARD_SCALE = 0.02  # factor on the reward: the gradient's norm that is clipped contains the value's loss
MAX_GRAD_NORM = 1.0  # largest global norm of a gradient


class PpoState(NamedTuple):
    """State of `ProximalPolicyOptimization`."""

    parameters: Any  # Brax's `PPONetworkParams`
    adam: Any
    normaliser: Any  # running mean and deviation of the observations
    rollout: Any  # Brax's `Transition`, the newest steps of all environments: (envs, unroll_length, ...)


class ProximalPolicyOptimization:
    """`collect` flies `ppo.unroll_length` steps, `update` learns from these alone (see `mjxball.algorithms.base`)."""

    metrics = ("loss", "policy_loss", "value_loss", "deviation")
    engines = ("mjx", "newton-euler")
    large_products = True
    collect_keys = 2
    update_keys = 1

    def __init__(self, config: Config, environments: EnvironmentBatch):
        ppo, slots = config.ppo, environments.recurrent_slots
        self._units = slots.stop - slots.start
        self._config, self._environments, self._shards = ppo, environments, environments.shards
        self.steps_per_collect = ppo.unroll_length
        self.schedule = Schedule(ppo.total_steps, ppo.num_envs, 0, ppo.num_evaluations)
        self._mask = environments.policy_mask
        self._sizes = (environments.observation_size, environments.action_size - self._units)
        self.networks = make_networks(ppo, self._mask, self._sizes[1], environments.critic_mask)
        self._of_unrolls = self.networks  # as the loss calls them: on all steps of an unroll
        if self._units:
            parameters = self.networks.parametric_action_distribution.param_size
            policy = RecurrentPolicy(slots, (*ppo.policy_layers, parameters), self._mask)
            self.networks = self.networks.replace(policy_network=policy)
            outputs = SimpleNamespace(apply=lambda *given: policy.unroll(*given)[0])
            self._of_unrolls = self.networks.replace(policy_network=outputs)

    def init(self, key: Array) -> PpoState:
        """Initial networks and a rollout of zeros."""
        policy_key, value_key = jax.random.split(key)
        parameters = brax_ppo.losses.PPONetworkParams(
            policy=self.networks.policy_network.init(policy_key), value=self.networks.value_network.init(value_key)
        )
        size, actions = self._sizes
        specification = brax.specs.Array((size,), jnp.dtype("float32"))
        shape = (self._environments.count, self.steps_per_collect)
        observation, action, scalar, policy_output = (
            jnp.zeros((*shape, *last)) for last in ((size,), (actions,), (), (2 * actions,))
        )
        transition = Transition(observation, action, scalar, scalar, observation, scalar)
        rollout = _rollout(transition, policy_output, action, scalar)
        return PpoState(parameters, ADAM.init(parameters), brax.running_statistics.init_state(specification), rollout)

    def collect(self, state: PpoState, envs: Any, keys: Sequence[Array], phase: TrainingPhase) -> tuple[PpoState, Any]:
        """`steps_per_collect` steps of all environments, whose observations update the normaliser."""
        act_keys, fresh = jax.random.split(keys[0], self.steps_per_collect), self._environments.reset(keys[1])
        distribution = self.networks.parametric_action_distribution

        def step(envs: Any, key: Array) -> tuple[Any, Any]:
            network, policy = self.networks.policy_network, state.parameters.policy
            parameters, memory = answer(network, state.normaliser, policy, envs.states.obs)
            raw = distribution.sample_no_postprocessing(parameters, self._shards.own(key))
            action = jnp.where(phase.evaluate, distribution.mode(parameters), distribution.postprocess(raw))
            envs, seen = self._environments.step(envs, jnp.concatenate([action, memory], axis=-1), None, fresh)
            return envs, _rollout(seen._replace(action=action), parameters, raw, distribution.log_prob(parameters, raw))

        envs, flown = jax.lax.scan(step, envs, act_keys)
        flown = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), flown)
        normaliser = brax.running_statistics.update(
            state.normaliser, flown.observation, pmap_axis_name=self._shards.axis
        )
        # An evaluation leaves the state unchanged.
        updated = state._replace(normaliser=normaliser, rollout=flown)
        return jax.tree.map(lambda new, old: jnp.where(phase.recording, new, old), updated, state), envs

    def update(
        self, state: PpoState, keys: Sequence[Array], progress: Array, phase: TrainingPhase
    ) -> tuple[PpoState, dict[str, Array]]:
        """`EPOCHS` passes over the rollout in `minibatches` parts. The steps of an unroll stay together."""
        ppo, count = self._config, self._environments.count
        rate = ppo.learning_rate * (1.0 + (FINAL_RATE - 1.0) * progress)
        order_key, loss_key = jax.random.split(self._shards.own(keys[0]))
        batches = _orders(order_key, count).reshape(EPOCHS * ppo.minibatches, -1)

        def loss(parameters: Any, batch: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            return brax_ppo.losses.compute_ppo_loss(
                parameters,
                state.normaliser,
                batch,
                key,
                self._of_unrolls,
                entropy_cost=ppo.entropy_cost,
                discounting=ppo.discount,
                reward_scaling=REWARD_SCALE,
                gae_lambda=GAE_LAMBDA,
                clipping_epsilon=CLIPPING,
            )

        def step(index: Array, carry: Any) -> Any:
            parameters, adam, _ = carry
            batch = jax.tree.map(lambda leaf: leaf[batches[index]], state.rollout)
            gradient, losses = jax.grad(loss, has_aux=True)(parameters, batch, jax.random.fold_in(loss_key, index))
            gradient = self._shards.mean(gradient)
            gradient, _ = optax.clip_by_global_norm(MAX_GRAD_NORM).update(gradient, optax.EmptyState())
            direction, adam = ADAM.update(gradient, adam)
            parameters = jax.tree.map(lambda value, along: value - rate * along, parameters, direction)
            report = (losses["total_loss"], losses["policy_loss"], losses["v_loss"], losses["policy_dist_mean_std"])
            return parameters, adam, jnp.stack(report)

        steps = jnp.where(phase.learning, len(batches), 0)
        start = (state.parameters, state.adam, jnp.zeros(len(self.metrics)))
        parameters, adam, report = jax.lax.fori_loop(0, steps, step, start)
        return state._replace(parameters=parameters, adam=adam), dict(zip(self.metrics, report, strict=True))

    def policy(self, state: PpoState) -> PolicyNetwork:
        """The current policy with its normalisation."""
        mask = jnp.asarray(self._mask, jnp.float32)
        return PolicyNetwork(state.parameters.policy["params"], state.normaliser.mean, state.normaliser.std, mask)

    def partition(self, whole: Any, split: Any) -> PpoState:
        """The rollout is cut by environments, the rest is whole."""
        return PpoState(whole, whole, whole, split)

    def check_parts(self, parts: int) -> None:
        """Raise InputError unless environments and minibatches can be cut into `parts`."""
        count, batches = self._config.num_envs, self._config.minibatches
        if count % (parts * batches):
            raise InputError(
                f"ppo.num_envs = {count} cannot be cut into {batches} minibatches on {parts} devices evenly; make it a "
                f"multiple of {parts * batches}"
            )


def make_networks(config: Ppo, mask: Any, action_size: int, critic_mask: Any) -> Any:
    """Brax's PPO networks: tanh-squashed Gaussian policy and state value on normalised observations.

    The value network, which is never exported, has Brax's smooth activation.
    """
    distribution = brax.distribution.NormalTanhDistribution(event_size=action_size)
    policy, value = (normaliser(shown) for shown in (mask, critic_mask))
    return brax_ppo.networks.PPONetworks(
        policy_network=brax.networks.make_policy_network(
            distribution.param_size,
            len(mask),
            preprocess_observations_fn=policy,
            hidden_layer_sizes=config.policy_layers,
            activation=jax.nn.relu,
        ),
        value_network=brax.networks.make_value_network(
            len(mask),
            preprocess_observations_fn=value,
            hidden_layer_sizes=VALUE_LAYERS,
            activation=jax.nn.swish,
        ),
        parametric_action_distribution=distribution,
    )


def _orders(key: Array, count: int) -> Int[Array, "epochs envs"]:
    """Random permutations of 0 ... `count` - 1, one for each epoch.

    They are the low bits of sorted random integers. `jax.random.permutation` sorts keys together with values, and on
    several devices a sort of two arrays crashes XLA's partitioner (`HandleSort`, jax 0.10.1 and 0.11.2).
    """
    low = jnp.uint32((1 << (count - 1).bit_length()) - 1)
    bits = jax.random.bits(key, (EPOCHS, count), jnp.uint32)
    return (jnp.sort(bits & ~low | jnp.arange(count, dtype=jnp.uint32), axis=-1) & low).astype(jnp.int32)


def _rollout(transition: Transition, parameters: Array, raw: Array, log_prob: Array) -> Any:
    """Brax's `Transition`; `raw`, the action before tanh, is a sample of the distribution with these `parameters`."""
    return brax.types.Transition(
        observation=transition.observation,
        action=transition.action,
        reward=transition.reward,
        discount=1 - transition.terminated,
        next_observation=transition.next_observation,
        extras={
            "state_extras": {"truncation": transition.done * (1 - transition.terminated)},
            "policy_extras": {"raw_action": raw, "log_prob": log_prob, "distribution_params": parameters},
        },
    )
