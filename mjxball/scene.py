"""Images of drones and load, rendered by MuJoCo. `MUJOCO_GL` (egl, osmesa, glfw) selects the GL library."""

from __future__ import annotations

import dataclasses
import itertools
import os
import warnings

import mujoco
import numpy as np

from mjxball.arrays import Array
from mjxball.assembly import BALL_JOINTS, build_spec
from mjxball.config import Plant
from mjxball.errors import InputError

GOAL_COLOUR = (0.18, 0.62, 0.27, 0.55)
TRAIL_COLOUR = np.array([0.15, 0.35, 0.55, 0.35], np.float32)
AZIMUTH, ELEVATION = 112.0, -24.0  # of the camera [degrees]


class Scene:
    """Renderer of a plant and its goal with a fixed camera."""

    def __init__(self, plant: Plant, goal: Array, size: tuple[int, int], look_at: Array, distance: float = 2.3):
        """`goal` of O (3,) [m], `size` = (height, width) in pixels; camera `distance` [m] from `look_at` (3,)."""
        spec = build_spec(dataclasses.replace(plant, stand="free"))  # poses on a stand are given as in free flight
        _light(spec, plant)
        ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.03, 0, 0], "rgba": GOAL_COLOUR}
        spec.worldbody.add_geom(name="goal", pos=list(map(float, goal)), contype=0, conaffinity=0, **ball)
        spec.visual.global_.offwidth, spec.visual.global_.offheight = max(640, size[1]), max(480, size[0])
        # Without a GPU, MuJoCo's default shadows (4096 pixels) take two thirds of the time, its 28 slices a quarter.
        spec.visual.quality.shadowsize = 1024
        spec.visual.quality.numslices, spec.visual.quality.numstacks = 12, 8
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        joints = BALL_JOINTS[: len(plant.directions)]
        self._slides = [self._model.jnt_qposadr[self._model.joint(joint).id] for joint in joints]
        self._share = plant.moving_fraction
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, AZIMUTH, ELEVATION
        self._camera.lookat[:] = look_at
        self._renderer = _renderer(self._model, size)

    def move_goal(self, goal: Array, look_at: Array) -> None:
        """Put the goal at `goal` (3,) [m] and turn the camera to `look_at` (3,) [m]."""
        self._model.geom("goal").pos[:] = goal
        self._camera.lookat[:] = look_at

    def picture(self, position: Array, quaternion: Array, cg_offset: Array | float, path: Array = ()) -> np.ndarray:
        """Image (height, width, 3) uint8 with O at `position` (3,) [m], attitude (w, x, y, z), CG offset [m].

        `cg_offset` is (2,) if the load moves in a plane. `path` (n, 3) [m] is drawn as a line.
        """
        data = self._data
        data.qpos[:3], data.qpos[3:7] = position, quaternion
        data.qpos[self._slides] = np.asarray(cg_offset) / self._share
        mujoco.mj_forward(self._model, data)
        self._renderer.update_scene(data, self._camera)
        for begin, end in itertools.pairwise(path):
            self._add_line(begin, end)
        return self._renderer.render().copy()

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()

    def _add_line(self, begin: Array, end: Array) -> None:
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), TRAIL_COLOUR)
        mujoco.mjv_connector(geom, kind, 0.004, np.asarray(begin, float), np.asarray(end, float))
        scene.ngeom += 1


def _light(spec: mujoco.MjSpec, plant: Plant) -> None:
    """Set a bright sky, a light floor and a soft headlight in addition to the model's light."""
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=64, height=384)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, [0.80, 0.88, 0.96], [0.97, 0.98, 0.99]
    grid = spec.texture("grid")
    grid.rgb1, grid.rgb2 = [0.60, 0.64, 0.68], [0.66, 0.70, 0.74]
    spec.geom("floor").size = [0, 0, 0.1]  # infinite
    spec.geom("shell").rgba = [0.80, 0.68, 0.42, 0.30]
    ball, thick = spec.geom("cg"), plant.object_size[2] / 2
    ball.rgba, ball.size = [0.98, 0.72, 0.05, 1.0], [1.4 * thick, 0, 0]  # large enough to show outside the object
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35, 0.35, 0.35], [0.30, 0.30, 0.30]
    spec.visual.headlight.specular = [0.1, 0.1, 0.1]
    spec.visual.map.haze = 0.0


def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> mujoco.Renderer:
    """MuJoCo's renderer. Raises InputError, which recommends another GL library, if it does not work."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW's warning repeats the error below
            return mujoco.Renderer(model, *size)
    except Exception as error:  # each GL library raises another class
        chosen = os.environ.get("MUJOCO_GL")
        now = (
            f"MUJOCO_GL={chosen} does not work here"
            if chosen
            else "MUJOCO_GL is not set, and without it a display is needed"
        )
        raise InputError(
            f"MuJoCo cannot render: {now}; set MUJOCO_GL to egl or osmesa before Python starts ({error})"
        ) from error
