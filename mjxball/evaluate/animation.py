"""A flight as an animated picture, rendered by MuJoCo in a process of its own, which a failing GL library may end."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjxball.config import Plant, to_dict
from mjxball.rollout import Trajectory

FRAMES_PER_SECOND = 10
SIZE = (240, 320)  # height, width of each flight's part
PATIENCE = 120  # [s]


def animate(plant: Plant, flights: Sequence[Trajectory], seconds: float = 10.0) -> tuple[bytes | None, str]:
    """(animated WebP with the flights side by side, "") or (None, why there is none)."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        np.savez(place / "flights.npz", **_frames(flights, seconds))
        (place / "plant.json").write_text(_json(plant))
        environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        command = [sys.executable, "-m", "mjxball.evaluate.animation", str(place)]
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        except subprocess.TimeoutExpired:
            return None, f"MuJoCo's renderer took longer than {PATIENCE} s"
        picture = place / "flight.webp"
        if done.returncode or not picture.exists():
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            return None, f"MuJoCo's renderer found no working GL library ({lines[-1][:160] if lines else 'no message'})"
        return picture.read_bytes(), ""


def _frames(flights: Sequence[Trajectory], seconds: float) -> dict[str, np.ndarray]:
    time = flights[0].time
    every = max(1, round(1 / FRAMES_PER_SECOND / (time[1] - time[0])))
    rows = slice(0, int(np.searchsorted(time, seconds)), every)
    return {
        "position": np.stack([flight.position[rows] for flight in flights]),
        "quaternion": np.stack([flight.quaternion[rows] for flight in flights]),
        "offset": np.stack([flight.cg_offset[rows] for flight in flights]),
        "goal": np.stack([flight.goal for flight in flights]),
    }


def _json(plant: Plant) -> str:
    import json

    return json.dumps(to_dict(plant))


def _render(place: Path) -> None:
    import json

    import mujoco
    from PIL import Image

    from mjxball import config
    from mjxball.assembly import BALL_JOINT, build_spec

    settings = config.to_dict(config.Config())
    plant = config.from_dict({**settings, "plant": json.loads((place / "plant.json").read_text())}).plant
    spec = build_spec(plant)
    with np.load(place / "flights.npz") as stored:
        flights = {name: stored[name] for name in stored.files}
    ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.03, 0, 0], "rgba": [0.2, 0.8, 0.3, 0.6]}
    spec.worldbody.add_geom(pos=flights["goal"][0].tolist(), contype=0, conaffinity=0, **ball)
    model = spec.compile()
    data = mujoco.MjData(model)
    slide = model.jnt_qposadr[model.joint(BALL_JOINT).id]
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.55, 0.55, 0.65), 2.3, 120.0, -12.0
    frames = []
    with mujoco.Renderer(model, *SIZE) as renderer:
        for number in range(flights["position"].shape[1]):
            parts = []
            for flight in range(flights["position"].shape[0]):
                data.qpos[:3] = flights["position"][flight, number]
                data.qpos[3:7] = flights["quaternion"][flight, number]
                data.qpos[slide] = flights["offset"][flight, number] / plant.moving_fraction
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, camera)
                parts.append(renderer.render().copy())
            frames.append(Image.fromarray(np.concatenate(parts, axis=1)))
    duration = round(1000 / FRAMES_PER_SECOND)
    frames[0].save(
        place / "flight.webp", save_all=True, append_images=frames[1:], duration=duration, loop=0, quality=60, method=4
    )


if __name__ == "__main__":
    _render(Path(sys.argv[1]))
