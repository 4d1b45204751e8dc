"""The pair as a picture, rendered by MuJoCo. `MUJOCO_GL` (egl, osmesa, glfw) chooses the GL library."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np

from mjxball.assembly import BALL_JOINT, build_spec
from mjxball.config import Plant

Array = Any
GOAL_COLOUR = (0.2, 0.8, 0.3, 0.6)
DISTANCE, AZIMUTH, ELEVATION = 2.3, 120.0, -12.0  # of the camera [m], [degrees]


class Scene:
    """A plant and its goal, seen by a camera that stands still."""

    def __init__(self, plant: Plant, goal: Array, size: tuple[int, int], look_at: Array):
        """`goal` of O (3,) [m], `size` = (height, width) in pixels, the camera looks at `look_at` (3,) [m]."""
        spec = build_spec(dataclasses.replace(plant, stand="free"))  # a stand's pose is one of free flight
        ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.03, 0, 0], "rgba": GOAL_COLOUR}
        spec.worldbody.add_geom(name="goal", pos=list(map(float, goal)), contype=0, conaffinity=0, **ball)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._slide = self._model.jnt_qposadr[self._model.joint(BALL_JOINT).id]
        self._share = plant.moving_fraction
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = DISTANCE, AZIMUTH, ELEVATION
        self._camera.lookat[:] = look_at
        self._renderer = mujoco.Renderer(self._model, *size)

    def move_goal(self, goal: Array, look_at: Array) -> None:
        """Put the goal at `goal` (3,) [m] and turn the camera to `look_at` (3,) [m]."""
        self._model.geom("goal").pos[:] = goal
        self._camera.lookat[:] = look_at

    def picture(self, position: Array, quaternion: Array, cg_offset: float) -> np.ndarray:
        """Pixels (height, width, 3) uint8 with O at `position` (3,) [m], attitude (w, x, y, z), CG offset [m]."""
        data = self._data
        data.qpos[:3], data.qpos[3:7] = position, quaternion
        data.qpos[self._slide] = cg_offset / self._share
        mujoco.mj_forward(self._model, data)
        self._renderer.update_scene(data, self._camera)
        return self._renderer.render().copy()

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()
