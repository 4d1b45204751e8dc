"""The plant of a model: its values as settings, and a line for each value that it lacks and that is assumed.

Assumed values have the proportions of the reference pair and of the shipped teams.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from mjxball.config._model import Model, ModelDrone
from mjxball.config._model_acts import ROLLING, Rigid
from mjxball.config._plant import Drone, Plant
from mjxball.config._settings import Config
from mjxball.config._tree import leaves
from mjxball.errors import InputError
from mjxball.reading import is_number

ARM = 0.12  # of a drone of 1 kg, proportional to the cube root of its mass [m]
SPACING = 0.34 / 0.12  # distance of neighbours over the arm
THRUST = 5.5 / 9.81  # force of a rotor over the drone's weight
YAW = 0.02 / 0.12  # yaw moment over force, over the arm
LOAD, SPARE = 0.1, 0.25  # mass of the object over that of the drones, and at most over their spare lift
CARRIER = 0.05  # mass of a team's carrier over that of its drones
WIDTH, HEIGHT, BALL, AMPLITUDE = 0.10 / 0.34, 0.05 / 0.34, 0.02 / 0.34, 0.05 / 0.34  # over the object's length
SQUARE = 0.3  # largest distance of a rotor from the corner of a square, over the arm
SHOWN = 0.01  # over the arm or the inertia: larger deviations are reported
LINE = 20.0  # ratio of spacings along and across an axis from which two drones are on a line
SHARED = ("arm", "rotor_force_max", "rotor_lag", "yaw_per_thrust")  # settings of one drone or of the plant
QUARTERS = math.pi / 2 * np.arange(4)
UNITS = {  # of every setting, with a leading blank
    path: f" {unit[1]}" if (unit := re.search(r"\[(.+)\]", item.metadata["about"])) else ""
    for path, _, item in leaves(Config())
}


@dataclass
class _Settings:
    """Settings found in the model or assumed, unless the user has `given` them."""

    given: Mapping[str, Any]
    found: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)

    def assume(self, name: str, value: Any, why: str) -> None:
        """Set plant.`name` or another path and add a line, unless the user gave it."""
        path = name if "." in name else f"plant.{name}"
        if path not in self.given:
            self.found[path] = value
            parts = value if isinstance(value, list) else [value]
            shown = ", ".join(part if isinstance(part, str) else f"{part:.3g}" for part in parts)
            self.lines.append(f"assumed {path} {shown}{UNITS[path]}: {why}")

    def leave_out(self, what: str) -> None:
        """Add a line that the plant ignores `what`."""
        self.lines.append(f"left out: {what}")

    def number(self, name: str) -> float:
        """plant.`name` as the user gave it, if that is a positive number, else as found, else 0."""
        value, found = self.given.get(f"plant.{name}"), self.found.get(f"plant.{name}", 0.0)
        return float(value if is_number(value) and value > 0 else found)


def plant_of(model: Model, given: Mapping[str, Any], count: int | None) -> tuple[dict[str, Any], list[str]]:
    """(settings by dotted path with the list plant.drones, lines on assumed and ignored values) of `model`.

    `given`: settings of the user, which are not assumed. `count`: number of drones if the model is a single one, None
    for as many as plant.drones lists, or two. Raises InputError unless rotors form a square, and for a `count` beside a
    whole rig.
    """
    settings = _Settings(given)
    settings.found["plant.gravity"] = model.gravity
    for what in model.left_out:
        settings.leave_out(what)
    turned = _cross(model.drones[0]).first
    settings.found["plant.layout"] = "plus" if abs(turned) < math.pi / 8 else "x"
    layout = given.get("plant.layout", settings.found["plant.layout"])
    drones = [_numbers(drone, layout, settings) for drone in model.drones]
    _share(drones, settings)
    if model.carrier is None:
        drones = _repeated(drones[0], count, settings)
    elif count is not None or "plant.drones" in given:
        raise InputError(f"the model is a whole rig of {len(drones)} drones, expected no drones of the file beside it")
    else:
        drones = _placed(drones, model, settings)
    settings.found["plant.drones"] = drones
    _assume_load(drones, model, settings)
    if not any(path.startswith(("attitude.", "autopilot.", "leader.")) for path in given):
        settings.lines.append("assumed attitude and leader: loop and gains of the preset")
    return settings.found, sorted(settings.lines, key=lambda line: line.startswith("warning"))  # warnings are last


class _Cross(NamedTuple):
    """The rotors of a drone, in order of their angle."""

    first: float  # angle of the first rotor from x, -45 to 45 degrees [rad]
    arm: float  # 0: unknown [m]
    middle: np.ndarray  # (2,) mean of their positions [m]
    off: float  # largest distance of a rotor from the corner of the square [m]
    order: np.ndarray  # (4,) indices in the model


def _cross(drone: ModelDrone) -> _Cross:
    if len(drone.rotors) == 1:
        return _Cross(math.pi / 4, 0.0, drone.rigid.centre[:2], 0.0, np.zeros(1, int))
    places = np.array([rotor.place[:2] for rotor in drone.rotors])
    middle = places.mean(axis=0)
    x, y = (places - middle).T
    angles, arm = np.arctan2(y, x), float(np.hypot(x, y).mean())
    first = float(np.angle(np.exp(4j * angles).sum())) / 4
    order = np.argsort((angles - first + math.pi / 4) % (2 * math.pi))
    square = arm * np.column_stack([np.cos(first + QUARTERS), np.sin(first + QUARTERS)])
    off = float(np.linalg.norm((places - middle)[order] - square, axis=1).max())
    if off >= SQUARE * arm:
        shown = ", ".join(f"({x:.3g} {y:.3g})" for x, y in places)
        raise InputError(f"rotors of {_name(drone)} stand at {shown} m, expected the corners of a square")
    return _Cross(first, arm, middle, off, order)


def _name(drone: ModelDrone) -> str:
    return drone.name or "the drone"


def _numbers(drone: ModelDrone, layout: str, settings: _Settings) -> dict[str, Any]:
    """Fields of `config.Drone` that the model gives; the mount is the centre of mass."""
    cross, rigid = _cross(drone), drone.rigid
    rotors = [drone.rotors[number] for number in cross.order]
    turned = cross.first - (math.pi / 4 if layout == "x" else 0.0)
    spins = [rotor.yaw for rotor in rotors if rotor.yaw] if cross.arm else []
    if len(spins) == 4:
        if all(one * other < 0 for one, other in itertools.pairwise(spins)):
            turned += math.pi / 2 if spins[0] < 0 else 0.0
        else:
            signs = " ".join("+" if spin > 0 else "-" for spin in spins)
            settings.lines.append(
                f"warning: yaw gears of {_name(drone)} go {signs} around it, and are taken to go + - + -"
            )
    turned = (turned + math.pi / 2) % math.pi - math.pi / 2
    turned = 0.0 if abs(turned) < 1e-9 else turned
    c, s = math.cos(turned), math.sin(turned)
    axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    inertia = _principal(axes.T @ rigid.inertia @ axes, _name(drone), settings)
    off = float(np.linalg.norm(cross.middle - rigid.centre[:2]))
    for far, what in ((cross.off, "rotors are off a square"), (off, "centre of mass is off the middle of its rotors")):
        if far > SHOWN * cross.arm:
            settings.leave_out(f"{far:.2g} m by which the {what}, of {_name(drone)}")
    forces = [rotor.force_max for rotor in rotors if rotor.force_max is not None]
    lags = [rotor.lag for rotor in rotors if rotor.lag is not None]
    if forces and max(forces) > (1 + SHOWN) * min(forces):
        settings.leave_out(f"force of rotors of {_name(drone)} beyond the {min(forces):.3g} N of the weakest")
    found = {
        "arm": cross.arm,
        "rotor_force_max": min(forces) / (1 if cross.arm else 4) if forces else 0.0,
        "rotor_lag": max(lags, default=0.0),
        "yaw_per_thrust": float(np.mean(np.abs(spins))) if len(spins) == 4 else 0.0,
    }
    fixed = {"mass": rigid.mass, "inertia": inertia, "mount": rigid.centre.tolist(), "yaw": turned}
    return {**fixed, **{name: value for name, value in found.items() if value}}


def _principal(inertia: np.ndarray, name: str, settings: _Settings) -> list[float]:
    """The diagonal of `inertia` (3, 3); large other elements are reported as ignored."""
    beside = float(np.abs(inertia - np.diag(np.diag(inertia))).max())
    if beside > SHOWN * np.trace(inertia):
        settings.leave_out(f"products of inertia of {name}, up to {beside:.2g} kg m2")
    return [float(one) for one in np.diag(inertia)]


def _share(drones: list[dict[str, Any]], settings: _Settings) -> None:
    """Make `SHARED` settings the plant's if the user gave one or all drones agree; assume those of no drone."""
    for name in SHARED:
        known = [drone[name] for drone in drones if name in drone]
        if f"plant.{name}" in settings.given or not known or max(known) - min(known) < 1e-9 * max(known):
            for drone in drones:
                drone.pop(name, None)
        if known:
            settings.found[f"plant.{name}"] = known[0]
    mass = float(np.mean([drone["mass"] for drone in drones]))
    for name, value, why in (
        ("arm", lambda: ARM * mass ** (1 / 3), "0.12 m (mass / kg)^(1/3), since rotors have no places"),
        ("rotor_force_max", lambda: THRUST * mass * settings.number("gravity"), "as strong as the reference pair's"),
        ("rotor_lag", lambda: Plant().rotor_lag, "that of the reference pair"),
        ("yaw_per_thrust", lambda: YAW * settings.number("arm"), "a sixth of the arm, as the reference pair's"),
    ):
        if f"plant.{name}" not in settings.found:
            settings.assume(name, value(), why)


