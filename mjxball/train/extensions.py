"""The user's environments, rewards and algorithms: imported by name and checked before training."""

from __future__ import annotations

import functools
import hashlib
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.algorithms import ALGORITHMS
from mjxball.config import Config
from mjxball.env import TransportEnv
from mjxball.errors import FOREIGN, InputError, said
from mjxball.quiet import import_brax_env


class Extensions(NamedTuple):
    """Parts of a run that replace the built-in ones (None): objects, or names such as "package.module:Class"."""

    env: Any = None  # a Brax environment, or a class or function that makes one
    reward: Any = None  # function (state, action, next state) -> reward
    algorithm: Any = None  # class, see `mjxball.algorithms.base.Algorithm`

    def ours(self) -> bool:
        """Whether all of them are part of mjxball."""
        given = [one for one in self if one is not None]
        names = {one if isinstance(one, str) else f"{one.__module__}:{getattr(one, '__name__', '')}" for one in given}
        return names <= {*ALGORITHMS, *ALGORITHMS.values()}


DEFAULTS = Extensions()


def find(name: str, flag: str) -> Any:
    """The object `name`, "package.module:Name" or a built-in algorithm. Searches the current directory too.

    Raises InputError, which names the `flag`, if it cannot be imported.
    """
    ours = ALGORITHMS if flag == "--algorithm" else {}
    module, _, attribute = ours.get(name, name).partition(":")
    if not module or not attribute:
        raise InputError(f"{flag} takes {''.join(f'{one}, ' for one in ours)}package.module:Name, not {name!r}")
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    if flag == "--env":
        import_brax_env()  # quietly, before the user's module imports Brax, which prints that Warp is absent
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{flag} {name}: there is no module {error.name} here or among the installed packages; "
            "install it or run from its directory"
        ) from None
    except FOREIGN as error:
        raise InputError(f"{flag} {name}: importing {module} raised {said(error)}; mend that module") from None
    try:
        named = getattr(found, attribute)
    except AttributeError:
        raise InputError(f"{flag} {name}: {module} has no {attribute}; check the name behind the colon") from None
    except FOREIGN as error:
        raise InputError(f"{flag} {name}: {module}.{attribute} raised {said(error)}; mend that module") from None
    if flag in ARGUMENTS:
        _check_callable(flag, f"{flag} {name}", named)
    return named


def resolve(extensions: Extensions) -> Extensions:
    """`extensions` with names replaced by objects. Raises InputError if one cannot be found."""
    found = {
        field: find(value, f"--{field}") if isinstance(value, str) else value
        for field, value in extensions._asdict().items()
    }
    return Extensions(**found)


def digest(names: Mapping[str, str | None]) -> str | None:
    """Hash of the source files of the named objects, None if there are none."""
    files = sorted(
        {
            inspect.getsourcefile(inspect.getmodule(find(name, f"--{flag}")) or object) or ""
            for flag, name in names.items()
            if name and name not in ALGORITHMS
        }
    )
    if not files:
        return None
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()[:16]


def make_env(extensions: Extensions, config: Config, physics: str) -> Any:
    """The checked environment to train on, with the reward of `extensions`, and with a time limit if it has none."""
    kind = extensions.env
    if kind is None:
        env: Any = TransportEnv(config, physics)
    else:
        env = _instance(kind, config, physics)
        env = _checked_env(env if is_transport_env(env) else TracedOnce(env), name_of(extensions.env), config)
    if extensions.reward is not None:
        env = Rewarded(env, extensions.reward)
    return env


def is_transport_env(env: Any) -> bool:
    """Whether `env` is a `TransportEnv`, whose policies are policy files."""
    return isinstance(getattr(env, "unwrapped", env), TransportEnv)


class TracedOnce:
    """A foreign environment with jitted `reset` and `step`, which may take seconds to trace and are used repeatedly."""

    def __init__(self, env: Any):
        self.env = env

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    @functools.cached_property
    def reset(self) -> Any:
        """The environment's `reset`, jitted."""
        return jax.jit(self.env.reset)

    @functools.cached_property
    def step(self) -> Any:
        """The environment's `step`, jitted."""
        return jax.jit(self.env.step)

    @functools.cached_property
    def observation_size(self) -> Any:
        """Length of an observation. Brax calls `reset` to find it, which is traced here instead of computed."""
        sizes: list[Any] = []
        try:
            jax.eval_shape(lambda: sizes.append(self.env.observation_size))
        except jax.errors.JAXTypeError:  # it depends on values
            return self.env.observation_size
        return self.env.observation_size if isinstance(sizes[0], jax.core.Tracer) else sizes[0]


class Rewarded:
    """An environment with the user's reward."""

    def __init__(self, env: Any, reward: Callable[[Any, Any, Any], Any]):
        self.env, self._reward = env, reward
        _check_reward(env, reward)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    def step(self, state: Any, action: Any) -> Any:
        """The environment's `step` with the reward replaced."""
        after = self.env.step(state, action)
        reward = self._reward(state, action, after)
        return after.replace(reward=jnp.broadcast_to(reward, after.reward.shape))


def name_of(extension: Any) -> str:
    """The object's name, package.module:Name, for error messages."""
    named = extension if inspect.isclass(extension) or inspect.isroutine(extension) else type(extension)
    return f"{named.__module__}:{named.__qualname__}"


