"""First-order gradients of the return through a differentiable environment, window by window of its episodes."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjxball.algorithms.base import Environments, Phase, PolicyNetwork, Schedule
from mjxball.algorithms.recurrent import fresh_layers
from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile
from mjxball.scalar_form import scalar_form

SMALL_RESPONSE = 1e-3  # to an impulse of 1, in deviations of observations and in actions: below that it is over
MAX_GRAD_NORM = 1.0  # largest global norm of a gradient
IMPULSE_RESPONSE_FROM = 0.75  # share of the gradient steps after which it begins to count
LEAST_DEVIATION = 0.02  # of an observation: what hardly moves in the first flights is not blown up


@jax.custom_batching.custom_vmap
def _of_all(value: Array) -> Array:
    """`value`, which is the same in every member of a population, as one number for all of them.

    What hangs on it is then one branch, where members of their own would compute both.
    """
    return value


@_of_all.def_vmap
def _of_all_members(count: int, batched: Any, value: Array) -> tuple[Array, bool]:
    return (value[0] if batched[0] else value), False


class GradientState(NamedTuple):
    """What the algorithm knows."""

    layers: Any  # Flax's names: {"hidden_0": {"kernel", "bias"}, ...}, and "gru" (`PolicyNetwork`)
    adam: Any
    slope: Any  # gradient of the last window's loss, a pytree like `layers`
    loss: Array  # () minus the mean reward of the last window
    mean: Array  # (n,) of the observations in the first window, which nothing is learnt from
    square: Array  # (n,) mean of their squares
    seen: Array  # () 1 once they are known
    windows: Array  # () flown, as an integer


class FirstOrderGradient:
    """Backpropagation through windows of `gradient.horizon` steps of all environments, then one step of Adam.

    `collect` flies a window and differentiates its mean reward with respect to the policy's weights; `update` takes
    the step. Windows follow one another in an episode of `gradient.windows_per_episode`, of several lengths if it has
    several; the environments begin theirs in turn, so that every window has flights towards the goal and flights at
    it. `gradient.gradient_decay` multiplies
    the gradient that passes from one control step to the one before, and `gradient.state_gradient_clip` limits it in
    each environment. A recurrent network's own state passes it whole: that is what it is to learn to remember by.
    `gradient.impulse_response` asks for a closed loop that is well damped about every flight, however small its errors.
    """

    metrics = ("loss", "gradient_norm")
    engines = ("newton-euler",)  # MJX iterates, and what iterates has no gradient backwards
    prefers_cpu = True
    collect_keys = 1
    update_keys = 0

    def __init__(self, config: Config, environments: Environments):
        own = config.gradient
        # Number by number a window's gradient takes a quarter of the time, and two thirds to compile; but it has none
        # forwards.
        self._environments, self._plain = (environments.rewritten(form) for form in (scalar_form, jax.vmap))
        self._config = own
        self._shards = environments.shards
        self._adam = optax.scale_by_adam(*own.adam_betas)
        self.steps_per_collect = own.horizon
        window = own.num_envs * own.horizon
        self.schedule = Schedule((own.gradient_steps + 1) * window, own.num_envs, window, own.num_evaluations)
        self._slots = environments.recurrent_slots
        self._units = self._slots.stop - self._slots.start
        self._actions = environments.action_size - self._units
        self._sizes = (environments.observation_size, *own.policy_layers, 2 * self._actions)
        self._mask: Any = np.asarray(environments.policy_mask, np.float32)
        weight: Any = own.impulse_response  # no number where a sweep traces it
        self._responds = not (isinstance(weight, (int, float)) and weight == 0)
        self._responds_from = round(IMPULSE_RESPONSE_FROM * own.gradient_steps)  # windows

    def init(self, key: Array) -> GradientState:
        """A policy that adds hardly anything."""
        seen = self._slots.start if self._units else self._sizes[0]
        layers = fresh_layers(key, seen, self._units, self._sizes[1:])
        zero, none = jnp.zeros(()), jnp.zeros(self._sizes[0])
        slope = jax.tree.map(jnp.zeros_like, layers)
        return GradientState(layers, self._adam.init(layers), slope, zero, none, none, zero, jnp.zeros((), jnp.int32))

    def start_from(self, state: GradientState, policy: PolicyFile) -> GradientState:
        """`state`, but with the network of `policy` and its normalisation, in NumPy.

        What only critics see stands behind what the policy does, and keeps its rows. InputError for other layers.
        """
        seen, units = len(policy.observation_mean), 0 if policy.gru is None else len(policy.gru[1])
        sizes = (seen + units, *(len(bias) for bias in policy.biases))
        if sizes[1:] != self._sizes[1:] or sizes[0] > self._sizes[0] or units != self._units:
            theirs, own = (",".join(map(str, hidden[1:-1])) for hidden in (sizes, self._sizes))
            raise InputError(
                f"the policy to start from has {seen} inputs, {units} recurrent units and hidden layers {theirs}, and "
                f"the run has {self._sizes[0] - self._units}, {self._units} and {own}; say "
                f"--gradient.policy_layers {theirs} --follower.recurrent_units {units}"
            )
        scale = np.asarray(policy.observation_scale, np.float64)
        deviation = np.where(scale > 0, np.maximum(1 / np.where(scale > 0, scale, 1.0), LEAST_DEVIATION), 1.0)
        mean, factor = np.asarray(policy.observation_mean, np.float64), (deviation * scale)[:, None]
        kernels = [np.array(state.layers[f"hidden_{number}"]["kernel"]) for number in range(len(policy.weights))]
        kernels[0][:units] = policy.weights[0][:units]
        kernels[0][units : units + seen] = policy.weights[0][units:] * factor
        kernels[1:] = policy.weights[1:]
        layers: dict[str, Any] = {
            f"hidden_{number}": {"kernel": np.asarray(kernel, np.float32), "bias": np.asarray(bias, np.float32)}
            for number, (kernel, bias) in enumerate(zip(kernels, policy.biases, strict=True))
        }
        if policy.gru is not None:
            kernel, recurrent, bias = policy.gru
            layers["gru"] = {"kernel": np.asarray(kernel * factor, np.float32), "recurrent": recurrent, "bias": bias}
        means, squares = np.zeros(self._sizes[0], np.float32), np.ones(self._sizes[0], np.float32)
        means[:seen], squares[:seen] = mean, mean**2 + deviation**2
        return state._replace(layers=layers, mean=means, square=squares, seen=np.ones((), np.float32))

    def collect(self, state: GradientState, envs: Any, keys: Sequence[Array], phase: Phase) -> tuple[Any, Any]:
        """One window of all environments and its gradient; the first one gives the observations' statistics."""
        own = self._environments
        begins = starts_anew(own.turn, state.windows, self._config.windows_per_episode)
        envs = own.restart(envs, keys[0], begins & phase.recording)
        # Also by the first states, where they allow it: JAX then sees at once what the loop carries a gradient of.
        arguments = (0, 2) if own.smooth else (0,)
        differentiated = jax.value_and_grad(self._window, arguments, has_aux=True, allow_int=True)
        flown = functools.partial(differentiated, state.layers, state, envs)
        if self._responds:
            own_key = self._shards.own(jax.random.fold_in(keys[0], 1))
            impulse = jax.random.normal(own_key, (len(envs.states.obs), self._actions))
            late = _of_all(state.windows) >= self._responds_from
            whole, plain = functools.partial(flown, impulse), functools.partial(flown, ())
            found = jax.lax.cond(late, whole, plain) if self._responds_from else whole()
            (loss, (envs, mean, square)), (slope, *_) = found
        else:
            (loss, (envs, mean, square)), (slope, *_) = flown(())
        slope, loss, mean, square = self._shards.mean((slope, loss, mean, square))
        first = (phase.random & phase.recording).astype(jnp.float32) * (1 - state.seen)
        known = GradientState(
            layers=state.layers,
            adam=state.adam,
            slope=slope,
            loss=loss,
            mean=first * mean + (1 - first) * state.mean,
            square=first * square + (1 - first) * state.square,
            seen=jnp.maximum(state.seen, first),
            windows=state.windows + 1,
        )
        known = jax.tree.map(lambda new, old: jnp.where(phase.recording, new, old), known, state)
        return known, envs

    def _window(self, layers: Any, state: GradientState, envs: Any, impulse: Any) -> Any:
        policy = self.policy(state._replace(layers=layers))
        respond = jax.checkpoint(functools.partial(self._respond, policy))

        def step(carry: Any, _: None) -> tuple[Any, tuple[Array, Array]]:
            envs, response, impulse = carry
            envs = envs._replace(states=self._damped(envs.states))
            seen, lasting = envs.states.obs, 0.0
            if response:
                response, lasting = respond(envs, response, impulse)
            envs, after = self._environments.step(envs, policy(seen), None)
            impulse = jax.tree.map(jnp.zeros_like, impulse)  # over after one step
            return (_forget(envs), response, impulse), (after.reward - lasting, jax.lax.stop_gradient(seen))

        answers = isinstance(impulse, jax.Array)
        response = jax.tree.map(jnp.zeros_like, _floats(envs.states)) if answers else []
        start: Any = envs, response, impulse
        (envs, *_), (rewards, seen) = jax.lax.scan(step, start, length=self._config.horizon)
        return -rewards.mean(), (envs, seen.mean(axis=(0, 1)), (seen**2).mean(axis=(0, 1)))

    def _respond(
        self, policy: PolicyNetwork, envs: Any, response: list[Array], impulse: Array
    ) -> tuple[list[Array], Array]:
        """(what `response` of `_floats(envs.states)` is one step on, the cost of it (envs,)).

        The closed loop is linearised about the flight, which has no gradient here: the policy's slopes alone have one.
        What counts are the observations, each over its deviation, and the actions, so that what followers do against
        each other counts as well, which none of them sees.
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
        """`states`; the gradient that passes them backwards is made smaller, that of a network's own state is not."""
        decay: Any = self._config.gradient_decay
        clip: Any = self._config.state_gradient_clip
        if isinstance(clip, float) and clip == 0:  # neither is a number where a sweep traces it
            damped = states if isinstance(decay, float) and decay == 1 else _decayed(states, decay)
        else:
            damped = _clipped(states, decay, clip / (self._config.horizon * self._environments.count))
        if not self._units:
            return damped
        own, seen = self._slots, damped.obs
        parts = [seen[..., : own.start], states.obs[..., own], seen[..., own.stop :]]
        return damped.replace(obs=jnp.concatenate(parts, axis=-1))

    def update(
        self, state: GradientState, keys: Sequence[Array], progress: Array, phase: Phase
    ) -> tuple[GradientState, dict[str, Array]]:
        """One step of Adam along the window's gradient; its rate falls by a cosine."""
        own = self._config
        norm = optax.global_norm(state.slope)
        # A window that diverged has no gradient.
        sound = jnp.isfinite(norm) & phase.learning
        slope = jax.tree.map(
            lambda one: jnp.where(sound, one * jnp.minimum(1.0, MAX_GRAD_NORM / (norm + 1e-9)), 0.0), state.slope
        )
        fall = own.learning_rate_final_ratio + (1.0 - own.learning_rate_final_ratio) * 0.5 * (
            1.0 + jnp.cos(jnp.pi * progress)
        )
        direction, adam = self._adam.update(slope, state.adam)
        rate = own.learning_rate * fall
        moved = state._replace(
            layers=jax.tree.map(lambda value, along: value - rate * along, state.layers, direction), adam=adam
        )
        moved = jax.tree.map(lambda new, old: jnp.where(sound, new, old), moved, state)
        return moved, dict(zip(self.metrics, (state.loss, norm), strict=True))

    def policy(self, state: GradientState) -> PolicyNetwork:
        """The policy as it is."""
        xp = state.mean.__array_namespace__()  # NumPy's, when a policy file is written: nothing is compiled for that
        variance = state.square - state.mean**2
        deviation = xp.where(state.seen > 0, xp.sqrt(xp.maximum(variance, LEAST_DEVIATION**2)), 1.0)
        return PolicyNetwork(state.layers, state.mean, deviation, self._mask)

    def partition(self, whole: Any, split: Any) -> Any:
        """Everything that is known is whole."""
        return whole

    def check_parts(self, parts: int) -> None:
        """Raise InputError unless the environments can be cut into `parts`."""
        if self._config.num_envs % parts:
            raise InputError(
                f"gradient.num_envs = {self._config.num_envs} cannot be split over {parts} devices evenly; "
                "make it a multiple"
            )