def _repeated(drone: dict[str, Any], count: int | None, settings: _Settings) -> list[Any]:
    """The model's drone at the mounts that the user gave, or on a ring."""
    listed = settings.given.get("plant.drones")
    if isinstance(listed, list):
        if count not in (None, len(listed)):
            raise InputError(f"drones is {count}, expected the {len(listed)} that plant.drones lists")
        return [{**drone, **one} if isinstance(one, dict) else one for one in listed]
    count = 2 if count is None else count
    spacing = SPACING * settings.number("arm")
    radius, angles = spacing / 2 / math.sin(math.pi / count), 2 * math.pi * np.arange(count) / count
    mounts = np.round(radius * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]), 6) + 0.0
    settings.lines.append(f"assumed {count} drones, {spacing:.3g} m from each to the next: 17/6 of the arm")
    if count > 2:
        mass = CARRIER * count * drone["mass"]
        quarter = float(f"{mass * radius**2 / 4:.4g}")
        settings.assume("carrier_mass", float(f"{mass:.4g}"), "a twentieth of the drones'")
        settings.assume("carrier_inertia", [quarter, quarter, 2 * quarter], "of a disc to the mounts")
    return [{**drone, "mount": mount.tolist()} for mount in mounts]


def _placed(drones: list[dict[str, Any]], model: Model, settings: _Settings) -> list[dict[str, Any]]:
    """The drones of a whole rig with mounts from O, the carrier's centre; a pair on a line is sorted, front first."""
    carrier, origin = model.carrier, _origin(model)
    assert carrier is not None
    settings.found["plant.carrier_mass"] = carrier.mass
    if carrier.mass:
        settings.found["plant.carrier_inertia"] = _principal(carrier.inertia, "the carrier", settings)
    for drone in drones:
        drone["mount"] = (np.round(np.subtract(drone["mount"], origin), 9) + 0.0).tolist()
    axis = _axis([drone["mount"] for drone in drones])
    return drones if axis == "xy" else sorted(drones, key=lambda drone: -drone["mount"]["xy".index(axis)])