def _instance(kind: Any, config: Config, physics: str) -> Any:
    """The environment that `kind`, a class or function, makes; `kind` itself if it is neither."""
    if not inspect.isclass(kind) and not inspect.isroutine(kind):
        return kind
    flag, given = f"--env {name_of(kind)}", {"config": config, "physics": physics}
    try:
        parameters = inspect.signature(kind).parameters.values()
    except (TypeError, ValueError) as error:
        raise InputError(f"{flag} cannot be called: {error}") from None
    fixed = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    lost = [p.name for p in fixed if p.default is p.empty and p.name not in given]
    if lost:
        raise InputError(f"{flag} needs {', '.join(lost)}: give a default; only config and physics are passed, by name")
    try:
        return kind(**{p.name: given[p.name] for p in fixed if p.name in given})
    except InputError:
        raise
    except FOREIGN as error:
        raise InputError(f"{flag} could not be made: {said(error)}; mend its constructor") from None


def _checked_env(env: Any, name: str, config: Config) -> Any:
    """`env`, with a time limit if it has none. Raises InputError if it does not follow Brax's interface."""
    flag = f"--env {name}"
    lost = [part for part in ("reset", "step", "observation_size", "action_size") if not _has(env, part)]
    if lost:
        raise InputError(f"{flag} is no Brax environment: it lacks {', '.join(lost)}; derive it from brax.envs.Env")
    _takes(flag, "reset", env.reset, ("rng",))
    _takes(flag, "step", env.step, ("state", "action"))
    first = _traced(flag, "reset", env.reset, jax.random.PRNGKey(0))
    for part in ("info", "metrics"):
        if not isinstance(getattr(first, part, None), dict):
            raise InputError(f"{flag}: reset must return a brax.envs.State whose {part} is a dictionary, perhaps empty")
    sizes = _read(flag, env, "observation_size"), _read(flag, env, "action_size")
    if not all(isinstance(size, int) and size > 0 for size in sizes):
        raise InputError(f"{flag}: observation_size and action_size must be whole numbers, not {sizes}; flatten them")
    each: tuple[int, ...] = first.reward.shape if is_transport_env(env) else ()  # (F,) with several followers
    timed = env
    if "truncation" not in first.info:
        import_brax_env()
        from brax.envs.wrappers.training import EpisodeWrapper

        timed = EpisodeWrapper(env, config.timing.episode_steps, 1)
        first = jax.eval_shape(timed.reset, jax.random.PRNGKey(0))  # the state that training steps: one trace for both
    after = _traced(flag, "step", env.step, first, jax.ShapeDtypeStruct((*each, sizes[1]), "float32"))
    for part, state in (("reset", first), ("step", after)):
        for field, expected in (("obs", (*each, sizes[0])), ("reward", each), ("done", ())):
            shape = getattr(getattr(state, field, None), "shape", None)
            if shape != expected:
                raise InputError(f"{flag}: {part} must return {field} of shape {expected}, not {shape}")
    if jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), first) != jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), after
    ):
        raise InputError(f"{flag}: step must return a state of the same fields, shapes and types as reset")
    for mask in ("input_mask", "critic_mask"):
        given = _read(flag, env, mask) if _has(env, mask) else None
        if given is not None and np.shape(given) != (sizes[0],):
            raise InputError(f"{flag}: {mask} must hold observation_size = {sizes[0]} numbers")
    return timed


def _has(env: Any, part: str) -> bool:
    """Whether `env` has the attribute `part`, even if reading it raises an error other than AttributeError."""
    try:
        getattr(env, part)
    except AttributeError:
        return False
    except FOREIGN:
        return True
    return True


def _read(flag: str, env: Any, part: str) -> Any:
    try:
        return getattr(env, part)
    except FOREIGN as error:
        raise InputError(f"{flag}: {part} raised {said(error)}; mend it") from None


def _takes(flag: str, what: str, function: Callable[..., Any], names: tuple[str, ...]) -> None:
    try:
        inspect.signature(function).bind(*names)
    except (TypeError, ValueError):
        raise InputError(f"{flag}: {what} must take ({', '.join(names)})") from None


def _check_reward(env: Any, reward: Any) -> None:
    flag = f"--reward {name_of(reward)}"
    _check_callable("--reward", flag, reward)
    try:
        inspect.signature(reward).bind(None, None, None)
    except (TypeError, ValueError):
        raise InputError(f"{flag} must take (state, action, next state)") from None
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    action = jax.ShapeDtypeStruct((*state.obs.shape[:-1], env.action_size), "float32")
    value = _traced(flag, "the function", lambda s, a: reward(s, a, env.step(s, a)), state, action)
    shape, kind = getattr(value, "shape", None), str(getattr(value, "dtype", type(value).__name__))
    if shape not in ((), state.reward.shape) or not kind.startswith("float"):
        each = f" or one for each follower, shape {state.reward.shape}" if state.reward.shape else ""
        raise InputError(f"{flag} must return one number{each}, not shape {shape} of {kind}; sum it and use floats")


ARGUMENTS = {"--reward": "state, action, next state", "--tracker": "name, settings"}  # of the user's functions


def _check_callable(flag: str, what: str, function: Any) -> None:
    if not callable(function):
        raise InputError(f"{what} is no function of ({ARGUMENTS[flag]})")


def _traced(flag: str, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """`jax.eval_shape`; InputError if the user's `function` raises."""
    try:
        return jax.eval_shape(function, *arguments)
    except FOREIGN as error:
        mend = (
            "use JAX operations, such as `jnp.where` for `if`"
            if isinstance(error, jax.errors.JAXTypeError)
            else "mend it"
        )
        raise InputError(f"{flag}: {what} raised {said(error)}; {mend}") from None
