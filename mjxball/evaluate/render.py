"""Flights side by side as one animation, rendered by MuJoCo.

Rendering runs in a child process, because a broken GL library may abort the interpreter.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball import config as configs
from mjxball.config import Plant
from mjxball.errors import InputError
from mjxball.reading import parse_json
from mjxball.sim.trajectory import Trajectory

TIME_LIMIT = 240  # for a report's animation [s]
TRAIL = 3.0  # length of the path that is drawn [s]
TEXT = (29, 35, 41)


class Kind(NamedTuple):
    """Settings of one file type."""

    rate: float  # frames per second of playing time; for a GIF, with its 10 ms clock, 100 over an integer
    panel: tuple[int, int]  # height, width of one flight [pixels]
    most: int  # largest number of frames


KINDS = {
    ".webp": Kind(12.5, (360, 360), 1_000),
    ".gif": Kind(12.5, (360, 360), 1_000),
    ".mp4": Kind(30.0, (720, 720), 40_000),
}
PANEL = KINDS[".webp"].panel


def film(
    plant: Plant, flights: Mapping[str, Trajectory], seconds: float, start: float = 0.0, speed: float = 2.0
) -> tuple[bytes | None, str]:
    """Render `flights`, by label, from `start` for `seconds` of flight time: (animated WebP, "") or (None, reason).

    `speed` is flight time over playing time.
    """
    shown = {
        label: {
            "time": flight.time,
            "position": flight.position,
            "quaternion": flight.quaternion,
            "cg_offset": flight.cg_offset,
            "target": flight.target,
        }
        for label, flight in flights.items()
    }
    try:
        return render([plant] * len(shown), shown, ".webp", seconds, start, speed, TIME_LIMIT), ""
    except InputError as error:
        return None, str(error)


def render(
    plants: Sequence[Plant],
    flights: Mapping[str, Mapping[str, np.ndarray]],
    suffix: str,
    seconds: float | None = None,
    start: float = 0.0,
    speed: float = 1.0,
    limit: float | None = None,
) -> bytes:
    """Contents of a file of type `suffix` that shows `flights` (arrays of a `Trajectory` by label) on `plants`.

    From `start` for `seconds` of flight time, None: to the end; a flight that has ended keeps its last state. `limit`
    is the time limit of rendering [s]. Raises InputError if it fails.
    """
    kind = KINDS[suffix]
    last = max(float(flight["time"][-1]) for flight in flights.values())
    until = last if seconds is None else min(start + seconds, last)
    number = int((until - start) * kind.rate / speed + 1e-6) + 1
    if number > kind.most:
        raise InputError(
            f"a {suffix} of {(until - start) / speed:.0f} s is too long, {kind.most / kind.rate:.0f} s is the most: "
            "show it faster (--speed)"
        )
    coder = _coder() if suffix == ".mp4" else ""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(
            folder / "flights.npz", **_arrays(list(flights.values()), start + np.arange(number) * speed / kind.rate)
        )
        about = {"plants": [configs.to_dict(one) for one in plants], "labels": list(flights), "suffix": suffix}
        (folder / "about.json").write_text(json.dumps({**about, "coder": coder}))
        environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        command = [sys.executable, "-m", "mjxball.evaluate.render", str(folder)]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(f"MuJoCo's renderer took longer than {limit} s") from None
        picture = folder / f"film{suffix}"
        if done.returncode or not picture.exists():
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            why = lines[-1][:160] if lines else "no message"
            what = "the coder of .mp4 failed" if "coder" in why else "MuJoCo's renderer found no working GL library"
            raise InputError(f"{what} ({why})")
        return picture.read_bytes()


def _coder() -> str:
    """Path of ffmpeg: the one on PATH, or imageio-ffmpeg's."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise InputError(
            "an .mp4 needs ffmpeg, which is not on PATH: install it, or pip install 'mjxball[video]', or write a .gif"
        ) from None


def _arrays(flights: Sequence[Mapping[str, np.ndarray]], times: np.ndarray) -> dict[str, Any]:
    """States of `flights` at `times` (n,) in the arrays that `frames` takes."""
    rows = [np.clip(np.searchsorted(flight["time"], times - 1e-9), 0, len(flight["time"]) - 1) for flight in flights]

    def stacked(name: str) -> np.ndarray:
        return np.stack([flight[name][own] for flight, own in zip(flights, rows, strict=True)])

    offsets = [flight["cg_offset"][own].reshape(len(times), -1) for flight, own in zip(flights, rows, strict=True)]
    return {
        "time": times,
        "position": stacked("position"),
        "quaternion": stacked("quaternion"),
        "offset": np.stack([np.pad(own, ((0, 0), (0, 2 - own.shape[1]))) for own in offsets]),
        "goal": stacked("target"),
    }


