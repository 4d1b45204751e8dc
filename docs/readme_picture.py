"""Render docs/balance.gif, the picture of README and of the first page: three followers carry the same moving load.

    python docs/readme_picture.py [OUT.gif]

The last two cycles of a flight of 45 s in which the CG moves +-10 cm at 0.62 rad/s. They are steady state, so the
picture loops. Above each flight with the path of O, below the distance of O from the goal on a logarithmic axis.
Needs Pillow and a GL library of MuJoCo (MUJOCO_GL=egl on a machine without a display).
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from mjxball import Scenario, simulate
from mjxball.baselines import make_baseline
from mjxball.config import Plant, preset
from mjxball.plotting import LOOKS
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxball.scene import Scene

OMEGA, AMPLITUDE, GOAL = 0.62, 0.10, (1.0, 1.0, 1.0)  # [rad/s], [m], [m]
END, SHOWN, SPEED = 45.0, 4 * math.pi / OMEGA, 2  # [s], [s], flight time over playing time
FRAMES = 100  # two cycles, in each the same views
DISTANCE, VIEW, FOVY = 1.78, (112.0, -24.0), math.radians(45)  # [m]; azimuth, elevation of Scene [degrees]; vertical
PANE, HEAD, STRIP = (300, 236), 62, 166  # width and height of a view, heights of the names and of the curves [pixels]
LEFT, RIGHT, TOP, BOTTOM = 84, 14, 16, 34  # of the curves within the strip [pixels]
LOW, HIGH = 1e-5, 1.0  # ends of the error axis [m]
TICKS = {1e-4: "0.1 mm", 1e-3: "1 mm", 1e-2: "1 cm", 1e-1: "10 cm", 1.0: "1 m"}
INK, PALE, PAPER = (29, 35, 41), (214, 219, 224), (255, 255, 255)
COLOURS = 128  # of the GIF
SMALL, MIDDLE, LARGE = (ImageFont.load_default(size) for size in (20, 26, 28))


class Follower(NamedTuple):
    """One follower's flight, a row a frame."""

    name: str
    text: str
    colour: tuple[int, int, int]
    position: np.ndarray  # of O (n, 3) [m]
    quaternion: np.ndarray  # (n, 4)
    offset: np.ndarray  # of the CG (n,) [m]
    error: np.ndarray  # |e_o| (n,) [m]


