"""The core of the environments: worlds that begin, step and end. The other files add what each interface asks for."""

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
from jax._src import xla_bridge  # whether a device has been made: nothing public says it

from mjxball import config as configs
from mjxball.arrays import Array, real_numbers
from mjxball.config import Config
from mjxball.control.observation import ACTION_SIZE
from mjxball.env import PipelineState, TransportEnv
from mjxball.errors import InputError
from mjxball.physics.engine import PlantState
from mjxball.physics.step import make_cg_offset, make_stepper, on_the_host
from mjxball.plant.teams import ring
from mjxball.xla import enable_compilation_cache

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}
PICTURE = (360, 480)  # height, width of a rendered frame
THREADS = Path("/proc/self/task")
_home: dict[str, int] = {}  # number of the process in which JAX runs for the environments


def in_float32(method: Callable[..., Any]) -> Callable[..., Any]:
    """`method` with arrays of 32 bits, also where JAX_ENABLE_X64 is set: a seed draws the same worlds then."""

    @functools.wraps(method)
    def call(*arguments: Any, **named: Any) -> Any:
        if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
            return method(*arguments, **named)
        with jax.enable_x64(False):
            return method(*arguments, **named)

    return call


def check_process() -> None:
    """Raise InputError in a process that was forked from one in which JAX has run: it would hang there.

    Its threads are not in the copy: where JAX has a device and the process a single thread, it is a copy.
    """
    process = os.getpid()
    if _home.get("process") == process:
        return
    copied = xla_bridge.backends_are_initialized() and THREADS.is_dir() and len(list(THREADS.iterdir())) == 1
    if copied or _home.setdefault("process", process) != process:
        raise InputError(
            "this process was forked from one in which JAX runs, where it would wait for ever; start it with spawn, "
            "such as gymnasium.make_vec(..., vectorization_mode='async', vector_kwargs={'context': 'spawn'})"
        )


class Program(NamedTuple):
    """Functions of one world or of N at once, each compiled at its first call."""

    env: TransportEnv
    chain: Any  # seed, as of `seed_number` -> chain of keys
    start: Any  # chain -> (chain, State)
    step: Any  # (State, action) -> State
    commands: Any  # (State, action (3,)) -> (commands (2, 3), Load)
    arrive: Any  # (State, action (3,), PlantState that another engine came to) -> State
    next_step: Any  # (chain, State, action) -> (chain, State): an ended world starts anew instead of stepping
    same_step: Any  # likewise -> (chain, State as stepped, State: of an ended world that of its next episode)


@functools.lru_cache(maxsize=16)
def program(config: Config, physics: str, many: bool = False) -> Program:
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
    return Program(env, *(jax.jit(jax.vmap(part) if many else part) for part in parts))


def _where(ended: Array, fresh: Any, going: Any) -> Any:
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, going)


class World:
    """One world, its state, and the chain of keys that its episodes are drawn from: in float32 on the CPU.

    It is pickled with its state, and compiled again where it arrives. `render_mode` is None or rgb_array.
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
        """All but what `_compile` makes."""
        return {name: value for name, value in vars(self).items() if name not in ("program", "_scene", "_move")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """See `__getstate__`."""
        vars(self).update(state)
        self._compile()

    @in_float32
    def reset(self, seed: int | Sequence[int] | None) -> None:
        """The next episode of the chain, or the first one of the chain of `seed`, as of `seed_number`."""
        check_process()
        with self._place():
            if seed is not None:
                self._chain = self.program.chain(np.asarray(seed, np.uint32))
            self._chain, self.state = self.program.start(self._chain)
        if self._render_mode is not None:
            world = self.state.pipeline_state
            self._look_at = (np.asarray(world.goal, float) + np.asarray(world.plant.position)) / 2
        if self._config.scenario.team_sizes:  # a picture shows as many drones as there are
            self.close()

    @in_float32
    def step(self, action: Array) -> Any:
        """The `State` after `action` has been held for one control period."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        check_process()
        with self._place():
            return self._step(action)

    def _step(self, action: Array) -> Any:
        self.state = self.program.step(self.state, action)
        return self.state

    def seen(self, state: Any = None) -> np.ndarray:
        """What the followers see (..., n) in `state`, by default now."""
        return np.array(np.asarray((state or self.state).obs)[..., : self.program.env.policy_input_size])

    def picture(self) -> np.ndarray | None:
        """The team and its goal as pixels (height, width, 3) uint8, or None without a render mode."""
        if self._render_mode is None or self.state is None:
            gymnasium.logger.warn("render needs render_mode='rgb_array' and a reset before it")
            return None
        plant, world = self._config.plant, self.state.pipeline_state
        goal = np.asarray(world.goal, float)
        if self._scene is None:
            from mjxball.scene import Scene

            size = int(present(world.rig, plant.followers).sum()) + 1
            drawn = ring(plant, size) if self._config.scenario.team_sizes else plant
            self._scene = Scene(drawn, goal, PICTURE, self._look_at)
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
        super().__init__(config, "newton-euler", render_mode)  # whose own physics is never called

    def _compile(self) -> None:
        super()._compile()
        self._move = make_stepper(self._config, self._engine)

    def reset(self, seed: int | Sequence[int] | None) -> None:
        """See `World.reset`."""
        super().reset(seed)
        self._plant = _batch_of_one(self.state.pipeline_state.plant)  # of `state`, in float64

    def _step(self, action: Array) -> Any:
        commands, load = self.program.commands(self.state, action)
        plant = self._move(self._plant, np.asarray(commands, float)[None], _batch_of_one(load))
        arrived = plant.each(lambda leaf: leaf[0].astype(np.float32))
        self.state = self.program.arrive(self.state, action, arrived)
        if not self.state.metrics["diverged"]:
            self._plant = plant
        return self.state


