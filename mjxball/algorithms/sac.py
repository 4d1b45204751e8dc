"""Soft actor-critic on Brax's networks and losses, or on the paper's losses with a state value."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from mjxball.algorithms import replay
from mjxball.algorithms.base import EnvironmentBatch, PolicyNetwork, Schedule, TrainingPhase
from mjxball.algorithms.networks import Networks, make_networks
from mjxball.algorithms.recurrent import answer, exported
from mjxball.algorithms.replay import Replay, Transitions
from mjxball.config import Config, Sac
from mjxball.errors import InputError
from mjxball.quiet import import_brax_training

if TYPE_CHECKING:
    from jaxtyping import Float, Int

brax = import_brax_training()
ADAM = optax.scale_by_adam()
ALPHA_LEARNING_RATE = 1e-3  # Adam's, for the temperature's logarithm
POLICY_EMA_RATE = 0.002  # of the exported running average of the policy


class Learner(NamedTuple):
    """Parameters, optimiser states and statistics that an update changes."""

    policy: Any
    critic: Any
    value: Any  # of a state, () unless `state_value`
    target: Any  # slow copy of the critic, or of the value if there is one
    log_alpha: Float[Array, ""]
    policy_adam: Any
    critic_adam: Any
    value_adam: Any
    alpha_adam: Any
    normaliser: Any  # running mean and deviation of the observations
    average: Any  # running average of the policy: what is evaluated and exported


class Losses(NamedTuple):
    """Diagnostics of the last update."""

    critic: Float[Array, ""]
    policy: Float[Array, ""]
    entropy: Float[Array, ""]  # of the policy [nat], in [-1, 1] action units


def create(networks: Networks, config: Sac, observation_size: int, key: Array) -> Learner:
    """Initial parameters, optimiser states and statistics."""
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
    )


def make_update(
    networks: Networks, config: Sac, action_size: int, mean: Callable[[Any], Any] = lambda value: value
) -> Any:
    """Return `update(learner, transitions, noise, rate, seen) -> (learner, losses)`; `rate` scales all learning rates.

    A recurrent policy learns from the observations `seen` in sequences, in all as many as there are `transitions`.
    `noise` (2, batch, actions) is standard normal: one part for the critic's next actions, one for the policy's.
    `mean` averages gradients and entropies over learners that share their parameters (data parallel).
    """
    # The policy's loss takes the network's output instead of its parameters, because the entropy needs the output too.
    of_output = networks._replace(policy_network=SimpleNamespace(apply=lambda normaliser, output, observation: output))
    _, critic_loss, _ = brax.losses.make_losses(networks, config.reward_scale, config.discount, action_size)
    _, _, policy_loss = brax.losses.make_losses(of_output, config.reward_scale, config.discount, action_size)
    value_loss, q_loss = make_value_losses(networks, config)
    distribution = networks.parametric_action_distribution
    target_entropy = config.target_entropy * action_size

    def value_step(
        learner: Learner, batch: Any, noise: Float[Array, "batch actions"], learning_rate: Float[Array, ""]
    ) -> tuple[Learner, Float[Array, ""]]:
        """The paper's eqs. 6 and 7: V follows Q and the entropy, Q follows the reward and the slow V."""
        value_gradient = mean(jax.grad(value_loss)(learner.value, learner, batch, noise))
        loss, gradient = jax.value_and_grad(q_loss)(learner.critic, learner, batch)
        value, value_adam = _descend(learner.value, value_gradient, learner.value_adam, learning_rate)
        critic, adam = _descend(learner.critic, mean(gradient), learner.critic_adam, learning_rate)
        target = optax.incremental_update(value, learner.target, config.tau)
        moved = learner._replace(value=value, critic=critic, target=target, value_adam=value_adam, critic_adam=adam)
        return moved, loss

    def critic_step(
        learner: Learner, batch: Any, noise: Float[Array, "batch actions"], learning_rate: Float[Array, ""]
    ) -> tuple[Learner, Float[Array, ""]]:
        alpha = jnp.exp(learner.log_alpha)
        loss, gradient = jax.value_and_grad(critic_loss)(
            learner.critic, learner.policy, learner.normaliser, learner.target, alpha, batch, noise
        )
        critic, adam = _descend(learner.critic, mean(gradient), learner.critic_adam, learning_rate)
        target = optax.incremental_update(critic, learner.target, config.tau)
        return learner._replace(critic=critic, critic_adam=adam, target=target), loss

    def outputs(policy: Any, normaliser: Any, seen: Float[Array, "... n"]) -> tuple[Array, Array]:
        """(distribution parameters (batch, 2 a), cost () of estimates) at `seen`.

        `seen` are observations (batch, n) or sequences of them (steps, sequences, n).
        """
        network, cost = networks.policy_network, jnp.zeros(())
        if seen.ndim == 2:
            return network.apply(normaliser, policy, seen), cost
        parameters, memory = network.unroll(normaliser, policy, seen)
        if network.estimates:
            cost = config.estimation * network.estimation(normaliser, policy, memory, seen)
        return parameters.reshape(-1, parameters.shape[-1]), cost

    def policy_step(
        before: Learner,
        learner: Learner,
        seen: Float[Array, "... n"],
        batch: Any,
        noise: Float[Array, "batch actions"],
        rate: Float[Array, ""],
    ) -> tuple[Learner, Losses]:
        """Step of policy and temperature. It uses the critic `before` this batch's critic step, as Brax does."""
        (output, _), back = jax.vjp(lambda policy: outputs(policy, before.normaliser, seen), before.policy)
        batch = batch._replace(observation=seen.reshape(-1, seen.shape[-1]))
        action = distribution.sample_no_postprocessing(output, noise)
        alpha, entropy = jnp.exp(before.log_alpha), -mean(jnp.mean(distribution.log_prob(output, action)))
        value, slope = jax.value_and_grad(policy_loss)(output, before.normaliser, before.critic, alpha, batch, noise)
        (gradient,) = back((slope, jnp.ones(())))
        learning_rate = rate * config.learning_rate
        policy, policy_adam = _descend(before.policy, mean(gradient), before.policy_adam, learning_rate)
        # d(alpha loss)/d(log alpha) of SAC's eq. 18: alpha (H - target).
        rise = 0.0 * alpha if config.alpha_fixed else alpha * (entropy - target_entropy)
        log_alpha, alpha_adam = _descend(before.log_alpha, rise, before.alpha_adam, rate * ALPHA_LEARNING_RATE)
        moved = learner._replace(
            policy=policy,
            log_alpha=log_alpha,
            policy_adam=policy_adam,
            alpha_adam=alpha_adam,
            average=optax.incremental_update(policy, learner.average, POLICY_EMA_RATE),
        )
        return moved, Losses(jnp.zeros(()), value, entropy)

    def update(
        learner: Learner,
        batch: Transitions,
        noise: Float[Array, "2 batch actions"],
        rate: Float[Array, ""],
        seen: Float[Array, "steps sequences n"] | None = None,
    ) -> tuple[Learner, Losses]:
        transitions = _brax_transitions(batch)
        improve_critic = value_step if config.state_value else critic_step
        moved, loss = improve_critic(learner, transitions, noise[0], rate * config.learning_rate)
        moved, losses = policy_step(
            learner, moved, batch.observation if seen is None else seen, transitions, noise[1], rate
        )
        return moved, losses._replace(critic=loss)

    return update


