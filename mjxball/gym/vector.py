"""Many worlds as a `gymnasium.vector.VectorEnv`, in one compiled program on MJX or the closed form."""

from __future__ import annotations

import functools
from typing import Any, ClassVar, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from mjxball.cache import enable_compilation_cache
from mjxball.config import Config
from mjxball.env import CoupledPairEnv
from mjxball.gym import worlds

Array = Any


class Program(NamedTuple):
    """The compiled functions of N worlds."""

    pair: CoupledPairEnv
    start: Any  # chains (N,) -> (chains, State)
    step: Any  # (chains, State, actions (N, 3)) -> (chains, State), ended worlds started anew


@functools.lru_cache(maxsize=8)
def compiled_program(config: Config, physics: str) -> Program:
    """The program of `config` on `physics`, compiled once for each number of worlds."""
    enable_compilation_cache()
    pair = CoupledPairEnv(config, physics)

    def start(chain: Array) -> tuple[Array, Any]:
        chain, key = worlds.next_world(chain)
        return chain, pair.reset(key)

    def step(chain: Array, state: Any, action: Array) -> tuple[Array, Any]:
        ended = state.done > 0
        fresh = start(chain)
        moved = (chain, pair.step(state.replace(done=jnp.zeros_like(state.done)), action))
        return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, moved)

    return Program(pair, jax.jit(jax.vmap(start)), jax.jit(jax.vmap(step)))


class FollowerVectorEnv(gymnasium.vector.VectorEnv):
    """N worlds of the follower's task; world i is `FollowerEnv` seeded with `seed + i`, on another engine.

    `physics` is mjx or newton-euler, in float32. Autoreset is Gymnasium's next-step: the step after an end ignores
    that world's action, starts its next episode and returns the first observation with reward 0.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        preset: str = "transport",
        config: Config | None = None,
        physics: str = "mjx",
        render_mode: str | None = None,
    ):
        if render_mode is not None:
            raise ValueError("the vector environment renders nothing; render one world with gymnasium.make")
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.config = worlds.settings(preset, config)
        self.num_envs, self.render_mode = num_envs, render_mode
        self._program = compiled_program(self.config, physics)
        self.single_observation_space, self.single_action_space = worlds.spaces(self._program.pair)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        self._chains: Any = None
        self._state: Any = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Fresh worlds. `seed` seeds world i with `seed + i`, or each with its own of a list; None goes on."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        if self._chains is None or seed is not None:
            self._chains = jax.vmap(jax.random.key)(jnp.asarray(self._numbers(seed), jnp.uint32))
        self._chains, self._state = self._program.start(self._chains)
        return self._seen(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hold `actions` (N, 3) in [-1, 1] for one control period."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        given = jnp.asarray(actions, jnp.float32)
        if given.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, not {given.shape}")
        going = np.asarray(self._state.done) == 0
        self._chains, self._state = self._program.step(self._chains, self._state, given)
        state = self._state
        truncated = np.asarray(state.info["truncation"]) > 0
        terminated = (np.asarray(state.done) > 0) & ~truncated
        info: dict[str, Any] = {}
        for name, value in worlds.told(state).items():
            info[name], info[f"_{name}"] = np.array(value), going.copy()
        return self._seen(), np.array(state.reward, np.float64), terminated, truncated, info

    def _seen(self) -> np.ndarray:
        return np.array(self._state.obs[:, : self._program.pair.seen_size])

    def _numbers(self, seed: int | list[int | None] | None) -> list[int]:
        """One number for each world, drawn as `FollowerEnv` would."""
        if isinstance(seed, list) and len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds were given for {self.num_envs} worlds")
        if seed is None:
            seeds: list[int | None] = [int(number) for number in self.np_random.integers(2**32, size=self.num_envs)]
        else:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        return [worlds.seed_number(gymnasium.utils.seeding.np_random(each)[0]) for each in seeds]
