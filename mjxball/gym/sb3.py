"""Stable-Baselines3: many worlds of the follower's task in one compiled program, as its `VecEnv`.

`mjxball.foreign.from_sb3` makes a policy file of what it trains.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "stable-baselines3 is not installed; pip install stable-baselines3", name="stable_baselines3"
    ) from None

from mjxball.config import Config
from mjxball.foreign import TANH_IS_ONE
from mjxball.gym.vector import FollowerVectorEnv


class FollowerVecEnv(VecEnv):
    """`FollowerVectorEnv` for Stable-Baselines3 and SBX: N worlds, each reset in the step in which it ends.

    With `tanh` actions (N, 3) are unbounded and pass through tanh, as those of a policy file do: for PPO, which would
    clip them.
    """

    def __init__(
        self,
        num_envs: int = 64,
        preset: str = "transport",
        config: Config | None = None,
        physics: str = "newton-euler",
        tanh: bool = False,
    ):
        self._env = FollowerVectorEnv(num_envs, preset, config, physics, autoreset_mode="SameStep")
        self.config, self._tanh = self._env.config, tanh
        self._seed: int | None = None  # of the next reset; None goes on with the random chain
        box = self._env.single_action_space
        wide = gymnasium.spaces.Box(-TANH_IS_ONE, TANH_IS_ONE, box.shape, np.float32)
        self.render_mode = None
        super().__init__(num_envs, self._env.single_observation_space, wide if tanh else box)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Of the next `reset`: world i has `seed` + i."""
        self._seed = int(np.random.default_rng().integers(2**31)) if seed is None else int(seed)
        return [self._seed + world for world in range(self.num_envs)]

    def reset(self) -> np.ndarray:
        """First observations (N, n)."""
        seed, self._seed = self._seed, None
        return self._env.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Keep `actions` (N, 3) for `step_wait`."""
        self._actions = np.tanh(actions) if self._tanh else actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """(observations (N, n), rewards (N,), which ended (N,), a dictionary for each world)."""
        seen, reward, terminated, truncated, info = self._env.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(ended):
            last = {"terminal_observation": info["final_obs"][world], "TimeLimit.truncated": bool(truncated[world])}
            infos[world] = last
        return seen, reward.astype(np.float32), ended, infos

    def close(self) -> None:
        """Free the worlds."""
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for every world."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Worlds have no attributes of their own: AttributeError."""
        raise AttributeError(f"worlds share {attr_name}; make another FollowerVecEnv")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Worlds have no methods of their own: AttributeError."""
        raise AttributeError(f"worlds have no method {method_name}")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No world has a wrapper of its own."""
        return [False] * len(list(self._get_indices(indices)))
