"""A flight as an animated picture, rendered by MuJoCo in a process of its own, which a failing GL library may end."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Plant, to_dict
from mjxball.rollout import Trajectory

FRAMES_PER_SECOND = 10
SIZE = (240, 320)  # height, width of each flight's part
LOOK_AT = (0.55, 0.55, 0.65)  # between start and goal of the reference scenario [m]
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


def _frames(flights: Sequence[Trajectory], seconds: float) -> dict[str, Any]:
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

    from PIL import Image

    from mjxball import config
    from mjxball.scene import Scene

    settings = config.to_dict(config.Config())
    plant = config.from_dict({**settings, "plant": json.loads((place / "plant.json").read_text())}).plant
    with np.load(place / "flights.npz") as stored:
        flights = {name: stored[name] for name in stored.files}
    scene = Scene(plant, flights["goal"][0], SIZE, LOOK_AT)
    frames = []
    for number in range(flights["position"].shape[1]):
        poses = zip(*(flights[name][:, number] for name in ("position", "quaternion", "offset")), strict=True)
        frames.append(Image.fromarray(np.concatenate([scene.picture(*pose) for pose in poses], axis=1)))
    scene.close()
    duration = round(1000 / FRAMES_PER_SECOND)
    frames[0].save(
        place / "flight.webp", save_all=True, append_images=frames[1:], duration=duration, loop=0, quality=60, method=4
    )


if __name__ == "__main__":
    _render(Path(sys.argv[1]))