def _origin(model: Model) -> np.ndarray:
    """O (3,) in the axes of the model: the carrier's centre, or the middle of the drones."""
    if model.carrier is not None and model.carrier.mass:
        return model.carrier.centre
    return np.mean([drone.rigid.centre for drone in model.drones], axis=0)


def _leave_out_of_load(load: Rigid, origin: np.ndarray, settings: _Settings) -> None:
    """Report a load that is not at O, or whose inertia is not that of the plant's ball or box."""
    size = settings.given.get("plant.object_size", settings.found.get("plant.object_size"))
    try:
        x, y, z = (float(edge) for edge in size)
    except (TypeError, ValueError, OverflowError):
        return  # validation refuses it
    place = load.centre - origin
    if np.abs(place).max() > SHOWN * max(x, y, z):
        shown = " ".join(f"{part:.3g}" for part in place + 0.0)
        settings.leave_out(f"place of the load, {shown} m from O, where the carrier's centre is")
    what, taken = "box of plant.object_size", np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    if settings.number("carrier_mass"):
        what, taken = "ball of plant.ball_radius", np.full(3, ROLLING * settings.number("ball_radius") ** 2)
    beside = load.inertia - load.mass * np.diag(taken)
    if np.abs(beside).max() > SHOWN * load.mass * max(*taken):
        own, shown = (" ".join(f"{part:.2g}" for part in one) for one in (np.diag(load.inertia), load.mass * taken))
        settings.leave_out(f"inertia of the load, {own} kg m2: it is taken for a {what}, {shown} kg m2")


