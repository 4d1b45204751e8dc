"""Core of the environments: worlds that reset, step and end. The other files adapt them to each interface."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax._src import xla_bridge  # no public function tells whether a backend is initialised

from mjxball import config as configs
from mjxball.arrays import Array, real_numbers
from mjxball.config import Config
from mjxball.control.observation import ACTION_SIZE
from mjxball.env import PipelineState, TransportEnv
from mjxball.errors import InputError
from mjxball.physics.engine import PlantState
from mjxball.physics.step import make_cg_offset, make_numpy_plant_step, on_the_host
from mjxball.plant.teams import ring
from mjxball.xla import enable_compilation_cache

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}
PICTURE = (360, 480)  # height, width of a rendered frame
THREADS = Path("/proc/self/task")
_home: dict[str, int] = {}  # id of the process in which JAX runs for the environments


def in_float32(method: Callable[..., Any]) -> Callable[..., Any]:
    """`method` with 32-bit arrays even if JAX_ENABLE_X64 is set, so that a seed gives the same worlds."""

    @functools.wraps(method)
    def call(*arguments: Any, **named: Any) -> Any:
        if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
            return method(*arguments, **named)
        with jax.enable_x64(False):
            return method(*arguments, **named)

    return call


def check_process() -> None:
    """Raise InputError in a process that was forked from one in which JAX has run: JAX would hang.

    A fork does not copy threads, so a process with an initialised backend and a single thread is a fork.
    """
    process = os.getpid()
    if _home.get("process") == process:
        return
    forked = xla_bridge.backends_are_initialized() and THREADS.is_dir() and len(list(THREADS.iterdir())) == 1
    if forked or _home.setdefault("process", process) != process:
        raise InputError(
            "this process was forked from one in which JAX runs, where it would wait for ever; start it with spawn, "
            "such as gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})"
        )


class CompiledEnv(NamedTuple):
    """Functions of one world or of N at once, each compiled at its first call. A chain is a key split at each reset."""

    env: TransportEnv
    chain: Any  # seed, as of `seed_number` -> chain
    start: Any  # chain -> (chain, State)
    step: Any  # (State, action) -> State
    commands: Any  # (State, action (3,)) -> (commands (2, 3), Load)
    arrive: Any  # (State, action (3,), PlantState after the step by another engine) -> State
    next_step: Any  # (chain, State, action) -> (chain, State): an ended world is reset instead of stepped
    same_step: Any  # the same -> (chain, State after the step, State after reset of ended worlds)


@functools.lru_cache(maxsize=16)
def program(config: Config, physics: str, many: bool = False) -> CompiledEnv:
    """The program of `config` on `physics`, compiled once for all environments of a process."""
    check_process()
    enable_compilation_cache()
    env = TransportEnv(config, physics)

    def start(chain: Array) -> tuple[Array, Any]:
        chain, key = jax.random.split(chain)
        return chain, env.reset(key)

    def arrive(state: Any, action: Array, plant: PlantState) -> Any:
        return env.step(state, action, lambda *_: plant)

    def next_step(chain: Array, state: Any, action: Array) -> tuple[Array, Any]:
        return _where(state.done > 0, start(chain), (chain, env.step(state, action)))

    def same_step(chain: Array, state: Any, action: Array) -> tuple[Array, Any, Any]:
        moved = env.step(state, action)
        chain, fresh = _where(moved.done > 0, start(chain), (chain, moved))
        return chain, moved, fresh

    parts = jax.random.key, start, env.step, env.commands, arrive, next_step, same_step
    return CompiledEnv(env, *(jax.jit(jax.vmap(part) if many else part) for part in parts))


def _where(ended: Array, fresh: Any, running: Any) -> Any:
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, running)


class World:
    """One world, its state, and the chain of keys from which its episodes are sampled, in float32 on the CPU.

    Pickling keeps the state; functions are compiled again. `render_mode` is None or rgb_array.
    """

    _many, _place = False, staticmethod(on_the_host)

    def __init__(self, config: Config, physics: str, render_mode: str | None = None):
        if render_mode not in (None, *METADATA["render_modes"]):
            raise ValueError(f"render_mode must be None or rgb_array, not {render_mode!r}")
        self._config, self._physics, self._render_mode = config, physics, render_mode
        self.state: Any = None
        self._chain: Any = None
        self._look_at: Any = None
        self._compile()

    def _compile(self) -> None:
        self._scene: Any = None
        with self._place():
            self.program = program(self._config, self._physics, self._many)

    def __getstate__(self) -> dict[str, Any]:
        """All attributes but those that `_compile` sets."""
        return {name: value for name, value in vars(self).items() if name not in ("program", "_scene", "_move")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the attributes and compile."""
        vars(self).update(state)
        self._compile()

    @in_float32
    def reset(self, seed: int | Sequence[int] | None) -> None:
        """Start the next episode of the chain, or the first one of a new chain from `seed` (`seed_number`)."""
        check_process()
        with self._place():
            if seed is not None:
                self._chain = self.program.chain(np.asarray(seed, np.uint32))
            self._chain, self.state = self.program.start(self._chain)
        if self._render_mode is not None:
            world = self.state.pipeline_state
            self._look_at = (np.asarray(world.goal, float) + np.asarray(world.plant.position)) / 2
        if self._config.scenario.team_sizes:  # the scene depends on the number of drones
            self.close()

    @in_float32
    def step(self, action: Array) -> Any:
        """The `State` after holding `action` for one control period."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_process()
        with self._place():
            return self._step(action)

    def _step(self, action: Array) -> Any:
        self.state = self.program.step(self.state, action)
        return self.state

    def seen(self, state: Any = None) -> np.ndarray:
        """The policy's observation (..., n) in `state`, by default the current one."""
        return np.array(np.asarray((state or self.state).obs)[..., : self.program.env.policy_input_size])

    def picture(self) -> np.ndarray | None:
        """Image (height, width, 3) uint8 of the team and its goal, or None without a render mode."""
        if self._render_mode is None or self.state is None:
            gymnasium.logger.warn("render needs render_mode='rgb_array' and a reset before it")
            return None
        plant, world = self._config.plant, self.state.pipeline_state
        goal = np.asarray(world.goal, float)
        if self._scene is None:
            from mjxball.scene import Scene

            size = int(present(world.parameters, plant.followers).sum()) + 1
            team = ring(plant, size) if self._config.scenario.team_sizes else plant
            self._scene = Scene(team, goal, PICTURE, self._look_at)
        self._scene.move_goal(goal, self._look_at)
        return self._scene.picture(*pose_of(self._config, world))

    def close(self) -> None:
        """Free the renderer."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None


class HostWorld(World):
    """One world whose physics is C MuJoCo, the closed form or MJX, in float64."""

    def __init__(self, config: Config, engine: str, render_mode: str | None = None):
        self._engine = engine
        super().__init__(config, "newton-euler", render_mode)  # this engine is never called

    def _compile(self) -> None:
        super()._compile()
        self._move = make_numpy_plant_step(self._config, self._engine)

    def reset(self, seed: int | Sequence[int] | None) -> None:
        """See `World.reset`."""
        super().reset(seed)
        self._plant = _batch_of_one(self.state.pipeline_state.plant)  # of `state`, in float64

    def _step(self, action: Array) -> Any:
        commands, load = self.program.commands(self.state, action)
        plant = self._move(self._plant, np.asarray(commands, float)[None], _batch_of_one(load))
        after = plant.each(lambda leaf: leaf[0].astype(np.float32))
        self.state = self.program.arrive(self.state, action, after)
        if not self.state.metrics["diverged"]:
            self._plant = plant
        return self.state


class Worlds(World):
    """N worlds on JAX's default device. An ended world is reset by the next step, or within the `same_step`."""

    _many, _place = True, staticmethod(contextlib.nullcontext)

    def __init__(self, config: Config, physics: str, same_step: bool):
        self._same_step = same_step
        super().__init__(config, physics)

    def _step(self, action: Array) -> Any:
        if self._same_step:
            self._chain, moved, self.state = self.program.same_step(self._chain, self.state, action)
            return moved
        self._chain, self.state = self.program.next_step(self._chain, self.state, action)
        return self.state