def main() -> None:
    """Fly the followers, draw the frames, write the GIF."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "balance.gif"
    config = preset("transport")
    scenario = Scenario(omega=OMEGA, amplitude=AMPLITUDE, goal=GOAL, seconds=END)
    followers = []
    for name, text, controller in (
        ("copy", "PD controller alone", make_baseline("copy", config)),
        ("lqg", "classical controller", make_baseline("lqg", config)),
        ("balance", "trained network", Policy.load(shipped_policy("balance"))),
    ):
        colour = ImageColor.getrgb(LOOKS[name][0])
        flight = simulate(config, controller, scenario, "newton-euler")
        rows = np.searchsorted(flight.time, END + SHOWN * (np.arange(FRAMES) / FRAMES - 1))
        error = np.linalg.norm(flight.target - flight.position, axis=-1)
        parts = (part[rows] for part in (flight.position, flight.quaternion, flight.cg_offset, error))
        followers.append(Follower(name, text, colour, *parts))
    pictures = draw(config.plant, followers)
    palette = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures[::10]])).quantize(
        COLOURS, dither=Image.Dither.NONE
    )
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    duration = round(1000 * SHOWN / SPEED / FRAMES, -1)
    first.save(out, save_all=True, append_images=rest, duration=duration, loop=0, optimize=True)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")  # noqa: T201


def draw(plant: Plant, followers: list[Follower]) -> list[Image.Image]:
    """The frames: the flights side by side above their errors, where a cursor is at the time of the frame."""
    scene = Scene(plant, np.array(GOAL), (2 * PANE[1], 2 * PANE[0]), np.array(GOAL), DISTANCE)
    below, pictures = curves(followers), []
    for row in range(FRAMES):
        picture = Image.new("RGB", (below.width, HEAD + PANE[1] + STRIP), PAPER)
        for k, follower in enumerate(followers):
            picture.paste(pane(scene, follower, row), (k * (PANE[0] + 3), 0))
        picture.paste(below, (0, HEAD + PANE[1]))
        brush = ImageDraw.Draw(picture)
        x, bottom = across(row, picture.width), picture.height
        brush.line([(x, bottom - STRIP + TOP), (x, bottom - BOTTOM)], fill=INK, width=3)
        for follower in followers:
            dot(brush, (x, bottom - STRIP + height(follower.error[row])), 6, follower.colour, PAPER)
        pictures.append(picture)
    scene.close()
    return pictures


def pane(scene: Scene, follower: Follower, row: int) -> Image.Image:
    """One flight under its name, with the path of O during the last cycle and the goal."""
    image = Image.new("RGB", (PANE[0], HEAD + PANE[1]), PAPER)
    view = scene.picture(follower.position[row], follower.quaternion[row], follower.offset[row])
    image.paste(Image.fromarray(view).resize(PANE, Image.Resampling.BOX), (0, HEAD))
    brush, colour, centre = ImageDraw.Draw(image), follower.colour, PANE[0] / 2
    path = [pixel(point) for point in follower.position[np.arange(row - FRAMES // 2, row + 1)]]
    brush.line(path, fill=colour, width=4, joint="curve")
    x, y = pixel(np.array(GOAL))
    brush.line([(x, y - 66), (x, y - 20)], fill=INK, width=2)
    brush.line([(x, y + 20), (x, y + 66)], fill=INK, width=2)
    brush.ellipse([x - 20, y - 20, x + 20, y + 20], outline=INK, width=2)
    brush.text((x, y - 72), "goal", fill=INK, font=SMALL, anchor="ms")
    dot(brush, path[-1], 7, colour, PAPER)
    brush.rectangle([0, 0, PANE[0], HEAD - 1], fill=colour)
    brush.text((centre, 20), follower.name, fill=PAPER, font=LARGE, anchor="mm", stroke_width=0.5)
    brush.text((centre, 46), follower.text, fill=PAPER, font=SMALL, anchor="mm")
    error, at = follower.error[row], (centre, image.height - 22)
    text = f"error {100 * error:.0f} cm" if error > 0.01 else f"error {1000 * error:.1f} mm"
    brush.text(at, text, fill=colour, font=MIDDLE, anchor="mm", stroke_width=3, stroke_fill=PAPER)
    return image


def curves(followers: list[Follower]) -> Image.Image:
    """The errors against time."""
    strip = Image.new("RGB", (len(followers) * (PANE[0] + 3) - 3, STRIP), PAPER)
    brush, begin = ImageDraw.Draw(strip), END - SHOWN
    for value, text in TICKS.items():
        brush.line([(LEFT, height(value)), (strip.width - RIGHT, height(value))], fill=PALE, width=2)
        brush.text((LEFT - 8, height(value)), text, fill=INK, font=SMALL, anchor="rm")
    for second in range(25, 45, 5):
        x = across(FRAMES * (second - begin) / SHOWN, strip.width)
        brush.text((x, STRIP - 8), f"{second} s", fill=INK, font=SMALL, anchor="ms")
    brush.text((strip.width - RIGHT, STRIP - 8), f"{SPEED}x speed", fill=INK, font=SMALL, anchor="rs")
    for follower in followers:
        points = [(across(row, strip.width), height(error)) for row, error in enumerate(follower.error)]
        brush.line(points, fill=follower.colour, width=4, joint="curve")
    return strip


def dot(brush: ImageDraw.ImageDraw, at: tuple[float, float], radius: float, fill: tuple, outline: tuple) -> None:
    """A disc around `at` [pixels]."""
    box = [at[0] - radius, at[1] - radius, at[0] + radius, at[1] + radius]
    brush.ellipse(box, fill=fill, outline=outline, width=2)


def pixel(point: np.ndarray) -> tuple[float, float]:
    """Place of `point` (3,) [m] in a pane [pixels], as the scene's camera sees it."""
    azimuth, elevation = map(math.radians, VIEW)
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    level = math.cos(elevation)
    ahead = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    away = point - np.array(GOAL)
    scale = PANE[1] / 2 / math.tan(FOVY / 2) / (DISTANCE + away @ ahead)
    return PANE[0] / 2 + scale * (away @ right), HEAD + PANE[1] / 2 - scale * (away @ np.cross(right, ahead))


def across(row: float, width: int) -> float:
    """Place of a frame on the time axis, from the left [pixels]."""
    return LEFT + (width - LEFT - RIGHT) * row / FRAMES


def height(error: float) -> float:
    """Place of `error` [m] in the strip, from its top [pixels]."""
    share = math.log(min(max(error, LOW), HIGH) / LOW) / math.log(HIGH / LOW)
    return STRIP - BOTTOM - (STRIP - TOP - BOTTOM) * share


if __name__ == "__main__":
    main()