class Worlds(World):
    """N worlds on JAX's default device, which start anew after an end: by the next step, or by the `same_step`."""

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
    """Position, quaternion and CG offset, as `mjxball.scene.Scene.picture` takes them."""
    offset = make_cg_offset(config)(_batch_of_one(world.plant), _batch_of_one(world.load))
    return world.plant.position, world.plant.quaternion, offset[0]


def _batch_of_one(leaves: Any) -> Any:
    """The named tuple `leaves` in float64 with a batch axis; what is absent stays absent."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], leaves)


def settings(preset: str, config: Config | None) -> Config:
    """`config`, validated, or else the preset called `preset`; without a GRU: a trainer brings its own network."""
    found = configs.preset(preset) if config is None else configs.validate(config)
    return configs.replace(found, "follower.recurrent_units", 0)


def pair_settings(preset: str, config: Config | None) -> Config:
    """`settings`; InputError for a team, whose followers are several agents."""
    found = settings(preset, config)
    if found.plant.count > 2:
        followers = found.plant.count - 1
        raise InputError(
            f"this environment has one agent, and the plant {followers} followers; use mjxball.gym.parallel"
        )
    return found


def agents(config: Config) -> list[str]:
    """Names of a team's followers, in the order of the plant's drones without the leader."""
    return [f"follower_{number + 1}" for number in range(len(config.plant.followers))]


def present(rig: Any, drones: Sequence[int]) -> Array:
    """Whether each of `drones` (F) is of a world of `rig`: those that pad smaller teams have no mass."""
    return np.ones(len(drones), bool) if rig == () else rig.drone_mass[np.array(drones)] > 0


def spaces(env: TransportEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Spaces of observation (n,) and action (3,): what the follower sees and remembers, and [-1, 1]."""
    observations = gymnasium.spaces.Box(-np.inf, np.inf, (env.policy_input_size,), np.float32)
    return observations, gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)


def checked_action(action: Array, shape: tuple[int, ...] | None) -> np.ndarray:
    """`action` as float32, which the environment clips to the box [-1, 1].

    Raises InputError unless it is finite and of `shape`, and of real numbers.
    """
    given = real_numbers(action, f"an action of shape {shape}")
    if given.shape != shape:
        found = f"of shape {given.shape}"
    elif not np.isfinite(given).all():
        found = f"of shape {given.shape} with {given[~np.isfinite(given)][0]} in it"
    else:
        return np.clip(given, -1.0, 1.0).astype(np.float32)  # float32 would make infinity of 1e39
    raise InputError(f"an action must be finite numbers of shape {shape}, not {found}")


def seed_number(random: np.random.Generator) -> int:
    """The number that one world's keys come from, drawn from Gymnasium's generator."""
    return int(random.integers(2**32))


def ends_of(state: Any) -> tuple[np.ndarray, np.ndarray]:
    """(terminated, truncated): the object left d_term or the world diverged; the episode's time is over."""
    truncated = np.asarray(state.info["truncation"]) > 0
    return (np.asarray(state.done) > 0) & ~truncated, truncated


def info_of(state: Any) -> dict[str, Array]:
    """What `info` holds of a state: |e_o| [m], the squared command errors, and whether the world has diverged."""
    return {name: state.metrics[name] for name in ("error", "tilt_error", "vertical_error", "diverged")}
