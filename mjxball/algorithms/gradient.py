"""First-order gradients of the return through a differentiable environment, over one window of an episode at a time."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjxball.algorithms.base import EnvironmentBatch, PolicyNetwork, Schedule, TrainingPhase
from mjxball.algorithms.recurrent import (
    ESTIMATE,
    estimates,
    estimation_cost,
    exported,
    fresh_estimate,
    fresh_layers,
)
from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile
from mjxball.rewards import used
from mjxball.scalar_form import scalar_form

SMALL_RESPONSE = 1e-3  # response to a unit impulse, in deviations of observations and in actions, that is negligible
MAX_GRAD_NORM = 1.0  # largest global norm of a gradient
IMPULSE_RESPONSE_FROM = 0.75  # share of the training after which the impulse response counts
# Environments of a pair whose gradient two cores (115 000 steps/s) compute in the 0.25 s that an H200 takes for any
# number of them. Those of larger teams take longer.
MOST_ON_CPU = 200
LEAST_DEVIATION = 0.02  # of an observation, so that one which hardly moves in the first window is not amplified


@jax.custom_batching.custom_vmap
def _unbatched(value: Array) -> Array:
    """`value`, equal in all members of a population, as one unbatched scalar.

    `lax.cond` on it runs one branch. On a batched value it would compute both.
    """
    return value


@_unbatched.def_vmap
def _unbatched_rule(count: int, batched: Any, value: Array) -> tuple[Array, bool]:
    return (value[0] if batched[0] else value), False


class GradientState(NamedTuple):
    """State of `FirstOrderGradient`."""

    layers: Any  # Flax's names: {"hidden_0": {"kernel", "bias"}, ...}, "gru" (`PolicyNetwork`), and ESTIMATE
    adam: Any
    slope: Any  # gradient of the last window's loss, a pytree like `layers`
    loss: Array  # () minus the mean reward of the last window
    mean: Array  # (n,) of the observations in the first window, in which the policy does not learn
    square: Array  # (n,) mean of their squares
    seen: Array  # () 1 once `mean` and `square` are known
    windows: Array  # () integer number of windows flown
    progress: Array  # () share of the training that is done


class FirstOrderGradient:
    """Backpropagation through windows of `gradient.horizon` steps of all environments, then one step of Adam.

    `collect` flies a window and differentiates its mean reward by the policy's weights; `update` takes the step. An
    episode is `gradient.windows_per_episode` windows long; with several lengths, environments differ. Their starts are
    staggered, so that every window contains flights towards the goal and flights at it.

    `gradient.gradient_decay` multiplies the gradient that passes from one control step to the one before, and
    `gradient.state_gradient_clip` limits it in each environment. The gradient of a recurrent network's state is neither
    decayed nor clipped, so that the network learns to remember. `gradient.impulse_response` weights a cost of poorly
    damped closed loops, however small the errors of the flight.

    The gradient sees no longer than a window. A memory that fades within one window is therefore trained whole, but
    one that drifts over several is not: its error of tens of seconds later costs nothing now. With
    `gradient.exchanged_memory` some windows begin with the memory of another environment, which the network must
    learn to correct.
    """

    metrics = ("loss", "gradient_norm")
    engines = ("newton-euler",)  # MJX's solver iterates in a loop, which has no reverse-mode gradient
    averaged = ("slope", "loss", "mean", "square")  # of the state after `collect`, over parts that are not joined
    long_loops = True
    collect_keys = 1
    update_keys = 0

    @staticmethod
    def prefers_cpu(config: Config, members: int) -> bool:
        """Whether two cores train as fast as a GPU, whose time hardly depends on the number of environments."""
        return members * config.gradient.num_envs * config.plant.count / 2 <= MOST_ON_CPU

    def __init__(self, config: Config, environments: EnvironmentBatch):
        settings = config.gradient
        # In scalar form a window's gradient takes a quarter of the time, and two thirds to compile. It has no
        # forward-mode gradient, which impulse responses need.
        self._environments, self._plain = (environments.rewritten(form) for form in (scalar_form, jax.vmap))
        self._config = settings
        self._shards = environments.shards
        self._adam = optax.scale_by_adam(*settings.adam_betas)
        self.steps_per_collect = settings.horizon
        window = settings.num_envs * settings.horizon
        steps = (settings.gradient_steps + 1) * window
        self.schedule = Schedule(steps, settings.num_envs, window, settings.num_evaluations)
        self._slots = environments.recurrent_slots
        self._units = self._slots.stop - self._slots.start
        self._actions = environments.action_size - self._units
        self._sizes = (environments.observation_size, *settings.policy_layers, 2 * self._actions)
        self._mask: Any = np.asarray(environments.policy_mask, np.float32)
        self._responds = used(settings.impulse_response)
        self._estimated = self._sizes[0] - self._slots.stop  # numbers
        self._estimates = estimates("gradient", settings.estimation, self._units, self._estimated)
        self._exchanges = used(settings.exchanged_memory)
        if self._exchanges and not self._units:
            raise InputError("gradient.exchanged_memory needs a recurrent network: --follower.recurrent_units 48")

    def init(self, key: Array) -> GradientState:
        """Initial state. The first policy outputs actions close to 0."""
        inputs = self._slots.start if self._units else self._sizes[0]
        layers = fresh_layers(key, inputs, self._units, self._sizes[1:])
        if self._estimates:
            layers[ESTIMATE] = fresh_estimate(self._units, self._estimated)
        zero, zeros = jnp.zeros(()), jnp.zeros(self._sizes[0])
        slope = jax.tree.map(jnp.zeros_like, layers)
        windows = jnp.zeros((), jnp.int32)
        return GradientState(layers, self._adam.init(layers), slope, zero, zeros, zeros, zero, windows, zero)

    def start_from(self, state: GradientState, policy: PolicyFile) -> GradientState:
        """`state` with the network and normalisation of `policy`, as NumPy arrays.

        A smaller network gives the same actions: the weights that it has not stay as they are in `state`, but for those
        from a new unit to one of its own or to an action, which are 0. Inputs of critics alone follow the policy's
        inputs; their rows stay. `train.run_directory.start_policy` checks the sizes. InputError for other inputs.
        """
        seen, units = len(policy.observation_mean), 0 if policy.gru is None else len(policy.gru[1])
        theirs, own = [len(bias) for bias in policy.biases[:-1]], self._sizes[1:-1]
        if seen > self._sizes[0] or (units and seen != self._slots.start):
            inputs = self._slots.start if units else self._sizes[0]
            raise InputError(f"the policy to start from has {seen} inputs, and the run {inputs}")
        scale = np.asarray(policy.observation_scale, np.float64)
        deviation = np.where(scale > 0, np.maximum(1 / np.where(scale > 0, scale, 1.0), LEAST_DEVIATION), 1.0)
        mean, factor = np.asarray(policy.observation_mean, np.float64), (deviation * scale)[:, None]
        layers = jax.tree.map(np.array, state.layers)
        last = len(theirs)
        for number, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
            layer, columns = layers[f"hidden_{number}"], len(bias)
            if number == 0:  # a GRU's state, then inputs
                parts = [(self._units, weight[:units]), (seen, weight[units:] * factor)]
            elif number == last:  # the layer below, then a GRU's state
                parts = [(own[-1], weight[: theirs[-1]]), (self._units, weight[theirs[-1] :])]
            else:
                parts = [(own[number - 1], weight)]
            start = 0
            for rows, known in parts:
                layer["kernel"][start : start + rows, :columns] = _padded(known, rows)
                start += rows
            layer["bias"][:columns] = bias
        if policy.gru is not None:
            kernel, recurrent, bias = policy.gru
            own_gru = layers["gru"]
            for name, known in (("kernel", kernel * factor), ("recurrent", recurrent), ("bias", bias[None])):
                gates = own_gru[name].reshape(-1, 3, self._units)
                gates[..., :units] = _padded(known.reshape(-1, 3, units), len(gates))
                own_gru[name] = gates.reshape(own_gru[name].shape)
        means, squares = np.zeros(self._sizes[0], np.float32), np.ones(self._sizes[0], np.float32)
        means[:seen], squares[:seen] = mean, mean**2 + deviation**2
        return state._replace(layers=layers, mean=means, square=squares, seen=np.ones((), np.float32))

    def collect(self, state: GradientState, envs: Any, keys: Sequence[Array], phase: TrainingPhase) -> tuple[Any, Any]:
        """One window of all environments and its gradient. The first window gives the observations' statistics."""
        environments = self._environments
        begins = begins_episode(environments.turn, state.windows, self._config.windows_per_episode)
        envs = environments.restart(envs, keys[0], begins & phase.recording)
        if self._exchanges:
            envs = self._exchanged(envs, jax.random.fold_in(keys[0], 2), phase)
        # Where possible, differentiate by the initial states too: JAX then knows which carries have a gradient.
        arguments = (0, 2) if environments.smooth else (0,)
        differentiated = jax.value_and_grad(self._window, arguments, has_aux=True, allow_int=True)
        flown = functools.partial(differentiated, state.layers, state, envs)
        if self._responds:
            size = (len(envs.states.obs) * self._shards.parts, self._actions)
            impulse = self._shards.cut(jax.random.normal(jax.random.fold_in(keys[0], 1), size))
            late = _unbatched(state.progress) >= IMPULSE_RESPONSE_FROM
            with_impulse, without = functools.partial(flown, impulse), functools.partial(flown, ())
            (loss, (envs, mean, square)), (slope, *_) = jax.lax.cond(late, with_impulse, without)
        else:
            (loss, (envs, mean, square)), (slope, *_) = flown(())
        slope, loss, mean, square = self._shards.mean((slope, loss, mean, square))
        first = (phase.random & phase.recording).astype(jnp.float32) * (1 - state.seen)
        updated = GradientState(
            layers=state.layers,
            adam=state.adam,
            slope=slope,
            loss=loss,
            mean=first * mean + (1 - first) * state.mean,
            square=first * square + (1 - first) * state.square,
            seen=jnp.maximum(state.seen, first),
            windows=state.windows + 1,
            progress=state.progress,
        )
        updated = jax.tree.map(lambda new, old: jnp.where(phase.recording, new, old), updated, state)
        return updated, envs

    def _exchanged(self, envs: Any, key: Array, phase: TrainingPhase) -> Any:
        """`envs`, each of which gets the state of another one's GRU with probability `exchanged_memory`."""
        whose_key, own_key = jax.random.split(key)
        seen = envs.states.obs
        memory, cut = seen[:, self._slots], self._shards.cut
        everyone = self._shards.gathered(memory)
        other = jnp.roll(everyone, jax.random.randint(whose_key, (), 1, max(len(everyone), 2)), axis=0)
        other = other if other.shape == memory.shape else cut(other)
        exchanged = cut(jax.random.uniform(own_key, (self._config.num_envs,))) < self._config.exchanged_memory
        taken = exchanged & phase.recording
        seen = seen.at[:, self._slots].set(jnp.where(taken[:, None], other, memory))
        return envs._replace(states=envs.states.replace(obs=seen))

    def _window(self, layers: Any, state: GradientState, envs: Any, impulse: Any) -> Any:
        """(loss, (envs, mean (n,) of the observations, mean (n,) of their squares)) after one window.

        `impulse` (envs, actions) starts an impulse response, whose cost the loss then contains; () for none.
        """
        policy = self.policy(state._replace(layers=layers))
        advance = jax.checkpoint(functools.partial(self._advance_response, policy))

        def step(carry: Any, _: None) -> tuple[Any, tuple[Array, Array]]:
            envs, response, impulse = carry
            envs = envs._replace(states=self._damped(envs.states))
            seen, lasting = envs.states.obs, 0.0
            if response:
                response, lasting = advance(envs, response, impulse)
            answer = policy(seen)
            if self._estimates:
                lasting = lasting + self._estimation_cost(layers, policy, seen, answer[..., self._actions :])
            envs, after = self._environments.step(envs, answer, None)
            impulse = jax.tree.map(jnp.zeros_like, impulse)  # lasts one step
            return (_forget(envs), response, impulse), (after.reward - lasting, jax.lax.stop_gradient(seen))

        has_impulse = isinstance(impulse, jax.Array)
        response = jax.tree.map(jnp.zeros_like, _floats(envs.states)) if has_impulse else []
        start: Any = envs, response, impulse
        (envs, *_), (rewards, seen) = jax.lax.scan(step, start, length=self._config.horizon)
        return -rewards.mean(), (envs, seen.mean(axis=(0, 1)), (seen**2).mean(axis=(0, 1)))

    def _estimation_cost(self, layers: Any, policy: PolicyNetwork, seen: Array, hidden: Array) -> Array:
        """(envs,) cost of how far the estimates from a GRU's state `hidden` are from what critics alone observe."""
        known = slice(self._slots.stop, None)
        true = (seen[..., known] - policy.mean[known]) / policy.deviation[known]
        return self._config.estimation * estimation_cost(layers[ESTIMATE], hidden, true)

    def _advance_response(
        self, policy: PolicyNetwork, envs: Any, response: list[Array], impulse: Array
    ) -> tuple[list[Array], Array]:
        """(`response` after one more step, its cost (envs,)).

        `response` is a tangent of `_floats(envs.states)`: the closed loop is linearised about the flight. The flight is
        held constant, so that the gradient reaches the policy through its derivatives only. The cost counts the
        observations, each over its deviation, and the actions, because followers that act against each other may leave
        all observations unchanged.
        """
        still = jax.lax.stop_gradient(envs)
        size = impulse.shape[-1]

        def one(floats: list[Array], impulse: Array) -> tuple[list[Array], Array]:
            states = _with_floats(still.states, floats)
            answer = policy(states.obs)
            answer = jnp.concatenate([answer[..., :size] + impulse, answer[..., size:]], axis=-1)
            after, _ = self._plain.step(still._replace(states=states), answer, None)
            return _floats(_forget(after).states), answer[..., :size]

        response = _floats(self._damped(_with_floats(still.states, response)))
        point = _floats(still.states), jnp.zeros_like(impulse)
        _, (response, action) = jax.jvp(one, point, (response, impulse))
        seen = _with_floats(still.states, response).obs * self._mask / jax.lax.stop_gradient(policy.deviation)
        seen = seen[..., : self._slots.start if self._units else None]
        square = (seen**2).sum(axis=-1) + (action**2).sum(axis=-1)
        return response, self._config.impulse_response * jnp.log1p(square / SMALL_RESPONSE**2)

    def _damped(self, states: Any) -> Any:
        """`states`, whose backward gradient decays and is clipped, except that of a recurrent network's state."""
        decay: Any = self._config.gradient_decay
        clip: Any = self._config.state_gradient_clip
        if isinstance(clip, float) and clip == 0:  # in a sweep both are traced arrays
            damped = states if isinstance(decay, float) and decay == 1 else _decayed(states, decay)
        else:
            damped = _clipped(states, decay, clip / (self._config.horizon * self._environments.count))
        if not self._units:
            return damped
        slots, observation = self._slots, damped.obs
        parts = [observation[..., : slots.start], states.obs[..., slots], observation[..., slots.stop :]]
        return damped.replace(obs=jnp.concatenate(parts, axis=-1))

    def update(
        self, state: GradientState, keys: Sequence[Array], progress: Array, phase: TrainingPhase
    ) -> tuple[GradientState, dict[str, Array]]:
        """One step of Adam along the window's gradient. The learning rate decays by a cosine."""
        settings = self._config
        norm = optax.global_norm(state.slope)
        # The gradient of a diverged window is not finite: no step.
        sound = jnp.isfinite(norm) & phase.learning
        slope = jax.tree.map(
            lambda one: jnp.where(sound, one * jnp.minimum(1.0, MAX_GRAD_NORM / (norm + 1e-9)), 0.0), state.slope
        )
        final = settings.learning_rate_final_ratio
        fall = final + (1.0 - final) * 0.5 * (1.0 + jnp.cos(jnp.pi * progress))
        direction, adam = self._adam.update(slope, state.adam)
        rate = settings.learning_rate * fall
        moved = state._replace(
            layers=jax.tree.map(lambda value, along: value - rate * along, state.layers, direction), adam=adam
        )
        moved = jax.tree.map(lambda new, old: jnp.where(sound, new, old), moved, state)
        moved = moved._replace(progress=jnp.where(phase.learning, progress, state.progress))
        return moved, dict(zip(self.metrics, (state.loss, norm), strict=True))

    def policy(self, state: GradientState) -> PolicyNetwork:
        """The current policy."""
        xp = state.mean.__array_namespace__()  # NumPy when a policy file is written, so that nothing is compiled
        variance = state.square - state.mean**2
        deviation = xp.where(state.seen > 0, xp.sqrt(xp.maximum(variance, LEAST_DEVIATION**2)), 1.0)
        return PolicyNetwork(exported(state.layers), state.mean, deviation, self._mask)

    def partition(self, whole: Any, split: Any) -> Any:
        """No array of the state is cut by environments."""
        return whole

    def check_parts(self, parts: int) -> None:
        """Raise InputError unless the environments can be cut into `parts` equal parts."""
        if self._config.num_envs % parts:
            raise InputError(
                f"gradient.num_envs = {self._config.num_envs} cannot be split over {parts} devices evenly; "
                "make it a multiple"
            )


