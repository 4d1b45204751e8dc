"""Policies of other trainers as policy files: Stable-Baselines3, SBX, Brax, or the layers of any ReLU network.

A policy file holds a network with ReLU layers whose outputs go through tanh. What is not such a network is refused, and
so is a file that would not answer as the trained policy does.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config, replace
from mjxball.control.network import Network
from mjxball.control.observation import ACTION_SIZE, action_mask
from mjxball.errors import InputError
from mjxball.policy.export import policy_file
from mjxball.policy.file import PolicyFile, check

SAMPLES, SPREAD = 256, 2.0  # observations of the comparison; their standard deviation, in those of training
ROUNDING = 1e-4  # of an action in [-1, 1], between two computations in float32
TANH_IS_ONE = 20.0  # beyond it tanh is 1 in float32
Layers = Sequence[tuple[Any, Any]]  # kernel (inputs, outputs) and bias (outputs,) of each layer


class _Learnt(NamedTuple):
    """What `policy_file` exports, as `algorithms.base.PolicyNetwork`."""

    layers: dict[str, dict[str, np.ndarray]]
    mean: np.ndarray
    deviation: np.ndarray


def from_sb3(model: Any, config: Config | None = None, masked: bool = False) -> PolicyFile:
    """The policy of a `model` of Stable-Baselines3 or SBX: SAC, or PPO behind `FollowerVecEnv(tanh=True)`.

    The model needs its environment, also after `load` (`env=...`). `config` is by default that of the environment.
    Statistics of a `VecNormalize` are part of the file, its `clip_obs` is not. `masked` as of `from_layers`. The file's
    actions on random observations are compared with `model.predict`. Raises InputError if they differ, or for a network
    or an environment that a policy file cannot hold.
    """
    env, name = model.get_env(), type(model).__name__
    if env is None:
        raise InputError("the model has no environment, which may normalise observations; load it with env=...")
    _check_wrappers(env)
    config = env.get_attr("config")[0] if config is None else config
    squashed = hasattr(model.policy, "actor") or hasattr(model.policy, "actor_state")
    if not np.allclose(model.action_space.high, 1.0 if squashed else TANH_IS_ONE):
        why = "has a tanh of its own" if squashed else "clips its actions, and a policy file ends in tanh"
        raise InputError(f"{name} {why}: train it on mjxball.gym.sb3.FollowerVecEnv(tanh={not squashed})")
    normalizer = model.get_vec_normalize_env()
    size = model.observation_space.shape[0]
    mean, deviation = np.zeros(size), np.ones(size)
    if normalizer is not None and normalizer.norm_obs:
        mean, deviation = normalizer.obs_rms.mean, np.sqrt(normalizer.obs_rms.var + normalizer.epsilon)

    def act(observations: np.ndarray) -> np.ndarray:
        seen = observations if normalizer is None else normalizer.normalize_obs(observations)
        actions = model.predict(seen, deterministic=True)[0]
        return actions if squashed else np.tanh(actions)

    origin = {"trainer": f"{type(model).__module__}.{name}", "seed": model.seed}
    return from_layers(_sb3_layers(model), config, mean, deviation, act, model.num_timesteps, origin, masked)


def _check_wrappers(env: Any) -> None:
    """Raise InputError for more than one normalisation around a `VecEnv` of Stable-Baselines3, or inside it."""
    import gymnasium

    outer, normalised = env, 0
    while outer is not None:
        normalised += "obs_rms" in vars(outer)  # a wrapper passes on what it has not
        outer = getattr(outer, "venv", None)
    inside = gymnasium.wrappers.NormalizeObservation
    if normalised > 1 or any(env.env_is_wrapped(inside)):
        raise InputError("the environment normalises observations elsewhere than in one VecNormalize")


def from_brax(
    parameters: Sequence[Any],
    config: Config,
    make_policy: Callable[..., Any] | None = None,
    normalize_observations: bool = False,
    steps: int = 0,
    masked: bool = False,
) -> PolicyFile:
    """The policy in the `parameters` that `train` of Brax's SAC or PPO returns: (statistics, policy, ...).

    `normalize_observations` as given to `train`; `masked` as of `from_layers`. With `make_policy`, which `train`
    returns too, the file's actions are compared with its own: Brax's PPO has swish layers unless its `network_factory`
    says `activation=jax.nn.relu`. Raises InputError if they differ.
    """
    statistics, policy = parameters[0], parameters[1]
    mean, deviation = None, None
    if normalize_observations:
        mean, deviation = statistics.mean, statistics.std

    def act(observations: np.ndarray) -> np.ndarray:
        assert make_policy is not None
        return np.asarray(make_policy(parameters, deterministic=True)(observations, None)[0])

    origin = {"trainer": "brax"}
    return from_layers(policy, config, mean, deviation, act if make_policy else None, steps, origin, masked)


def from_layers(
    layers: Layers | Mapping[str, Any],
    config: Config,
    mean: Any = None,
    deviation: Any = None,
    act: Callable[[np.ndarray], np.ndarray] | None = None,
    steps: int = 0,
    origin: Mapping[str, Any] | None = None,
    masked: bool = False,
) -> PolicyFile:
    """A policy file for `config` from the `layers` of a network with ReLU between them and tanh behind them.

    `layers`: (kernel (inputs, outputs), bias (outputs,)) of each, or Flax's parameters, or a state dict of PyTorch
    with kernels (outputs, inputs). The last one has 3 outputs (roll, pitch, vertical), or 6, the means before the
    deviations. `mean`, `deviation` (n,) normalise the observations, which otherwise are not normalised. `masked`: the
    trainer saw zeros in what `follower.ignore_position` hides; otherwise the file's network sees positions. `act` maps
    observations (N, n) to actions (N, 3) in [-1, 1] by the trained policy: InputError if the file's differ.
    """
    from mjxball.sim.follower import network_interface

    own = replace(config, "follower.recurrent_units", 0)  # the trainer has its own network
    own = replace(own, "follower.ignore_position", own.follower.ignore_position and masked)
    interface = network_interface(own)
    size = interface.input_size
    given = _layers_in(layers) if isinstance(layers, Mapping) else layers
    found = [(_array(kernel), _array(bias)) for kernel, bias in given]
    _check_shapes(found, size)
    kernel, bias = found[-1]
    if bias.size == ACTION_SIZE:
        found[-1] = np.hstack([kernel, np.zeros_like(kernel)]), np.append(bias, np.zeros_like(bias))
    named = {f"hidden_{k}": {"kernel": kernel, "bias": bias} for k, (kernel, bias) in enumerate(found)}
    mean = np.zeros(size) if mean is None else np.asarray(mean, np.float64)
    deviation = np.ones(size) if deviation is None else np.asarray(deviation, np.float64)
    for name, value in (("mean", mean), ("deviation", deviation)):
        if value.shape != (size,):
            raise InputError(f"{name} has the shape {value.shape}, and the observation here ({size},)")
    if not (deviation > 0).all():
        raise InputError("deviation must be positive")
    policy = policy_file(own, interface, _Learnt(named, mean, deviation), int(steps), dict(origin or {}))
    check(policy, "this network")
    if act is not None:
        _compare(policy, act, np.array(action_mask(config.follower.load_axis_only, config.plant.cg_axis)))
    return policy


def _sb3_layers(model: Any) -> list[tuple[Any, Any]]:
    """The policy of a model of Stable-Baselines3 or SBX."""
    policy = model.policy
    if hasattr(policy, "actor_state"):  # SBX: the last two layers give mean and deviation
        dense = _layers_in(policy.actor_state.params)
        return [*dense[:-2], _beside(dense[-2], dense[-1])]
    try:
        if hasattr(policy, "actor"):
            hidden, last = policy.actor.latent_pi, policy.actor.mu
        else:
            hidden, last = policy.mlp_extractor.policy_net, policy.action_net
        return _layers_in({"hidden": hidden.state_dict(), "last": last.state_dict()})
    except AttributeError:
        name = type(policy).__name__
        raise InputError(f"{name} is not known here: pass the layers of its network to from_layers") from None


def _beside(first: tuple[Any, Any], second: tuple[Any, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Two layers of the same inputs as one."""
    kernel, bias = (np.concatenate([_array(a), _array(b)], axis=-1) for a, b in zip(first, second, strict=True))
    return kernel, bias