def pose_of(config: Config, world: PipelineState) -> tuple[Array, Array, Array]:
    """(position, quaternion, CG offset), the arguments of `mjxball.scene.Scene.picture`."""
    offset = make_cg_offset(config)(_batch_of_one(world.plant), _batch_of_one(world.load))
    return world.plant.position, world.plant.quaternion, offset[0]


def _batch_of_one(leaves: Any) -> Any:
    """The named tuple `leaves` in float64 with a batch axis; None stays None."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], leaves)


def settings(preset: str, config: Config | None) -> Config:
    """`config`, validated, or else the preset called `preset`, without a GRU: trainers have their own networks."""
    valid = configs.preset(preset) if config is None else configs.validate(config)
    return configs.replace(valid, "follower.recurrent_units", 0)


def pair_settings(preset: str, config: Config | None) -> Config:
    """`settings`. Raises InputError for a team, whose followers are several agents."""
    pair = settings(preset, config)
    if pair.plant.count > 2:
        followers = pair.plant.count - 1
        raise InputError(
            f"this environment has one agent, and the plant {followers} followers; use mjxball.gym.parallel"
        )
    return pair


def agents(config: Config) -> list[str]:
    """Names of a team's followers, in the order of the plant's drones."""
    return [f"follower_{number + 1}" for number in range(len(config.plant.followers))]


def present(rig: Any, drones: Sequence[int]) -> Array:
    """(F,) whether each of `drones` exists in a world of `rig`: the padding of smaller teams has no mass."""
    return np.ones(len(drones), bool) if rig == () else rig.drone_mass[np.array(drones)] > 0


def spaces(env: TransportEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Spaces of observation (n,), the policy's input, and action (3,) in [-1, 1]."""
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (env.policy_input_size,), np.float32)
    return observations, gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)


def checked_action(action: Array, shape: tuple[int, ...] | None) -> np.ndarray:
    """`action` as float32, clipped to [-1, 1]. Raises InputError unless it is real, finite and of `shape`."""
    given = real_numbers(action, f"an action of shape {shape}")
    if given.shape != shape:
        found = f"of shape {given.shape}"
    elif not np.isfinite(given).all():
        found = f"of shape {given.shape} with {given[~np.isfinite(given)][0]} in it"
    else:
        return np.clip(given, -1.0, 1.0).astype(np.float32)  # float32 would make infinity of 1e39
    raise InputError(f"an action must be finite numbers of shape {shape}, not {found}")


def seed_number(random: np.random.Generator) -> int:
    """A seed for one world's keys, sampled from Gymnasium's generator."""
    return int(random.integers(2**32))


def ends_of(state: Any) -> tuple[np.ndarray, np.ndarray]:
    """(terminated, truncated): the object left d_term or the world diverged; the time limit was reached."""
    truncated = np.asarray(state.info["truncation"]) > 0
    return (np.asarray(state.done) > 0) & ~truncated, truncated


def info_of(state: Any) -> dict[str, Array]:
    """Entries of `info`: |e_o| [m], mean squared command errors, and whether the world has diverged."""
    return {name: state.metrics[name] for name in ("error", "tilt_error", "vertical_error", "diverged")}
