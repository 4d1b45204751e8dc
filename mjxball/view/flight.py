"""A flight to play: recorded in a file, or flown on the spot.

The file is one `.npz` without pickles; reading verifies everything it uses.
"""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball import config as configs
from mjxball.cli import plant_setup
from mjxball.config import Plant
from mjxball.errors import InputError
from mjxball.files import write_whole
from mjxball.policy.container import read_arrays
from mjxball.policy.file import policy_path
from mjxball.reading import check_times, parse_json
from mjxball.terminal import warn

if TYPE_CHECKING:
    from mjxball.sim.trajectory import Trajectory

FORMAT = "mjxball flight 1"
MAX_BYTES = 256 * 2**20
STEPS = (1e-4, 1.0)  # [s] between two rows, as a rule
KINDS = ("phase", "fault", "end")  # of marks
LEVELS = ("", "good", "bad")


class Mark(NamedTuple):
    """Something on the time axis: a phase, which lasts until the next one, a fault, or the end."""

    time: float  # [s]
    kind: str
    text: str
    level: str


def shapes(plant: Plant) -> dict[str, tuple[int, ...]]:
    """What is shown of a `rollout.Trajectory`, and the shape of a row."""
    drones, followers = plant.count, plant.count - 1
    return {
        "time": (),
        "position": (3,),
        "velocity": (3,),
        "euler": (3,),
        "quaternion": (4,),
        "rotor_force": (drones, 4),
        "leader_command": (3,),
        "follower_command": (3,) if followers == 1 else (followers, 3),
        "cg_offset": () if len(plant.directions) == 1 else (2,),
        "object_mass": (),
        "contact_force": (drones, 3),
        "target": (3,),
    }


@dataclass(frozen=True)
class Flight:
    """One flight of T rows: arrays (T, ...) in SI units, named and laid out as in `rollout.Trajectory`.

    `hidden` (T, [followers,] H), the state of the followers' GRU after each row, is there if it was asked for.
    """

    title: str
    plant: Plant
    arrays: dict[str, np.ndarray]
    marks: tuple[Mark, ...] = ()  # of a flight that was really flown

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def flight_of(trajectory: Trajectory, plant: Plant, title: str, hidden: np.ndarray | None = None) -> Flight:
    """A single recorded `trajectory` as a flight."""
    arrays = {name: np.asarray(getattr(trajectory, name), float) for name in shapes(plant)}
    return Flight(title, plant, arrays if hidden is None else {**arrays, "hidden": hidden})


def save_flight(path: str | os.PathLike[str], flight: Flight) -> None:
    """Write `flight` to `path`, whole or not at all."""
    about = {"format": FORMAT, "title": flight.title, "plant": configs.to_dict(flight.plant), "marks": flight.marks}
    stream = BytesIO()
    arrays: dict[str, Any] = {name: array.astype(np.float32) for name, array in flight.arrays.items() if name != "time"}
    np.savez_compressed(stream, about=np.array(json.dumps(about)), time=flight["time"], **arrays)
    write_whole(path, stream.getvalue())


def load_flight(path: str | os.PathLike[str]) -> Flight:
    """Read and verify a flight; raise InputError with one sentence on anything unsound."""
    arrays: dict[str, Any] = dict(read_arrays(str(path), "flight", MAX_BYTES))
    try:
        about = parse_json(str(arrays.pop("about")))
        if about["format"] != FORMAT:
            raise ValueError
        title = str(about["title"])
        plant = configs.from_record({"plant": about["plant"]}).plant
        marks = read_marks(about.get("marks", []))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        raise InputError(f"{path} is not a flight that this version reads") from None
    return check_flight(Flight(title[:200], plant, arrays, marks), str(path))


def read_marks(values: Any) -> tuple[Mark, ...]:
    """Marks as a flight file has them. Raises ValueError or TypeError if they are none."""
    marks = tuple(Mark(float(t), str(kind), str(text)[:500], str(level)) for t, kind, text, level in values[:1000])
    if any(mark.kind not in KINDS or mark.level not in LEVELS or not abs(mark.time) < 1e9 for mark in marks):
        raise ValueError
    return marks


def check_flight(flight: Flight, name: str) -> Flight:
    """`flight` if every array has its shape and is finite and time runs, else InputError."""
    rows = np.shape(flight.arrays.get("time", 0.0))
    if len(rows) != 1 or rows[0] < 2:
        raise InputError(f"{name}: a flight needs a time of at least two rows")
    wanted = shapes(flight.plant)
    if "hidden" in flight.arrays:
        own = np.shape(flight["hidden"])
        wanted["hidden"] = (*wanted["follower_command"][:-1], own[-1] if own and own[-1] else 1)
    for field, shape in wanted.items():
        array = flight.arrays.get(field)
        if array is None or array.dtype.kind != "f" or array.shape != rows + shape:
            raise InputError(f"{name}: {field} is missing or not of shape {rows + shape}")
        if not np.isfinite(array).all():
            raise InputError(f"{name}: {field} holds a value that is not finite")
    try:
        told = check_times(flight["time"].tolist(), *STEPS)
    except ValueError as error:
        raise InputError(f"{name}: time must increase from row to row: {error}") from None
    for phrase in told:
        warn(f"warning: {name}: {phrase}")
    return dataclasses.replace(flight, arrays={field: flight[field] for field in wanted})


