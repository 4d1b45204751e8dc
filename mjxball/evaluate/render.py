"""Flights side by side as one animated picture, rendered by MuJoCo.

Rendering runs in a child process: a broken GL library may abort the interpreter.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Plant
from mjxball.reading import parse_json
from mjxball.sim.rollout import Trajectory

PANEL = (360, 360)  # height, width of one flight's panel
FRAMES_PER_SECOND = 12.5
TIME_LIMIT = 240  # [s]
TRAIL = 3.0  # [s] of the path that is drawn
TEXT = (29, 35, 41)


def film(
    plant: Plant, flights: Mapping[str, Trajectory], seconds: float, start: float = 0.0, speed: float = 2.0
) -> tuple[bytes | None, str]:
    """(animated WebP, "") or (None, reason); `flights` by label, from `start` for `seconds` of flight time.

    `speed` is flight time over playing time.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "flights.npz", **_arrays(list(flights.values()), start, seconds, speed))
        about = {"plant": configs.to_dict(plant), "labels": list(flights), "speed": speed}
        (folder / "about.json").write_text(json.dumps(about))
        environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        command = [sys.executable, "-m", "mjxball.evaluate.render", str(folder)]
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=TIME_LIMIT, check=False
            )
        except subprocess.TimeoutExpired:
            return None, f"MuJoCo's renderer took longer than {TIME_LIMIT} s"
        picture = folder / "film.webp"
        if done.returncode or not picture.exists():
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            return None, f"MuJoCo's renderer found no working GL library ({lines[-1][:160] if lines else 'no message'})"
        return picture.read_bytes(), ""


def _arrays(flights: Sequence[Trajectory], start: float, seconds: float, speed: float) -> dict[str, Any]:
    time = flights[0].time
    every = max(1, round(speed / FRAMES_PER_SECOND / (time[1] - time[0])))
    rows = slice(int(np.searchsorted(time, start - 1e-9)), int(np.searchsorted(time, start + seconds - 1e-9)), every)
    return {
        "time": time[rows],
        "position": np.stack([flight.position[rows] for flight in flights]),
        "quaternion": np.stack([flight.quaternion[rows] for flight in flights]),
        "offset": np.stack([flight.cg_offset[rows] for flight in flights]),
        "goal": flights[0].target[rows],
    }


def frames(plant: Plant, labels: Sequence[str], arrays: Mapping[str, Any], panel: tuple[int, int] = PANEL) -> list[Any]:
    """One PIL image per row of `arrays` (see `_arrays`): the flights side by side, labelled, with |e_o| and time."""
    from PIL import Image, ImageDraw, ImageFont

    from mjxball.scene import Scene

    position, goal, time = arrays["position"], arrays["goal"], arrays["time"]
    look_at, distance = _framing(plant, position, goal)
    scene = Scene(plant, goal[0], panel, look_at, distance)
    trail, pictures = round(TRAIL / (time[1] - time[0])), []
    large, small = (ImageFont.load_default(size) for size in (panel[0] // 17, panel[0] // 22))
    for row in range(len(time)):
        scene.move_goal(goal[row], look_at)
        views = []
        for k in range(len(labels)):
            path = position[k, max(0, row - trail) : row + 1 : 2]
            views.append(scene.picture(position[k, row], arrays["quaternion"][k, row], arrays["offset"][k, row], path))
        image = Image.fromarray(np.concatenate(views, axis=1))
        draw = ImageDraw.Draw(image)
        for k, label in enumerate(labels):
            left, error = k * panel[1] + 12, float(np.linalg.norm(goal[row] - position[k, row]))
            draw.text((left, 8), label, fill=TEXT, font=large)
            draw.text((left, panel[0] - 32), f"error {100 * error:5.1f} cm", fill=TEXT, font=small)
            if k:
                draw.line([(k * panel[1], 0), (k * panel[1], panel[0])], fill="white", width=3)
        clock = f"{time[row]:.1f} s"
        draw.text((image.width - 12, panel[0] - 32), clock, fill=TEXT, font=small, anchor="ra")
        pictures.append(image)
    scene.close()
    return pictures


def _framing(plant: Plant, position: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """(what the camera looks at (3,), its distance [m]) so that all of the flights are seen."""
    points = np.concatenate([position.reshape(-1, 3), goal])
    centre = np.median(goal, axis=0)
    points = points[np.abs(points - centre).max(axis=-1) < 3.0]  # a flight that failed leaves the picture
    low, high = points.min(axis=0), points.max(axis=0)
    arms = max(np.linalg.norm(drone.mount) for drone in plant.drones) + 1.6 * plant.arm
    radius = 1.08 * (np.linalg.norm(high - low) / 2 + arms)  # what comes nearer to the camera looks larger
    return (low + high) / 2, float(radius / np.tan(np.radians(22.5)))


def _render(folder: Path) -> None:
    about = parse_json((folder / "about.json").read_text())
    plant = configs.from_record({"plant": about["plant"]}).plant
    with np.load(folder / "flights.npz") as stored:
        pictures = frames(plant, about["labels"], {name: stored[name] for name in stored.files})
    stream, options = io.BytesIO(), {"duration": round(1000 / FRAMES_PER_SECOND), "loop": 0, "quality": 60, "method": 3}
    pictures[0].save(stream, "WEBP", save_all=True, append_images=pictures[1:], **options)
    (folder / "film.webp").write_bytes(stream.getvalue())


if __name__ == "__main__":
    _render(Path(sys.argv[1]))