def _padded(known: np.ndarray, rows: int) -> np.ndarray:
    """(rows, ...) array that begins with `known`, with zeros below."""
    return np.concatenate([known, np.zeros((rows - len(known), *known.shape[1:]), known.dtype)])


def begins_episode(turn: Any, windows: Any, lengths: Sequence[int]) -> Any:
    """(count,) which environments begin an episode after `windows` windows of training.

    `turn` (count,): `Environments.turn`. `lengths`: possible lengths of an episode [windows]. Neighbours have different
    lengths, and the starts of environments with the same length are staggered.
    """
    length = jnp.asarray(lengths)[turn % len(lengths)]
    return (turn // len(lengths) + windows) % length == 0


def _forget(envs: Any) -> Any:
    """`envs` without derivatives of the fields that the next step does not read: a scan would carry them all back."""
    still, states = jax.lax.stop_gradient, envs.states
    past = {name: still(getattr(states, name)) for name in ("reward", "done", "metrics", "info")}
    return envs._replace(states=states.replace(**past), statistics=still(envs.statistics))


def _floats(tree: Any) -> list[Array]:
    """Leaves of `tree` with a floating dtype: those that have derivatives."""
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _with_floats(tree: Any, floats: Sequence[Array]) -> Any:
    """`tree` with its floating leaves (`_floats`) replaced by `floats`."""
    leaves, structure = jax.tree.flatten(tree)
    given = iter(floats)
    return jax.tree.unflatten(
        structure, [next(given) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf for leaf in leaves]
    )


def _decayed(tree: Any, factor: float) -> Any:
    """`tree`, unchanged; a gradient that passes back through its floating leaves is multiplied by `factor`."""

    def one(leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return factor * leaf + (1.0 - factor) * jax.lax.stop_gradient(leaf)

    return jax.tree.map(one, tree)


@jax.custom_vjp
def _clip_backwards(leaves: list[Array], decay: Array, longest: Array) -> list[Array]:
    """`leaves`, arrays (envs, ...), unchanged; its gradient is `_clip`."""
    return leaves


def _clip(factors: tuple[Array, Array], slopes: list[Array]) -> tuple[Any, ...]:
    decay, longest = factors
    slopes = [jnp.where(jnp.isfinite(one), one, 0.0) for one in slopes]
    length = jnp.sqrt(sum((one.reshape(len(one), -1) ** 2).sum(axis=1) for one in slopes))
    factor = decay * jnp.minimum(1.0, longest / (length + 1e-30))
    factor = jnp.where(jnp.isfinite(factor), factor, 0.0)
    kept = [one * factor.reshape((-1,) + (1,) * (one.ndim - 1)) for one in slopes]
    return kept, jnp.zeros_like(decay), jnp.zeros_like(longest)


_clip_backwards.defvjp(lambda leaves, decay, longest: (leaves, (decay, longest)), _clip)


def _clipped(tree: Any, decay: Any, longest: Any) -> Any:
    """`tree`, unchanged; a gradient back through it is clipped to `longest` in each environment, then decays.

    `longest` limits the norm over all floating leaves, `decay` multiplies the result. Entries that are not finite
    become 0. Leaves of different lengths, as in worlds with several followers, are clipped separately. Without the
    limit, a few environments close to divergence dominate the gradient of all.
    """
    leaves, structure = jax.tree.flatten(tree)
    floats = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    for count in {len(leaves[k]) for k in floats}:
        own = [k for k in floats if len(leaves[k]) == count]
        passed = _clip_backwards([leaves[k] for k in own], jnp.float32(decay), jnp.float32(longest))
        for k, leaf in zip(own, passed, strict=True):
            leaves[k] = leaf
    return jax.tree.unflatten(structure, leaves)