def make_value_losses(networks: Networks, config: Sac) -> tuple[Any, Any]:
    """`(value_loss(value, learner, batch, noise), q_loss(critic, learner, batch))`, the paper's eqs. 6 and 7.

    The paper omits the temperature alpha; here it enters as in Haarnoja et al. (2018):
    V(s) -> E[min Q(s, a) - alpha log pi(a|s)], Q(s, a) -> r + gamma V'(s'), with V' the slow copy of V.
    """
    distribution = networks.parametric_action_distribution

    def value_loss(value: Any, learner: Learner, batch: Any, noise: Float[Array, "batch actions"]) -> Float[Array, ""]:
        parameters = networks.policy_network.apply(learner.normaliser, learner.policy, batch.observation)
        action = distribution.sample_no_postprocessing(parameters, noise)
        log_probability = distribution.log_prob(parameters, action)
        squashed = distribution.postprocess(action)
        q = networks.q_network.apply(learner.normaliser, learner.critic, batch.observation, squashed).min(axis=-1)
        target = q - jnp.exp(learner.log_alpha) * log_probability
        return 0.5 * jnp.mean(
            (networks.value_network.apply(learner.normaliser, value, batch.observation) - target) ** 2
        )

    def q_loss(critic: Any, learner: Learner, batch: Any) -> Float[Array, ""]:
        q = networks.q_network.apply(learner.normaliser, critic, batch.observation, batch.action)
        after = networks.value_network.apply(learner.normaliser, learner.target, batch.next_observation)
        target = batch.reward * config.reward_scale + batch.discount * config.discount * after
        return 0.5 * jnp.mean((q - target[:, None]) ** 2)

    return value_loss, q_loss


