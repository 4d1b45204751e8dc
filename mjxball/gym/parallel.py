"""The followers of a team as PettingZoo's `ParallelEnv`: agents follower_1, ..., follower_F."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from gymnasium.utils.seeding import np_random

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.env import TransportEnv
from mjxball.gym import common
from mjxball.gym.single import PICTURE
from mjxball.physics.step import make_cg_offset, on_the_host
from mjxball.plant.teams import ring
from mjxball.xla import enable_compilation_cache

try:
    import pettingzoo
except ModuleNotFoundError:
    raise ModuleNotFoundError("pettingzoo is not installed; pip install 'mjxball[gym]'", name="pettingzoo") from None

METADATA: dict[str, Any] = {"name": "mjxball_followers_v0", "render_modes": ["rgb_array"], "render_fps": 50}


class Program(NamedTuple):
    """The compiled functions of one world."""

    env: TransportEnv
    start: Any  # chain -> (chain, State)
    step: Any  # (State, actions (F, 3), of a pair (3,)) -> State


@functools.lru_cache(maxsize=8)
def compiled_program(config: Config, physics: str) -> Program:
    """The program of `config` on `physics`, compiled once for all environments of a process."""
    common.check_process()
    enable_compilation_cache()
    env = TransportEnv(config, physics)

    def start(chain: Array) -> tuple[Array, Any]:
        chain, key = jax.random.split(chain)
        return chain, env.reset(key)

    return Program(env, jax.jit(start), jax.jit(env.step))


class FollowersParallelEnv(common.Picklable, pettingzoo.ParallelEnv[str, np.ndarray, np.ndarray]):
    """One world of `mjxball.env` in float32: each follower sees (n,) float32 and acts (3,) in [-1, 1] in its own frame.

    All share the goal and end together: `terminated` means that the object left d_term or that the world diverged,
    `truncated` that the episode's time is over. Where worlds have teams of several sizes (`scenario.team_sizes`), a
    reset's `agents` are the first of `possible_agents`, as many as there are followers. `physics` is newton-euler or
    mjx; `config` replaces the preset's.
    """

    metadata = METADATA
    _compiled = ("_program", "_cg_offset", "_scene")

    def __init__(
        self,
        preset: str = "team",
        config: Config | None = None,
        physics: str = "newton-euler",
        render_mode: str | None = None,
    ):
        if render_mode not in (None, *METADATA["render_modes"]):
            raise ValueError(f"render_mode must be None or rgb_array, not {render_mode!r}")
        self.config = common.settings(preset, config)
        self.render_mode, self._physics = render_mode, physics
        self.metadata = {**METADATA, "render_fps": round(1 / self.config.timing.control_period)}
        self._drones = np.array(self.config.plant.followers)
        with on_the_host():
            self._program = compiled_program(self.config, physics)
        self.possible_agents = [f"follower_{number + 1}" for number in range(len(self._drones))]
        self.agents: list[str] = []
        spaces = {agent: common.spaces(self._program.env) for agent in self.possible_agents}
        self.observation_spaces = {agent: seen for agent, (seen, _) in spaces.items()}
        self.action_spaces = {agent: acts for agent, (_, acts) in spaces.items()}
        self._cg_offset = make_cg_offset(self.config)
        self._chain: Any = None
        self._state: Any = None
        self._scene: Any = None

    def _arguments(self) -> dict[str, Any]:
        return {"config": self.config, "physics": self._physics, "render_mode": self.render_mode}

    def observation_space(self, agent: str) -> gymnasium.spaces.Space:
        """(n,) float32, the same for all."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.spaces.Space:
        """(3,) in [-1, 1], the same for all."""
        return self.action_spaces[agent]

    @common.in_float32
    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """A fresh world drawn from `config.scenario`; seeds as of `FollowerEnv`, `options` are not used."""
        common.check_process()
        with on_the_host():
            if seed is not None or self._chain is None:
                self._chain = jax.random.key(common.seed_number(np_random(seed)[0]))
            self._chain, self._state = self._program.start(self._chain)
        self.agents = self.possible_agents[: self._count]
        if self._scene is not None:
            self._scene.close()
            self._scene = None
        return self._seen(), {agent: {} for agent in self.agents}

    @common.in_float32
    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Hold every agent's action (3,), clipped to [-1, 1], for one control period; InputError unless finite."""
        if not self.agents:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if set(actions) != set(self.agents):
            raise ValueError(f"actions must be for {', '.join(self.agents)}, not for {', '.join(actions) or 'nobody'}")
        common.check_process()
        given = np.zeros((len(self._drones), 3), np.float32)
        for number, agent in enumerate(self.agents):
            given[number] = common.checked_action(actions[agent], self.action_spaces[agent].shape)
        with on_the_host():
            self._state = self._program.step(self._state, given if self._several else given[0])
        state, agents = self._state, self.agents
        truncated = bool(state.info["truncation"])
        terminated = bool(state.done) and not truncated
        info = {name: float(value) for name, value in common.info_of(state).items()}
        rewards = np.reshape(np.asarray(state.reward), -1)
        seen = self._seen()
        if terminated or truncated:
            self.agents = []
        return (
            seen,
            {agent: float(rewards[number]) for number, agent in enumerate(agents)},
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: dict(info) for agent in agents},
        )

    def render(self) -> np.ndarray | None:
        """The team and its goal as pixels (height, width, 3) uint8, or None without a render mode."""
        if self.render_mode is None or self._state is None:
            gymnasium.logger.warn("render needs render_mode='rgb_array' and a reset before it")
            return None
        world = self._state.pipeline_state
        if self._scene is None:
            from mjxball.scene import Scene

            plant, goal = self.config.plant, np.asarray(world.goal, float)
            drawn = ring(plant, self._count + 1) if self.config.scenario.team_sizes else plant
            self._scene = Scene(drawn, goal, PICTURE, (goal + np.asarray(world.plant.position)) / 2)
        offset = self._cg_offset(world.plant, world.load)
        return self._scene.picture(world.plant.position, world.plant.quaternion, np.asarray(offset))

    def close(self) -> None:
        """Free the renderer."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    @property
    def _several(self) -> bool:
        return len(self._drones) > 1

    @property
    def _count(self) -> int:
        """Followers of this world's team: drones that pad a smaller one have no mass."""
        rig = self._state.pipeline_state.rig
        return len(self._drones) if rig == () else int((np.asarray(rig.drone_mass)[self._drones] > 0).sum())

    def _seen(self) -> dict[str, np.ndarray]:
        size = self._program.env.policy_input_size
        shown = np.reshape(np.asarray(self._state.obs), (len(self._drones), -1))[:, :size]
        return {agent: np.array(shown[number]) for number, agent in enumerate(self.agents)}
