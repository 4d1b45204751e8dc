"""The followers of a team as PettingZoo's `ParallelEnv`: agents follower_1, ..., follower_F."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.utils.seeding import np_random

from mjxball.config import Config
from mjxball.gym import core

try:
    import pettingzoo
except ModuleNotFoundError:
    raise ModuleNotFoundError("pettingzoo is not installed; pip install 'mjxball[gym]'", name="pettingzoo") from None

METADATA: dict[str, Any] = {**core.METADATA, "name": "mjxball_followers_v0"}


class FollowersParallelEnv(pettingzoo.ParallelEnv[str, np.ndarray, np.ndarray]):
    """One world of `mjxball.env`. Each follower observes (n,) float32 and acts (3,) in [-1, 1], in its own frame.

    All share the goal and end together: `terminated` means that the object left d_term or that the world diverged,
    `truncated` that the time limit was reached. If teams have several sizes (`scenario.team_sizes`), `agents` after a
    reset are the first of `possible_agents`, as many as there are followers. `physics` is newton-euler or mjx, in
    float32; `config` replaces the preset's.
    """

    metadata = METADATA

    def __init__(
        self,
        preset: str = "team",
        config: Config | None = None,
        physics: str = "newton-euler",
        render_mode: str | None = None,
    ):
        self.config = core.settings(preset, config)
        self.render_mode = render_mode
        self.metadata = {**METADATA, "render_fps": round(1 / self.config.timing.control_period)}
        self._world = core.World(self.config, physics, render_mode)
        self.possible_agents = core.agents(self.config)
        self.agents: list[str] = []
        spaces = {agent: core.spaces(self._world.program.env) for agent in self.possible_agents}
        self.observation_spaces = {agent: observation for agent, (observation, _) in spaces.items()}
        self.action_spaces = {agent: action for agent, (_, action) in spaces.items()}

    def observation_space(self, agent: str) -> gymnasium.spaces.Space:
        """(n,) float32, the same for all."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.spaces.Space:
        """(3,) in [-1, 1], the same for all."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """A world sampled from `config.scenario`; seeds as in `FollowerEnv`, `options` are not used."""
        reseed = seed is not None or self._world.state is None
        self._world.reset(core.seed_number(np_random(seed)[0]) if reseed else None)
        rig = jax.tree.map(np.asarray, self._world.state.pipeline_state.parameters)
        self.agents = self.possible_agents[: core.present(rig, self.config.plant.followers).sum()]
        return self._observations(), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Hold every agent's action (3,), clipped to [-1, 1], for one control period; InputError unless finite."""
        if not self.agents:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if set(actions) != set(self.agents):
            raise ValueError(f"actions must be for {', '.join(self.agents)}, not for {', '.join(actions) or 'nobody'}")
        given = np.zeros((len(self.possible_agents), 3), np.float32)
        for k, agent in enumerate(self.agents):
            given[k] = core.checked_action(actions[agent], self.action_spaces[agent].shape)
        state, agents = self._world.step(given if len(given) > 1 else given[0]), self.agents
        terminated, truncated = map(bool, core.ends_of(state))
        info = {name: float(value) for name, value in core.info_of(state).items()}
        rewards, observations = np.reshape(np.asarray(state.reward), -1), self._observations()
        if terminated or truncated:
            self.agents = []
        return (
            observations,
            {agent: float(rewards[k]) for k, agent in enumerate(agents)},
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: dict(info) for agent in agents},
        )

    def render(self) -> np.ndarray | None:
        """Image (height, width, 3) uint8 of the team and its goal, or None without a render mode."""
        return self._world.picture()

    def close(self) -> None:
        """Free the renderer."""
        self._world.close()

    def _observations(self) -> dict[str, np.ndarray]:
        observations = np.atleast_2d(self._world.seen())
        return {agent: observations[k].copy() for k, agent in enumerate(self.agents)}
