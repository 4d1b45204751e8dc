"""The viewer's page: one HTML file with the flights inside, which needs no server."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Plant
from mjxball.pictures import COLOURS
from mjxball.plant import rotors
from mjxball.plotting import BLUE, BROWN, GREEN, OLIVE, PINK, SKY
from mjxball.view.flight import Flight

PARTS = Path(__file__).parent / "parts"
UNMEASURED = ("cg_offset", "object_mass", "contact_force")  # absent from flight logs
SHOWN = ("time", "position", "euler", "quaternion", "leader_command", "follower_command", "target", "hidden")
SCRIPTS = ("space.js", "flight.js", "scene.js", "plots.js", "player.js", "controls.js")
DRONES = {f"drone-{number}": colour for number, colour in enumerate(COLOURS)}  # the leader, then followers
AXES = {"x": PINK, "y": GREEN, "z": BLUE}
SCENE = {"goal": GREEN, "cg": OLIVE, "thrust": SKY, "contact": PINK, "weight": BROWN, "path": BLUE}


def flight_page(*flights: Flight) -> str:
    """The page's HTML with one flight, or two side by side, as float32."""
    title, contents = " | ".join(flight.title for flight in flights), [page_contents(one) for one in flights]
    return page_of(title, contents, PARTS / "recorded.js")


def page_of(title: str, data: Any, start: Path) -> str:
    """The viewer's HTML with `data` inside; the script in the file `start` creates the player."""
    script = "\n".join(path.read_text(encoding="utf-8") for path in (*(PARTS / name for name in SCRIPTS), start))
    colours = " ".join(f"--{name}: {colour};" for name, colour in (DRONES | AXES | SCENE | {"good": GREEN}).items())
    parts = {
        "title": html.escape(title),
        "style": f"{(PARTS / 'style.css').read_text(encoding='utf-8')}:root {{ {colours} }}",
        "data": _json(data),
        "script": script,
    }
    page = (PARTS / "page.html").read_text(encoding="utf-8")
    # One pass, because a title may look like a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page)


def page_contents(flight: Flight) -> dict[str, Any]:
    """The JSON of `flight` in the page: title, packed arrays, marks, and the geometry of the plant."""
    shown = {name: flight[name] for name in SHOWN if name in flight.arrays}
    if flight["contact_force"].any():  # a carried object always exerts force, so zeros mean not measured
        shown |= {name: flight[name] for name in UNMEASURED}
    return {
        "title": flight.title,
        "rows": len(flight["time"]),
        "arrays": {name: packed(array) for name, array in (shown | {"thrust": flight["rotor_force"].sum(-1)}).items()},
        "plant": plant_of(flight.plant),
        "marks": [mark._asdict() for mark in flight.marks],
        "facts": flight.facts,
    }


def plant_of(plant: Plant) -> dict[str, Any]:
    """Geometry and gravity of `plant` for the scene."""
    followers = iter(range(1, plant.count))
    names = ["leader" if number == plant.leader else f"follower {next(followers)}" for number in range(plant.count)]
    return {
        "size": plant.object_size,
        "disc": plant.is_disc,
        "drones": [
            {"name": name if plant.count > 2 else name.split()[0], "mount": drone.mount, "arm": arm, "rotors": places}
            for name, drone, arm, places in zip(
                names, plant.drones, plant.of_drones("arm"), _rotor_places(plant), strict=True
            )
        ],
        "leader": plant.leader,
        "axes": plant.directions,
        "share": plant.moving_fraction,
        "ball": plant.ball_radius,
        "rim": plant.ball_stop,
        "gravity": plant.gravity,
    }


def _rotor_places(plant: Plant) -> list[list[list[float]]]:
    """(x, y) of the rotors of each drone from its centre, in the assembly's body axes [m]."""
    places = []
    for drone, arm in zip(plant.drones, plant.of_drones("arm"), strict=True):
        c, s = math.cos(drone.yaw), math.sin(drone.yaw)
        in_drone_axes = rotors.lever(arm, plant.layout) * np.array(rotors.PLACES[plant.layout], dtype=float)
        places.append((in_drone_axes @ [[c, s], [-s, c]]).tolist())
    return places


def packed(array: np.ndarray) -> str:
    """`array` in row-major order as little-endian float32 in base64."""
    return base64.b64encode(np.ascontiguousarray(array, "<f4").tobytes()).decode("ascii")


def _json(value: Any) -> str:
    """JSON that cannot end the script element which holds it."""
    return json.dumps(value).replace("<", "\\u003c")