def starts_anew(turn: Any, windows: Any, lengths: Sequence[int]) -> Any:
    """(count,) which environments begin an episode when `windows` of it are flown.

    `turn` (count,): their place in turn (`Environments.turn`). Neighbours have different `lengths`, and those of one
    length begin in turn.
    """
    own = jnp.asarray(lengths)[turn % len(lengths)]
    return (turn // len(lengths) + windows) % own == 0


def _forget(envs: Any) -> Any:
    """`envs` without the derivatives of what the next step does not start from: a scan would carry them all back."""
    still, states = jax.lax.stop_gradient, envs.states
    past = {name: still(getattr(states, name)) for name in ("reward", "done", "metrics", "info")}
    return envs._replace(states=states.replace(**past), statistics=still(envs.statistics))


def _floats(tree: Any) -> list[Array]:
    """The leaves of `tree` that have derivatives."""
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _with_floats(tree: Any, floats: Sequence[Array]) -> Any:
    """`tree` with these in place of them."""
    leaves, structure = jax.tree.flatten(tree)
    given = iter(floats)
    return jax.tree.unflatten(
        structure, [next(given) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf for leaf in leaves]
    )


def _decayed(tree: Any, factor: float) -> Any:
    """`tree` as it is; a gradient that passes through its floats is multiplied by `factor`."""

    def one(leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return factor * leaf + (1.0 - factor) * jax.lax.stop_gradient(leaf)

    return jax.tree.map(one, tree)


@jax.custom_vjp
def _clip_backwards(leaves: list[Array], decay: Array, longest: Array) -> list[Array]:
    """`leaves`, arrays (envs, ...); see `_clipped`."""
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
    """`tree` as it is; a gradient that passes through its floats is at most `longest` in each environment, then decays.

    Numbers of it that are not finite are 0. Leaves of other lengths, as those of worlds with several followers, are
    limited apart. Without this a few environments that are about to diverge lead all others astray.
    """
    leaves, structure = jax.tree.flatten(tree)
    floats = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    for count in {len(leaves[k]) for k in floats}:
        own = [k for k in floats if len(leaves[k]) == count]
        passed = _clip_backwards([leaves[k] for k in own], jnp.float32(decay), jnp.float32(longest))
        for k, leaf in zip(own, passed, strict=True):
            leaves[k] = leaf
    return jax.tree.unflatten(structure, leaves)
