"""The followers of a team as JaxMARL's `MultiAgentEnv`: agents follower_1, ..., follower_F, entirely in JAX."""

from __future__ import annotations

import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.control.observation import ACTION_SIZE
from mjxball.env import State, TransportEnv
from mjxball.gym import core
from mjxball.quiet import import_quietly

try:
    base = import_quietly(
        "jaxmarl.environments.multi_agent_env"
    )  # its MABrax replaces sys.stdout; `import_quietly` puts it back
except ModuleNotFoundError as error:
    if error.name != "jaxmarl":
        raise
    raise ModuleNotFoundError("jaxmarl is not installed; pip install 'mjxball[jaxmarl]'", name="jaxmarl") from None
from jaxmarl.environments.spaces import Box

Each = dict[str, Array]  # value by agent


@flax.struct.dataclass
class FollowersState(base.State):  # type: ignore[name-defined]
    """JaxMARL's `done` () and `step` (), and the world."""

    world: State


class FollowersMultiAgentEnv(base.MultiAgentEnv):  # type: ignore[name-defined]
    """One world of `mjxball.env`. Each follower observes (n,) float32 and acts (3,) in [-1, 1], in its own frame.

    Agents, observations, rewards and terminations are those of `FollowersParallelEnv`, for `jax.jit`, `vmap` and
    `scan`. `step` resets an ended world, with an episode sampled with its key. All agents are done together. `info`
    holds for each agent the entries of PettingZoo's and `truncation`, 1 at the time limit. If teams have several sizes,
    an agent that does not exist observes zeros, has reward 0 and is done. `physics` is newton-euler or mjx; `config`
    replaces the preset's.
    """

    def __init__(self, preset: str = "team", config: Config | None = None, physics: str = "newton-euler"):
        self.config = core.settings(preset, config)
        self._env = TransportEnv(self.config, physics)
        super().__init__(len(self.config.plant.followers))
        self.agents = core.agents(self.config)
        self.observation_spaces = dict.fromkeys(self.agents, Box(-np.inf, np.inf, (self._env.policy_input_size,)))
        self.action_spaces = dict.fromkeys(self.agents, Box(-1.0, 1.0, (ACTION_SIZE,)))

    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[Each, FollowersState]:
        """A world sampled from `config.scenario`."""
        state = self._state(self._env.reset(key))
        return self.get_obs(state), state

    @functools.partial(jax.jit, static_argnums=0)
    def step_env(
        self, key: Array, state: FollowersState, actions: Each
    ) -> tuple[Each, FollowersState, Each, Each, dict[str, Array]]:
        """Hold every agent's action (3,), clipped to [-1, 1], for one control period; `key` is not used.

        A world whose actions are not all finite ends as diverged.
        """
        given = jnp.stack([actions[agent] for agent in self.agents])
        world = self._env.step(state.world, given if self.num_agents > 1 else given[0])
        moved, there = self._state(world), self._there(world)
        rewards = self._each(jnp.where(there, jnp.reshape(world.reward, -1), 0.0))
        dones = {**self._each(moved.done | ~there), "__all__": moved.done}
        info = {**core.info_of(world), "truncation": world.info["truncation"]}
        shared = {name: jnp.broadcast_to(value, self.num_agents) for name, value in info.items()}
        return self.get_obs(moved), moved, rewards, dones, shared

    def get_obs(self, state: FollowersState) -> Each:
        """Observation (n,) of every agent."""
        seen = jnp.reshape(state.world.obs, (self.num_agents, -1))[:, : self._env.policy_input_size]
        return self._each(jnp.where(self._there(state.world)[:, None], seen, 0.0))

    def get_avail_actions(self, state: FollowersState) -> Each:
        """Available actions (3,) of every agent: all."""
        return self._each(jnp.ones((self.num_agents, ACTION_SIZE), bool))

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Agents by class; all are of one."""
        return {"follower": self.agents}

    def _state(self, world: State) -> FollowersState:
        return FollowersState(done=world.done > 0, step=world.pipeline_state.steps, world=world)

    def _there(self, world: State) -> Array:
        return core.present(world.pipeline_state.parameters, self.config.plant.followers)

    def _each(self, values: Array) -> Each:
        return dict(zip(self.agents, values, strict=True))