def _descend(value: Any, gradient: Any, adam: Any, learning_rate: Float[Array, ""]) -> tuple[Any, Any]:
    """(`value`, state of Adam) after one step of Adam with `learning_rate`."""
    direction, adam = ADAM.update(gradient, adam)
    return jax.tree.map(lambda v, d: v - learning_rate * d, value, direction), adam


def _brax_transitions(batch: Transitions) -> Any:
    """Brax's `Transition`. `truncation` stays 0: a time limit bootstraps from the true last observation instead."""
    truncation = jnp.zeros_like(batch.reward)
    return brax.types.Transition(
        observation=batch.observation,
        action=batch.action,
        reward=batch.reward,
        discount=batch.discount,
        next_observation=batch.next_observation,
        extras={"state_extras": {"truncation": truncation}, "policy_extras": {}},
    )


class SacState(NamedTuple):
    """State of `SoftActorCritic`."""

    learner: Learner
    replay: Replay


class SoftActorCritic:
    """Soft actor-critic behind the trainer's interface (`mjxball.algorithms.base.Algorithm`)."""

    metrics = ("alpha", "entropy", "critic_loss", "policy_loss")
    engines = ("mjx", "newton-euler")
    collect_keys = 3
    update_keys = 2
    steps_per_collect = 1

    def __init__(self, config: Config, environments: EnvironmentBatch):
        self._config, self._environments, self._shards = config.sac, environments, environments.shards
        sac = config.sac
        # At least one batch and one n-step window must be recorded before the first update.
        slots = environments.recurrent_slots
        self._units = slots.stop - slots.start
        self._steps = sac.recurrent_steps if self._units else 0
        needed = max(sac.n_step, self._steps)
        first = max(math.ceil(sac.warmup_steps / sac.num_envs), math.ceil(sac.batch_size / sac.num_envs), needed)
        self.schedule = Schedule(sac.total_steps, sac.num_envs, first * sac.num_envs, sac.num_evaluations)
        self._sizes = (environments.observation_size, environments.action_size - self._units)
        self._mask = environments.policy_mask
        recurrent = slots if self._units else None
        self.networks = make_networks(sac, self._mask, self._sizes[1], environments.critic_mask, recurrent)
        self._update = make_update(self.networks, sac, self._sizes[1], self._shards.mean)

    def init(self, key: Array) -> SacState:
        """Initial learner and an empty replay."""
        capacity = self._config.replay_size // self._shards.parts
        return SacState(
            create(self.networks, self._config, self._sizes[0], key),
            replay.create(capacity, self._environments.count, *self._sizes),
        )

    def collect(self, state: SacState, envs: Any, keys: Sequence[Array], phase: TrainingPhase) -> tuple[SacState, Any]:
        """One step of all environments, which enters the replay and the normaliser."""
        learner, (*act_keys, reset_key) = state.learner, keys
        action, memory = self._act(learner, envs.states.obs, act_keys, phase)
        envs, transition = self._environments.step(envs, jnp.concatenate([action, memory], axis=-1), reset_key)
        transitions = Transitions(
            transition.observation,
            action,
            transition.reward,
            1 - transition.terminated,
            transition.next_observation,
            transition.done,
        )
        normaliser = brax.running_statistics.update(
            learner.normaliser, transition.observation, pmap_axis_name=self._shards.axis
        )
        normaliser = jax.tree.map(lambda new, old: jnp.where(phase.recording, new, old), normaliser, learner.normaliser)
        buffer = replay.insert(state.replay, transitions, phase.recording)
        return SacState(learner._replace(normaliser=normaliser), buffer), envs

    def _act(
        self, learner: Learner, observation: Float[Array, "envs n"], keys: Sequence[Array], phase: TrainingPhase
    ) -> tuple[Float[Array, "envs actions"], Float[Array, "envs units"]]:
        """(actions, next states of a recurrent policy)."""
        sample_key, random_key = map(self._shards.own, keys)
        policy = jax.tree.map(lambda mean, new: jnp.where(phase.evaluate, mean, new), learner.average, learner.policy)
        parameters, memory = answer(self.networks.policy_network, learner.normaliser, policy, observation)
        distribution = self.networks.parametric_action_distribution
        shape = (self._environments.count, self._sizes[1])
        sampled = distribution.sample(parameters, jax.random.normal(sample_key, shape))
        uniform = jax.random.uniform(random_key, shape, minval=-1.0, maxval=1.0)
        chosen = jnp.where(phase.random, uniform, sampled)
        return jnp.where(phase.evaluate, distribution.mode(parameters), chosen), memory

    def update(
        self, state: SacState, keys: Sequence[Array], progress: Float[Array, ""], phase: TrainingPhase
    ) -> tuple[SacState, dict[str, Float[Array, ""]]]:
        """`updates_per_step` gradient steps, each on a batch from the replay."""
        rate = 1.0 + (self._config.learning_rate_final_ratio - 1.0) * progress
        batch_key, noise_key = map(self._shards.own, keys)
        zero = jnp.zeros(())
        learner, losses = jax.lax.cond(
            phase.learning,
            lambda: self._learn(state, batch_key, noise_key, rate),
            lambda: (state.learner, Losses(zero, zero, zero)),
        )
        report = (jnp.exp(learner.log_alpha), losses.entropy, losses.critic, losses.policy)
        return state._replace(learner=learner), dict(zip(self.metrics, report, strict=True))

    def _learn(
        self, state: SacState, batch_key: Array, noise_key: Array, rate: Float[Array, ""]
    ) -> tuple[Learner, Losses]:
        sac = self._config
        shape = (sac.updates_per_step, sac.batch_size // self._shards.parts)
        draws = jax.random.bits(batch_key, shape, jnp.uint32)
        noise = jax.random.normal(noise_key, (shape[0], 2, shape[1], self._sizes[1]))
        batches = jax.vmap(
            lambda bits: replay.sample(
                state.replay, bits, self._environments.count, *self._sizes, sac.n_step, sac.discount
            )
        )(draws)
        seen = self._sequences(state.replay, draws) if self._units else None
        # Sampled once for all updates. Without the barrier XLA would sample, gather and sum again at every use.
        batches, noise, seen = jax.lax.optimization_barrier((batches, noise, seen))

        def one(index: Int[Array, ""], carry: tuple[Learner, Losses]) -> tuple[Learner, Losses]:
            batch, sequences = jax.tree.map(lambda part: part[index], (batches, seen))
            return self._update(carry[0], batch, noise[index], rate, sequences)

        zero = jnp.zeros(())
        return jax.lax.fori_loop(0, sac.updates_per_step, one, (state.learner, Losses(zero, zero, zero)))

    def _sequences(self, memory: Replay, draws: Array) -> Float[Array, "updates steps sequences n"]:
        """Sampled sequences of observations. Those of one update contain a batch of observations in all."""
        firsts = draws[:, : draws.shape[1] // self._steps]
        count, size, steps = self._environments.count, self._sizes[0], self._steps
        return jax.vmap(lambda bits: replay.observations(memory, bits, count, size, steps))(firsts)

    def policy(self, state: SacState) -> PolicyNetwork:
        """The running average of the policy, with its normalisation."""
        learner = state.learner
        mask = jnp.asarray(self._mask, jnp.float32)
        layers = exported(learner.average["params"])
        return PolicyNetwork(layers, learner.normaliser.mean, learner.normaliser.std, mask)

    def partition(self, whole: Any, split: Any) -> SacState:
        """The replay's rows are cut by environments, the rest is whole."""
        return SacState(whole, Replay(rows=split, inserted=whole))

    def check_parts(self, parts: int) -> None:
        """Raise InputError unless environments, batch and replay can be cut into `parts` equal parts."""
        sac = self._config
        for name, whole in (
            ("num_envs", parts),
            ("batch_size", parts * max(self._steps, 1)),
            ("replay_size", parts * max(sac.num_envs // parts, 1)),
        ):
            if getattr(sac, name) % whole:
                steps = f" in sequences of {self._steps} steps" if name == "batch_size" and self._steps else ""
                raise InputError(
                    f"sac.{name} = {getattr(sac, name)} cannot be split over {parts} devices{steps} evenly; "
                    f"make it a multiple of {whole}"
                )
