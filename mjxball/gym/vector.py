"""Many worlds as a `gymnasium.vector.VectorEnv`, in one compiled program on MJX or newton-euler."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from mjxball.config import Config
from mjxball.gym import core

METADATA: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}


class FollowerVectorEnv(gymnasium.vector.VectorEnv):
    """N worlds of the follower's task; world i is `FollowerEnv` seeded with `seed + i`, on another engine.

    `physics` is mjx or newton-euler, in float32. Autoreset as in Gymnasium: the next step ignores the action of an
    ended world and returns the first observation of its next episode with reward 0. With `SameStep` the same step
    returns it, and `info["final_obs"]` holds the last observation.
    """

    metadata = METADATA

    def __init__(
        self,
        num_envs: int = 1,
        preset: str = "transport",
        config: Config | None = None,
        physics: str = "mjx",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ):
        mode = AutoresetMode(autoreset_mode)
        if mode == AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode must be NextStep or SameStep")
        self.metadata = {**METADATA, "autoreset_mode": mode}
        self._same_step = mode == AutoresetMode.SAME_STEP
        if render_mode is not None:
            raise ValueError("the vector environment renders nothing; render one world with gymnasium.make")
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.config = core.pair_settings(preset, config)
        self.num_envs, self.render_mode = num_envs, render_mode
        self._worlds = core.Worlds(self.config, physics, self._same_step)
        self.single_observation_space, self.single_action_space = core.spaces(self._worlds.program.env)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Sampled worlds. World i is seeded with `seed + i`, or entry i of a list; None continues the random chain."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        reseed = seed is not None or self._worlds.state is None
        self._worlds.reset(self._seeds(seed) if reseed else None)
        return self._worlds.seen(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hold `actions` (N, 3), clipped to [-1, 1], for one control period; InputError unless they are finite."""
        before = self._worlds.state
        moved = self._worlds.step(core.checked_action(actions, self.action_space.shape))
        terminated, truncated = core.ends_of(moved)
        if self._same_step:
            info = self._ended(moved, terminated | truncated)
        else:
            info = _vector_info(moved, np.asarray(before.done) == 0)
        return self._worlds.seen(), np.array(moved.reward, np.float64), terminated, truncated, info

    def _ended(self, moved: Any, ended: np.ndarray) -> dict[str, Any]:
        """`info` of a step that has reset the worlds that `ended` (N,); `moved` is the state before the reset."""
        info: dict[str, Any] = dict(_vector_info(moved, ~ended))
        if ended.any():
            last = np.full(self.num_envs, None, object)
            observations = self._worlds.seen(moved)
            for world in np.flatnonzero(ended):
                last[world] = observations[world].copy()
            info |= {
                "final_obs": last,
                "_final_obs": ended,
                "final_info": _vector_info(moved, ended),
                "_final_info": ended,
            }
        return info

    def _seeds(self, seed: int | list[int | None] | None) -> list[int]:
        """`core.seed_number` of each world, as in `FollowerEnv`."""
        if isinstance(seed, list) and len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds were given for {self.num_envs} worlds")
        if seed is None:
            seeds: list[int | None] = [int(number) for number in self.np_random.integers(2**32, size=self.num_envs)]
        else:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        return [core.seed_number(gymnasium.utils.seeding.np_random(each)[0]) for each in seeds]


def _vector_info(state: Any, where: np.ndarray) -> dict[str, np.ndarray]:
    """Gymnasium's vector `info`: arrays (N,), valid `where` (N,) and else 0, each with that mask."""
    info = {}
    for name, value in core.info_of(state).items():
        info[name], info[f"_{name}"] = np.where(where, value, 0.0), where.copy()
    return info