def is_flight(path: Path) -> bool:
    """True if `path` looks like a flight's file rather than a policy's."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "about.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def _unknown(path: Path) -> Flight:
    raise InputError(f"{path} is no flight (.npz), policy (.npz) or run directory; mjxfly.view plays flight logs")


def flight_from(
    source: str,
    changes: Mapping[str, Any],
    physics: str,
    plant: Path | None = None,
    hidden: bool = False,
    read_other: Callable[[Path], Flight] = _unknown,
) -> Flight:
    """The flight that `source` names; with `hidden`, what its follower's GRU remembers as well.

    A flight file is read, and any file that is no .npz by `read_other`. A policy file, a run directory (its
    `policy.npz`), the name of a classical follower or module:Class, one's own, is flown through its reference scenario
    with `changes` to the fields of `Scenario`, on the paper's plant; a policy made for Crazyflies on its own; or on
    `plant`, a plant file or a shipped one's name. Raises InputError if it is none of these, or has no GRU where its
    state is asked for.
    """
    path = Path(source)
    if path.suffix == ".npz" and path.is_file() and is_flight(path):
        found = load_flight(path)
    elif path.is_file() and path.suffix != ".npz":
        found = read_other(path)
    else:
        found = _flown(source, changes, physics, plant, hidden)
    if hidden and "hidden" not in found.arrays:
        raise InputError(f"{source} holds no state of a recurrent network that could be shown")
    return found if hidden else dataclasses.replace(found, arrays=_without_hidden(found.arrays))


def _without_hidden(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: array for name, array in arrays.items() if name != "hidden"}


def _flown(source: str, changes: Mapping[str, Any], physics: str, plant: Path | None, hidden: bool) -> Flight:
    from mjxball.baselines import LAWS
    from mjxball.evaluate.followers import find_follower
    from mjxball.evaluate.policies import load_policy, native_config
    from mjxball.evaluate.scenarios import standard_scenarios
    from mjxball.sim.rollout import simulate

    setup, path = plant_setup(plant), Path(source)
    tuples: Any = {name: tuple(value) if isinstance(value, list) else value for name, value in changes.items()}
    if source in LAWS or (":" in source and not path.exists() and path.suffix != ".npz"):
        follower: Any = find_follower(source, "python -m mjxball.view")[1](setup)
    else:
        file = _policy_file(path)
        native = native_config(file)
        if native is not None and plant is None:
            setup = native
        seconds = tuples.get("seconds", standard_scenarios(setup)[0].seconds)
        follower = load_policy(file, setup, seconds=seconds)
        follower.name = path.name if path.is_dir() else follower.name
    scenario = dataclasses.replace(standard_scenarios(setup)[0], **tuples)
    if "mass" in changes:
        configs.check_lift(setup, changes["mass"])
    flown = simulate(setup, follower, scenario, physics)
    reach = "±" if len(setup.plant.directions) == 1 else "on a circle of "
    motion = f"CG {reach}{100 * scenario.amplitude:g} cm at {scenario.omega:g} rad/s"
    if setup.motion.kind == "rolling":
        motion = f"ball from {100 * scenario.ball_start:g} cm"
    remembered = _remembered(follower, flown.observation) if hidden else None
    return flight_of(flown, setup.plant, f"{follower.name}: {motion}, {scenario.mass:g} kg", remembered)


def _remembered(follower: Any, observations: np.ndarray) -> np.ndarray | None:
    """The state (T, [followers,] H) of the GRU of `follower` after each of `observations`; None if it has none."""
    rows = []
    if hasattr(follower, "hidden"):
        follower.reset()
        for seen in observations:
            follower(seen)
            rows.append(follower.hidden)
    return np.array(rows, float) if rows and rows[0] is not None else None


def _policy_file(path: Path) -> Path:
    path = policy_path(path)
    if path.is_dir():
        if not (path / "policy.npz").exists():
            raise InputError(f"run directory {path} has no policy.npz; python -m mjxball.export makes one")
        return path / "policy.npz"
    if path.suffix == ".npz":
        return path
    from mjxball.baselines import LAWS

    raise InputError(f"{path} is no flight, policy file, run directory, module:Class or one of {', '.join(LAWS)}")