def _layers_in(tree: Mapping[str, Any]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernels (inputs, outputs) and biases in Flax's parameters, by the numbers in their names, or in a state dict."""
    leaves = dict(_leaves(tree, ()))
    found = []
    places = list(dict.fromkeys(path[:-1] for path in leaves))
    numbers = {path: [int(one) for name in path for one in re.findall(r"\d+", name)] for path in places}
    if any(path[-1] == "kernel" for path in leaves) and all(numbers.values()):  # Flax may sort names as text
        places.sort(key=lambda path: numbers[path])
    for place in places:
        names = {path[-1] for path in leaves if path[:-1] == place}
        if names not in ({"kernel", "bias"}, {"weight", "bias"}):
            raise InputError(f"{'.'.join(place) or 'the network'} has {', '.join(sorted(names))}: not a dense layer")
        kernel = leaves[*place, "kernel"] if "kernel" in names else leaves[*place, "weight"].T
        found.append((kernel, leaves[*place, "bias"]))
    return found


def _leaves(tree: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    """(path, array) of everything in nested mappings; dots in a name part it."""
    if isinstance(tree, Mapping):
        for name, value in tree.items():
            yield from _leaves(value, (*path, *str(name).split(".")))
    else:
        yield path, _array(tree)


def _array(value: Any) -> np.ndarray:
    """An array of NumPy, JAX or PyTorch as float32."""
    found = np.asarray(value.detach().cpu().numpy() if hasattr(value, "detach") else value)
    if found.dtype.kind not in "fiu":
        raise InputError(f"a layer has numbers of the type {found.dtype}")
    return found.astype(np.float32)


def _check_shapes(layers: Sequence[tuple[np.ndarray, np.ndarray]], size: int) -> None:
    if not layers:
        raise InputError("there are no layers")
    width = size
    for number, (kernel, bias) in enumerate(layers):
        wanted = f"layer {number} has the kernel {kernel.shape} and the bias {bias.shape}"
        if kernel.ndim != 2 or bias.shape != kernel.shape[1:]:
            raise InputError(f"{wanted}; (inputs, outputs) and (outputs,) fit")
        if len(kernel) != width:
            before = "the observation has" if number == 0 else "the layer before has"
            raise InputError(f"{wanted}, and {before} {width} numbers")
        width = bias.size
    if width not in (ACTION_SIZE, 2 * ACTION_SIZE):
        raise InputError(f"the last layer has {width} outputs; an action has 3, with deviations 6")


def _compare(policy: PolicyFile, act: Callable[[np.ndarray], np.ndarray], mask: np.ndarray) -> None:
    """Raise InputError if the file's actions differ from those of `act`, times `mask` (3,)."""
    scale = policy.observation_scale
    deviation = 1 / np.where(scale > 0, scale, 1.0)
    noise = np.random.default_rng(0).standard_normal((SAMPLES, len(scale)))
    seen = ((policy.observation_mean + SPREAD * deviation * noise) * (scale > 0)).astype(np.float32)
    answers = np.asarray(act(seen))
    if answers.shape != (SAMPLES, ACTION_SIZE):
        raise InputError(f"the trained policy answers {answers.shape} to {SAMPLES} observations; an action has 3")
    weights = [*policy.weights[:-1], policy.weights[-1][:, :ACTION_SIZE]]
    biases = [*policy.biases[:-1], policy.biases[-1][:ACTION_SIZE]]
    network = Network(weights, biases, policy.observation_mean, scale)
    apart = float(np.abs(answers * mask - network(seen)).max())
    if not apart < ROUNDING:
        raise InputError(
            f"the policy file's actions differ from the trained policy's by up to {apart:.2g}: a policy file has ReLU "
            "between its layers, tanh behind them, and no other processing of observations"
        )
