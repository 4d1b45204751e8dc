"""One world as a `gymnasium.Env`, on C MuJoCo where that knows what the worlds are made of."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.gym import common
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import make_cg_offset, make_stepper, on_the_host
from mjxball.xla import enable_compilation_cache

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}
PICTURE = (360, 480)  # height, width of a rendered frame


class Laws(NamedTuple):
    """The compiled parts of `mjxball.env` around the physics."""

    pair: TransportEnv
    start: Any  # chain -> (chain, State)
    commands: Any  # (State, action (3,)) -> (commands (2, 3), Load)
    arrive: Any  # (State, action (3,), PlantState that the physics came to) -> State


@functools.lru_cache(maxsize=8)
def compiled_laws(config: Config) -> Laws:
    """The laws of `config`, compiled once for all environments of a process."""
    common.check_process()
    enable_compilation_cache()
    pair = TransportEnv(config, "newton-euler")  # its own physics is never called

    def start(chain: Array) -> tuple[Array, Any]:
        chain, key = jax.random.split(chain)
        return chain, pair.reset(key)

    def arrive(state: Any, action: Array, plant: PlantState) -> Any:
        return pair.step(state, action, lambda *_: plant)

    return Laws(pair, jax.jit(start), jax.jit(pair.commands), jax.jit(arrive))


def engine_of(config: Config, physics: str | None) -> str:
    """`physics`; by default C MuJoCo, or the closed form where worlds differ by inertia without mass.

    Such inertia is what C MuJoCo lacks: raises InputError if it is asked for there.
    """
    massless = config.scenario.inertia_scale != (1.0, 1.0)
    if massless and physics == "mujoco":
        raise InputError("C MuJoCo has no inertia without mass, which scenario.inertia_scale draws; use newton-euler")
    return physics or ("newton-euler" if massless else "mujoco")


class FollowerEnv(common.Picklable, gymnasium.Env[np.ndarray, np.ndarray]):
    """The follower's task: observation (n,) float32, action (3,) in [-1, 1], both as in `mjxball.env`.

    `physics` is mujoco, newton-euler or mjx, in float64 (default: `engine_of`); `config` replaces the preset's.
    `terminated` means that the object left d_term or that the world diverged, `truncated` that the episode's time
    is over: bootstrap there.
    """

    metadata = METADATA
    _compiled = ("_laws", "_move", "_cg_offset", "_scene")

    def __init__(
        self,
        preset: str = "transport",
        config: Config | None = None,
        physics: str | None = None,
        render_mode: str | None = None,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or rgb_array, not {render_mode!r}")
        self.config = common.pair_settings(preset, config)
        self.render_mode, self._physics = render_mode, physics
        self.metadata = {**METADATA, "render_fps": round(1 / self.config.timing.control_period)}
        with on_the_host():
            self._laws = compiled_laws(self.config)
        self._move = make_stepper(self.config, engine_of(self.config, physics))
        self._cg_offset = make_cg_offset(self.config)
        self.observation_space, self.action_space = common.spaces(self._laws.pair)
        self._chain: Any = None
        self._state: Any = None
        self._load: Load | None = None
        self._plant: PlantState | None = None  # of `_state`, in float64 and with a batch axis (1, ...)
        self._scene: Any = None

    def _arguments(self) -> dict[str, Any]:
        return {"config": self.config, "physics": self._physics, "render_mode": self.render_mode}

    @common.in_float32
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A fresh world drawn from `config.scenario`; `options` are not used."""
        common.check_process()
        super().reset(seed=seed)
        with on_the_host():
            if seed is not None or self._chain is None:
                self._chain = jax.random.key(common.seed_number(self.np_random))
            self._chain, self._state = self._laws.start(self._chain)
        self._plant = _batch_of_one(self._state.pipeline_state.plant)
        self._load = self._state.pipeline_state.load
        if self._scene is not None:
            self._scene.move_goal(*self._view())
        return self._seen(), {}

    @common.in_float32
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold `action` (3,), clipped to [-1, 1], for one control period; InputError unless it is finite."""
        if self._state is None or self._plant is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        common.check_process()
        action = common.checked_action(action, self.action_space.shape)
        with on_the_host():
            commands, load = self._laws.commands(self._state, action)
        self._load = load
        plant = self._move(self._plant, np.asarray(commands, float)[None], _batch_of_one(load))
        with on_the_host():
            arrived = plant.each(lambda leaf: leaf[0].astype(np.float32))
            self._state = self._laws.arrive(self._state, action, arrived)
        if not self._state.metrics["diverged"]:
            self._plant = plant
        truncated = bool(self._state.info["truncation"])
        terminated = bool(self._state.done) and not truncated
        info = {name: float(value) for name, value in common.info_of(self._state).items()}
        return self._seen(), float(self._state.reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The pair and its goal as pixels (height, width, 3) uint8, or None without a render mode."""
        if self.render_mode is None or self._plant is None:
            gymnasium.logger.warn("render needs render_mode='rgb_array' and a reset before it")
            return None
        if self._scene is None:
            from mjxball.scene import Scene

            goal, look_at = self._view()
            self._scene = Scene(self.config.plant, goal, PICTURE, look_at)
        plant = self._plant
        offset = self._cg_offset(plant, _batch_of_one(self._load))
        return self._scene.picture(plant.position[0], plant.quaternion[0], float(offset[0]))

    def close(self) -> None:
        """Free the renderer."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _seen(self) -> np.ndarray:
        return np.array(self._state.obs[: self._laws.pair.policy_input_size])

    def _view(self) -> tuple[np.ndarray, np.ndarray]:
        """Goal (3,), and what the camera looks at (3,): half way to it."""
        goal = np.asarray(self._state.pipeline_state.goal, float)
        return goal, (goal + self._state.pipeline_state.plant.position) / 2


def _batch_of_one(leaves: Any) -> Any:
    """The named tuple `leaves` in float64 with a batch axis; what is absent stays absent."""
    return type(leaves)(*(None if leaf is None else np.asarray(leaf, float)[None] for leaf in leaves))
