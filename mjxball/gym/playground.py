"""The environment for MuJoCo Playground's wrappers and trainers, which read `state.data`, not Brax's `pipeline_state`.

Playground itself need not be installed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import flax.struct
import mujoco
import numpy as np

from mjxball.arrays import Array
from mjxball.assembly import build_model
from mjxball.config import Config
from mjxball.env import PipelineState, State, TransportEnv
from mjxball.gym import core


@flax.struct.dataclass
class PlaygroundState:
    """The fields of Playground's `State`; `data` is this project's `PipelineState` instead of an `mjx.Data`."""

    data: PipelineState
    obs: Array  # (n,) the networks' input, with privileged information of critics
    reward: Array  # ()
    done: Array  # () 1 at the end of an episode
    metrics: dict[str, Array]
    info: dict[str, Any]


class PlaygroundEnv:
    """`TransportEnv` with the attributes of Playground's `MjxEnv`, for its `wrap_for_brax_training`.

    Every reset randomises the world, so `randomization_fn` is not needed. Use `full_reset=True`, or every episode of a
    world repeats its first one.
    """

    def __init__(self, preset: str = "transport", config: Config | None = None, physics: str = "mjx"):
        self.config = core.pair_settings(preset, config)
        self._pair = TransportEnv(self.config, physics)

    def reset(self, rng: Array) -> PlaygroundState:
        """See `TransportEnv.reset`."""
        return _playground(self._pair.reset(rng))

    def step(self, state: PlaygroundState, action: Array) -> PlaygroundState:
        """See `TransportEnv.step`: `action` (3,) is clipped to [-1, 1]."""
        given = State(state.data, state.obs, state.reward, state.done, state.metrics, state.info)
        return _playground(self._pair.step(given, action))

    @property
    def observation_size(self) -> int:
        """Length of the networks' input."""
        return self._pair.observation_size

    @property
    def action_size(self) -> int:
        """Length of an action: roll, pitch, vertical acceleration."""
        return self._pair.action_size

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self._pair.dt

    @property
    def sim_dt(self) -> float:
        """Physics step [s]."""
        return self.config.physics_step

    @property
    def n_substeps(self) -> int:
        """Physics steps in a control period."""
        return self.config.timing.physics_steps

    @property
    def unwrapped(self) -> PlaygroundEnv:
        """Itself."""
        return self

    @property
    def xml_path(self) -> str:
        """Empty: the model has no file (see `python -m mjxball.assembly`)."""
        return ""

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The assembly as a MuJoCo model."""
        return build_model(self.config.plant)

    @property
    def mjx_model(self) -> Any:
        """The assembly as an MJX model; the environment itself reads the object's mass from its `PipelineState`."""
        from mjxball.quiet import import_mjx

        return import_mjx().put_model(self.mj_model)

    def render(
        self, trajectory: Sequence[PlaygroundState], height: int = 240, width: int = 320, *unused: Any
    ) -> list[np.ndarray]:
        """Images (height, width, 3) of unbatched states; Playground's camera and scene options are not used."""
        from mjxball.scene import Scene

        goal = np.asarray(trajectory[0].data.goal, float)
        scene = Scene(self.config.plant, goal, (height, width), goal / 2)
        pictures = [scene.picture(*core.pose_of(self.config, state.data)) for state in trajectory]
        scene.close()
        return pictures


def _playground(state: Any) -> PlaygroundState:
    return PlaygroundState(
        state.pipeline_state, state.obs, state.reward, state.done, dict(state.metrics), dict(state.info)
    )