def frames(
    plants: Sequence[Plant], labels: Sequence[str], arrays: Mapping[str, Any], panel: tuple[int, int] = PANEL
) -> Iterator[Any]:
    """Yield one PIL image for each time (n,) of `arrays`: the flights side by side with label, |e_o| and time.

    The other arrays (flights, n, ...) are "position", "quaternion", "goal", and "offset" with two components, of which
    the second counts in a plane only.
    """
    from PIL import Image, ImageDraw, ImageFont

    from mjxball.scene import Scene

    position, goal, time = arrays["position"], arrays["goal"], arrays["time"]
    look_at, distance = _framing(plants, position, goal)
    trail = round(TRAIL / (time[1] - time[0])) if len(time) > 1 else 0
    every = max(1, trail // 20)
    large, small = (ImageFont.load_default(size) for size in (panel[0] // 17, panel[0] // 22))
    with contextlib.ExitStack() as stack:
        scenes = [Scene(plant, goal[k, 0], panel, look_at, distance) for k, plant in enumerate(plants)]
        for scene in scenes:
            stack.callback(scene.close)
        for row in range(len(time)):
            views = []
            for k, scene in enumerate(scenes):
                scene.move_goal(goal[k, row], look_at)
                path = position[k, max(0, row - trail) : row + 1 : every]
                offset = arrays["offset"][k, row, : len(plants[k].directions)]
                views.append(scene.picture(position[k, row], arrays["quaternion"][k, row], offset, path))
            image = Image.fromarray(np.concatenate(views, axis=1))
            draw = ImageDraw.Draw(image)
            for k, label in enumerate(labels):
                left, error = k * panel[1] + 12, float(np.linalg.norm(goal[k, row] - position[k, row]))
                draw.text((left, 8), label, fill=TEXT, font=large)
                draw.text((left, panel[0] - panel[0] // 11), f"error {100 * error:5.1f} cm", fill=TEXT, font=small)
                if k:
                    draw.line([(k * panel[1], 0), (k * panel[1], panel[0])], fill="white", width=3)
            clock = f"{time[row]:.1f} s"
            draw.text((image.width - 12, panel[0] - panel[0] // 11), clock, fill=TEXT, font=small, anchor="ra")
            yield image


def _framing(plants: Sequence[Plant], position: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """(point that the camera looks at (3,), its distance [m]) such that all flights are visible."""
    points = np.concatenate([position.reshape(-1, 3), goal.reshape(-1, 3)])
    centre = np.median(goal.reshape(-1, 3), axis=0)
    points = points[np.abs(points - centre).max(axis=-1) < 3.0]  # ignore parts of failed flights
    low, high = points.min(axis=0), points.max(axis=0)
    arms = max(float(np.linalg.norm(drone.mount)) + 1.6 * plant.arm for plant in plants for drone in plant.drones)
    radius = 1.08 * (np.linalg.norm(high - low) / 2 + arms)  # parts nearer to the camera look larger
    return (low + high) / 2, float(radius / np.tan(np.radians(22.5)))


def _render(folder: Path) -> None:
    about = parse_json((folder / "about.json").read_text())
    plants = [configs.from_record({"plant": one}).plant for one in about["plants"]]
    kind, out = KINDS[about["suffix"]], folder / f"film{about['suffix']}"
    with np.load(folder / "flights.npz") as stored:
        pictures = frames(plants, about["labels"], {name: stored[name] for name in stored.files}, kind.panel)
        if about["coder"]:
            _write_mp4(out, pictures, kind.rate, about["coder"])
        elif about["suffix"] == ".gif":
            _write_gif(out, pictures, kind.rate)
        else:
            first = next(pictures)
            options = {"duration": round(1000 / kind.rate), "loop": 0, "quality": 60, "method": 3}
            first.save(out, "WEBP", save_all=True, append_images=list(pictures), **options)


def _write_gif(out: Path, pictures: Iterator[Any], rate: float) -> None:
    """One palette without dither, so that static parts are stored once."""
    from PIL import Image

    first = next(pictures).quantize(128, dither=Image.Dither.NONE)
    rest = (picture.quantize(palette=first, dither=Image.Dither.NONE) for picture in pictures)
    first.save(out, save_all=True, append_images=rest, duration=round(1000 / rate), loop=0, optimize=True)


def _write_mp4(out: Path, pictures: Iterator[Any], rate: float, coder: str) -> None:
    first = next(pictures)
    size = f"{first.width}x{first.height}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(rate), "-i", "-"]
    command = [coder, "-loglevel", "error", *source, "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(out)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as coding:
        if coding.stdin is None or coding.stderr is None:
            raise RuntimeError
        with contextlib.suppress(BrokenPipeError):
            for picture in itertools.chain([first], pictures):
                coding.stdin.write(picture.tobytes())
            coding.stdin.close()
        said = coding.stderr.read().decode(errors="replace").strip()
    if coding.returncode:
        sys.exit(f"coder: {said.splitlines()[-1] if said else 'no message'}")


if __name__ == "__main__":
    _render(Path(sys.argv[1]))