def _axis(mounts: list[Any]) -> str:
    """The axis along which two drones are mounted, xy for other plants."""
    across = np.ptp(np.array(mounts, dtype=float)[:, :2], axis=0)
    if len(mounts) > 2 or max(across) < LINE * min(across):
        return "xy"
    return "xy"[int(np.argmax(across))]


def _assume_load(drones: list[Any], model: Model, settings: _Settings) -> None:
    """Assume the object: a bar between two drones on a line, else a plate that reaches to the mounts."""
    try:
        rows = [Drone(**one) for one in drones]
        mounts = [tuple(map(float, row.mount)) for row in rows]
        masses = [float(row.mass) for row in rows]
        forces = [float(row.rotor_force_max or settings.number("rotor_force_max")) for row in rows]
    except (TypeError, ValueError, OverflowError):
        return  # validation refuses it, as mounts that are none
    if not all(len(mount) == 3 and all(map(math.isfinite, mount)) for mount in mounts):
        return
    if model.load is None:
        axis = _axis(mounts)
        settings.assume("cg_axis", axis, "along the drones" if axis != "xy" else "among the drones")
        spare = 4 * sum(forces) / settings.number("gravity") - sum(masses) - settings.number("carrier_mass")
        mass = LOAD * sum(masses) if spare <= 0 else min(LOAD * sum(masses), SPARE * spare)
        why = "a tenth of the drones'" if mass == LOAD * sum(masses) else "a quarter of what they lift besides"
        settings.assume("object_mass", float(f"{mass:.4g}"), why)
    else:
        settings.found["plant.object_mass"], settings.found["plant.cg_axis"] = model.load[0].mass, model.load[1]
    axis = str(settings.given.get("plant.cg_axis", settings.found.get("plant.cg_axis")))
    if len(axis) == 1:
        along = [mount["xy".index(axis) if axis in "xy" else 0] for mount in mounts]
        length = float(np.ptp(along)) or SPACING * settings.number("arm")
        size = [length, WIDTH * length, HEIGHT * length]
        size = size if axis == "x" else [size[1], size[0], size[2]]
    else:
        length = 2 * max(math.hypot(*mount[:2]) for mount in mounts)
        size = [length, length, length / 10]
    settings.assume("object_size", [float(f"{edge:.4g}") for edge in size], "as far as drones stand")
    settings.assume("ball_radius", float(f"{BALL * length:.3g}"), "a seventeenth of the object")
    if model.load is not None:
        _leave_out_of_load(model.load[0], _origin(model), settings)
    furthest = float(f"{AMPLITUDE * length:.3g}")
    settings.assume("scenario.cg_amplitude", [0.0, furthest], "up to 5/34 of the object, as the reference pair's")
