"""One world as a `gymnasium.Env`, by default on C MuJoCo where it can model the world."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.gym import core


def engine_of(config: Config, physics: str | None) -> str:
    """`physics`; by default C MuJoCo, or newton-euler if `scenario.inertia_scale` adds inertia without mass.

    C MuJoCo cannot model that. Raises InputError if it is requested then.
    """
    massless = config.scenario.inertia_scale != (1.0, 1.0)
    if massless and physics == "mujoco":
        raise InputError("C MuJoCo has no inertia without mass, which scenario.inertia_scale samples; use newton-euler")
    return physics or ("newton-euler" if massless else "mujoco")


class FollowerEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """The follower's task: observation (n,) float32, action (3,) in [-1, 1], both as in `mjxball.env`.

    `physics` is mujoco, newton-euler or mjx, in float64 (default: `engine_of`); `config` replaces the preset's.
    `terminated` means that the object left d_term or that the world diverged, `truncated` that the time limit was
    reached, where learners should bootstrap.
    """

    metadata = core.METADATA

    def __init__(
        self,
        preset: str = "transport",
        config: Config | None = None,
        physics: str | None = None,
        render_mode: str | None = None,
    ):
        self.config = core.pair_settings(preset, config)
        self.render_mode = render_mode
        self.metadata = {**core.METADATA, "render_fps": round(1 / self.config.timing.control_period)}
        self._world = core.HostWorld(self.config, engine_of(self.config, physics), render_mode)
        self.observation_space, self.action_space = core.spaces(self._world.program.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A world sampled from `config.scenario`; `options` are not used."""
        super().reset(seed=seed)
        reseed = seed is not None or self._world.state is None
        self._world.reset(core.seed_number(self.np_random) if reseed else None)
        return self._world.seen(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold `action` (3,), clipped to [-1, 1], for one control period; InputError unless it is finite."""
        state = self._world.step(core.checked_action(action, self.action_space.shape))
        terminated, truncated = map(bool, core.ends_of(state))
        info = {name: float(value) for name, value in core.info_of(state).items()}
        return self._world.seen(), float(state.reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Image (height, width, 3) uint8 of the pair and its goal, or None without a render mode."""
        return self._world.picture()

    def close(self) -> None:
        """Free the renderer."""
        self._world.close()
