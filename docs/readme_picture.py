"""Render docs/balance.gif, the picture of README and of the first page: three followers carry the same moving load.

    python docs/readme_picture.py [OUT.gif]

Of the disturbed flights that a training watches (`mjxball.bench.quick`) the one in which the largest error of
`lqg` after the deadline is its median. Above each flight with the path of O, below the distance of O from the
goal on a logarithmic axis. Needs Pillow and a GL library of MuJoCo (MUJOCO_GL=egl on a machine without a display).
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
from mjxball.bench.draw import quick_group
from mjxball.bench.evaluation import with_seed
from mjxball.bench.flying import ENGINE
from mjxball.bench.quick import KEY
from mjxball.config import Config, Plant
from mjxball.control.rotations import matrix_from_quaternion
from mjxball.evaluate.policies import load_policy
from mjxball.plotting import LOOKS
from mjxball.policy.file import shipped_policy
from mjxball.scene import Scene
from mjxball.sim.rollout import simulate_batch

SHOWN, SPEED = 20.0, 2  # [s], flight time over playing time
FRAMES, TRAIL = 100, 10  # in all; of the path of O that is drawn
LABELLED = {"leader": (26, 0, "lm"), "follower": (-26, 0, "rm"), "CG": (0, 34, "mm")}  # offsets [pixels], anchors
DISTANCE, VIEW, FOVY = 2.5, (112.0, -24.0), math.radians(45)  # [m]; azimuth, elevation of Scene [degrees]; vertical
PANE, HEAD, STRIP = (300, 236), 62, 166  # width and height of a view, heights of the names and of the curves [pixels]
LEFT, RIGHT, TOP, BOTTOM = 84, 14, 16, 34  # of the curves within the strip [pixels]
LOW, HIGH = 1e-3, 3.0  # ends of the error axis [m]
TICKS = {1e-3: "1 mm", 1e-1: "10 cm", 1.0: "1 m"}
INK, PALE, PAPER = (29, 35, 41), (214, 219, 224), (255, 255, 255)
COLOURS = 96  # of the GIF
CLASSICAL = "lqg"  # tuned for both conditions; `lqg-disturbed` looks as `balance` in its median flight
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
    config, scenario, radius = median_flight()
    followers = []
    for name, text, controller in (
        ("copy", "PD controller alone", make_baseline("copy", config)),
        (CLASSICAL, "classical controller", make_baseline(CLASSICAL, config)),
        ("balance", "trained network", load_policy(shipped_policy("balance"), config)),
    ):
        colour = ImageColor.getrgb(LOOKS[name][0])
        flight = simulate(config, controller, scenario, ENGINE)
        rows = np.searchsorted(flight.time, SHOWN * np.arange(FRAMES) / FRAMES)
        error = np.linalg.norm(flight.target - flight.position, axis=-1)
        parts = (part[rows] for part in (flight.position, flight.quaternion, flight.cg_offset, error))
        followers.append(Follower(name, text, colour, *parts))
    pictures = draw(config.plant, followers, np.array(scenario.goal), radius)
    palette = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures[::10]])).quantize(
        COLOURS, dither=Image.Dither.NONE
    )
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    duration = round(1000 * SHOWN / SPEED / FRAMES, -1)
    first.save(out, save_all=True, append_images=rest, duration=duration, loop=0, optimize=True)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")  # noqa: T201


def median_flight() -> tuple[Config, Scenario, float]:
    """(configuration, scenario, radius of success [m]) of the flight that is shown."""
    config, flights = quick_group("pair")
    disturbed = [one for one in flights if one.condition == "disturbed"]
    scenarios = [with_seed(one, KEY, 0) for one in disturbed]
    flown = simulate_batch(config, [(make_baseline(CLASSICAL, config), scenarios)], ENGINE)
    error = np.linalg.norm(flown.target - flown.position, axis=-1)
    late = [error[flown.time > one.deadline, k].max() for k, one in enumerate(disturbed)]
    chosen = int(np.argsort(late)[len(late) // 2])
    return config, scenarios[chosen], disturbed[chosen].radius


def draw(plant: Plant, followers: list[Follower], goal: np.ndarray, radius: float) -> list[Image.Image]:
    """The frames: the flights side by side above their errors, where a cursor is at the time of the frame."""
    scene = Scene(plant, goal, (2 * PANE[1], 2 * PANE[0]), goal, DISTANCE)
    below, pictures = curves(followers, radius), []
    for row in range(FRAMES):
        picture = Image.new("RGB", (below.width, HEAD + PANE[1] + STRIP), PAPER)
        for k, follower in enumerate(followers):
            picture.paste(pane(scene, follower, row, plant, goal), (k * (PANE[0] + 3), 0))
        picture.paste(below, (0, HEAD + PANE[1]))
        brush = ImageDraw.Draw(picture)
        x, bottom = across(row, picture.width), picture.height
        brush.line([(x, bottom - STRIP + TOP), (x, bottom - BOTTOM)], fill=INK, width=3)
        for follower in followers:
            dot(brush, (x, bottom - STRIP + height(follower.error[row])), 6, follower.colour, PAPER)
        pictures.append(picture)
    scene.close()
    return pictures


def pane(scene: Scene, follower: Follower, row: int, plant: Plant, goal: np.ndarray) -> Image.Image:
    """One flight under its name, with the latest path of O and the goal."""
    image = Image.new("RGB", (PANE[0], HEAD + PANE[1]), PAPER)
    view = scene.picture(follower.position[row], follower.quaternion[row], follower.offset[row])
    image.paste(Image.fromarray(view).resize(PANE, Image.Resampling.BOX), (0, HEAD))
    brush, colour, centre = ImageDraw.Draw(image), follower.colour, PANE[0] / 2
    path = [pixel(point - goal) for point in follower.position[max(row - TRAIL, 0) : row + 1]]
    brush.line(path, fill=colour, width=4, joint="curve")
    x, y = pixel(np.zeros(3))
    brush.line([(x, y - 66), (x, y - 20)], fill=INK, width=2)
    brush.line([(x, y + 20), (x, y + 66)], fill=INK, width=2)
    brush.ellipse([x - 20, y - 20, x + 20, y + 20], outline=INK, width=2)
    brush.text((x, y - 72), "goal", fill=INK, font=SMALL, anchor="ms")
    dot(brush, path[-1], 7, colour, PAPER)
    turn = matrix_from_quaternion(follower.quaternion[row])
    offset = np.append(follower.offset[row], [0.0, 0.0]) if plant.cg_axis == "x" else np.zeros(3)
    places = {"leader": plant.drones[0].mount, "follower": plant.drones[1].mount, "CG": offset}
    for text, (right, down, anchor) in LABELLED.items():
        x, y = pixel(follower.position[row] + turn @ np.array(places[text]) - goal)
        brush.text((x + right, y + down), text, fill=INK, font=SMALL, anchor=anchor, stroke_width=2, stroke_fill=PAPER)
    brush.rectangle([0, 0, PANE[0], HEAD - 1], fill=colour)
    brush.text((centre, 20), follower.name, fill=PAPER, font=LARGE, anchor="mm", stroke_width=0.5)
    brush.text((centre, 46), follower.text, fill=PAPER, font=SMALL, anchor="mm")
    error, at = follower.error[row], (centre, image.height - 22)
    text = f"error {100 * error:.0f} cm" if error > 0.01 else f"error {1000 * error:.1f} mm"
    brush.text(at, text, fill=colour, font=MIDDLE, anchor="mm", stroke_width=3, stroke_fill=PAPER)
    return image


def curves(followers: list[Follower], radius: float) -> Image.Image:
    """The errors against time, and the `radius` of success."""
    strip = Image.new("RGB", (len(followers) * (PANE[0] + 3) - 3, STRIP), PAPER)
    brush = ImageDraw.Draw(strip)
    for value, text in TICKS.items():
        brush.line([(LEFT, height(value)), (strip.width - RIGHT, height(value))], fill=PALE, width=2)
        brush.text((LEFT - 8, height(value)), text, fill=INK, font=SMALL, anchor="rm")
    for x in range(LEFT, strip.width - RIGHT, 12):
        brush.line([(x, height(radius)), (x + 6, height(radius))], fill=INK, width=2)
    brush.text((LEFT - 8, height(radius)), f"{100 * radius:g} cm", fill=INK, font=SMALL, anchor="rm")
    brush.text((LEFT, STRIP - 8), "dashed: allowed", fill=INK, font=SMALL, anchor="ls")
    for second in range(10, round(SHOWN), 5):
        x = across(FRAMES * second / SHOWN, strip.width)
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


def pixel(away: np.ndarray) -> tuple[float, float]:
    """Place of what is `away` from the goal (3,) [m] in a pane [pixels], as the scene's camera sees it."""
    azimuth, elevation = map(math.radians, VIEW)
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    level = math.cos(elevation)
    ahead = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
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
