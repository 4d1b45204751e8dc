"""Flights to play, read from a file or simulated.

The file is one `.npz` without pickles; reading verifies everything that it uses.
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
from mjxball.files import write_atomically
from mjxball.policy.container import read_arrays
from mjxball.policy.file import policy_path
from mjxball.reading import check_times, parse_json
from mjxball.terminal import warn

if TYPE_CHECKING:
    from mjxball.sim.scenario import Scenario
    from mjxball.sim.trajectory import Trajectory

FORMAT = "mjxball flight 1"
MAX_BYTES = 256 * 2**20
STEPS = (1e-4, 1.0)  # usual range of the time between two rows [s]
KINDS = ("phase", "fault", "end")  # of marks
LEVELS = ("", "good", "bad")


class Mark(NamedTuple):
    """A mark on the time axis: a phase, which lasts until the next one, a fault, or the end."""

    time: float  # [s]
    kind: str
    text: str
    level: str


def shapes(plant: Plant) -> dict[str, tuple[int, ...]]:
    """Arrays of a `rollout.Trajectory` that the viewer shows, with the shape of a row."""
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

    The array `hidden` (T, [followers,] H), the state of the followers' GRU after each row, is optional.
    """

    title: str
    plant: Plant
    arrays: dict[str, np.ndarray]
    marks: tuple[Mark, ...] = ()  # of a flight on hardware or the twin
    facts: tuple[tuple[str, str], ...] = ()  # names and values of what was measured of a simulated flight

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def flight_of(trajectory: Trajectory, plant: Plant, title: str, hidden: np.ndarray | None = None) -> Flight:
    """A `trajectory` without a batch axis as a flight."""
    arrays = {name: np.asarray(getattr(trajectory, name), float) for name in shapes(plant)}
    return Flight(title, plant, arrays if hidden is None else {**arrays, "hidden": hidden})


def save_flight(path: str | os.PathLike[str], flight: Flight) -> None:
    """Write `flight` to `path` atomically."""
    about = {"format": FORMAT, "title": flight.title, "plant": configs.to_dict(flight.plant), "marks": flight.marks}
    stream = BytesIO()
    arrays: dict[str, Any] = {name: array.astype(np.float32) for name, array in flight.arrays.items() if name != "time"}
    np.savez_compressed(stream, about=np.array(json.dumps(about)), time=flight["time"], **arrays)
    write_atomically(path, stream.getvalue())


def load_flight(path: str | os.PathLike[str]) -> Flight:
    """Read and verify a flight. Raises InputError, with one sentence, if it is invalid."""
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
    """Marks from their values in a flight file. Raises ValueError or TypeError if these are invalid."""
    marks = tuple(Mark(float(t), str(kind), str(text)[:500], str(level)) for t, kind, text, level in values[:1000])
    if any(mark.kind not in KINDS or mark.level not in LEVELS or not abs(mark.time) < 1e9 for mark in marks):
        raise ValueError
    return marks


def check_flight(flight: Flight, name: str) -> Flight:
    """`flight`. Raises InputError unless every array has its shape and is finite, and time increases."""
    rows = np.shape(flight.arrays.get("time", 0.0))
    if len(rows) != 1 or rows[0] < 2:
        raise InputError(f"{name}: a flight needs a time of at least two rows")
    expected = shapes(flight.plant)
    if "hidden" in flight.arrays:
        hidden = np.shape(flight["hidden"])
        expected["hidden"] = (*expected["follower_command"][:-1], hidden[-1] if hidden and hidden[-1] else 1)
    for field, shape in expected.items():
        array = flight.arrays.get(field)
        if array is None or array.dtype.kind != "f" or array.shape != rows + shape:
            raise InputError(f"{name}: {field} is missing or not of shape {rows + shape}")
        if not np.isfinite(array).all():
            raise InputError(f"{name}: {field} holds a value that is not finite")
    try:
        warnings = check_times(flight["time"].tolist(), *STEPS)
    except ValueError as error:
        raise InputError(f"{name}: time must increase from row to row: {error}") from None
    for phrase in warnings:
        warn(f"warning: {name}: {phrase}")
    return dataclasses.replace(flight, arrays={field: flight[field] for field in expected})


def is_flight(path: Path) -> bool:
    """Whether the `.npz` file `path` has the entries of a flight, not of a policy."""
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
    """The flight that `source` names; with `hidden` also the state of its follower's GRU.

    A flight file is read, and a file that is no .npz by `read_other`. A policy file, a run directory (its
    `policy.npz`), the name of a classical follower or the user's module:Class is simulated on its reference scenario,
    with `changes` to fields of `Scenario`. The plant is `plant`, a file or a shipped plant's name; by default the
    paper's, or a Crazyflie policy's. Raises InputError if `source` is none of these, or has no GRU although `hidden`.
    """
    path = Path(source)
    if path.suffix == ".npz" and path.is_file() and is_flight(path):
        flight = load_flight(path)
    elif path.is_file() and path.suffix != ".npz":
        flight = read_other(path)
    else:
        flight = _simulated(source, changes, physics, plant, hidden)
    if hidden and "hidden" not in flight.arrays:
        raise InputError(f"{source} holds no state of a recurrent network that could be shown")
    return flight if hidden else dataclasses.replace(flight, arrays=_without_hidden(flight.arrays))


def _without_hidden(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: array for name, array in arrays.items() if name != "hidden"}


def _simulated(source: str, changes: Mapping[str, Any], physics: str, plant: Path | None, hidden: bool) -> Flight:
    """The simulated flight of the follower `source`, see `flight_from`."""
    from mjxball.baselines import CONTROLLERS
    from mjxball.evaluate.followers import follower_factory
    from mjxball.evaluate.policies import load_policy, native_config
    from mjxball.evaluate.scenarios import standard_scenarios
    from mjxball.sim.rollout import simulate

    setup, path = plant_setup(plant), Path(source)
    tuples: Any = {name: tuple(value) if isinstance(value, list) else value for name, value in changes.items()}
    if source in CONTROLLERS or (":" in source and not path.exists() and path.suffix != ".npz"):
        follower: Any = follower_factory(source, "python -m mjxball.view")[1](setup)
    else:
        file = _policy_file(path)
        native = native_config(file)
        if native is not None and plant is None:
            setup = native
        seconds = tuples.get("seconds", standard_scenarios(setup)[0].seconds)
        follower = load_policy(file, setup, seconds=seconds)
    scenario = dataclasses.replace(standard_scenarios(setup)[0], **tuples)
    if "mass" in changes:
        configs.check_lift(setup, changes["mass"])
    trajectory = simulate(setup, follower, scenario, physics)
    reach = "±" if len(setup.plant.directions) == 1 else "on a circle of "
    motion = f"CG {reach}{100 * scenario.amplitude:g} cm at {scenario.omega:g} rad/s"
    if setup.motion.kind == "rolling":
        motion = f"ball from {100 * scenario.ball_start:g} cm"
    states = _hidden_states(follower, trajectory.observation) if hidden else None
    flight = flight_of(trajectory, setup.plant, f"{follower.name}: {motion}, {scenario.mass:g} kg", states)
    return dataclasses.replace(flight, facts=_facts(setup, trajectory, scenario))


def _facts(setup: configs.Config, trajectory: Trajectory, scenario: Scenario) -> tuple[tuple[str, str], ...]:
    """What was measured of a simulated flight, as the viewer shows it."""
    from mjxball.evaluate.metrics import measure_batch, rotor_limits
    from mjxball.evaluate.running_metrics import STEADY_AFTER

    limits, leader = rotor_limits(setup.plant, [scenario]), setup.plant.leader
    (found,) = measure_batch(trajectory.batched(), setup.scenario.termination_distance, limits, leader)
    if found.failed:
        return (("flight", "failed"),)
    settled = "never" if found.settling_time is None else f"{found.settling_time:.2f} s"
    error = np.linalg.norm(trajectory.target - trajectory.position, axis=-1)[trajectory.time >= STEADY_AFTER]
    late = (("largest error from 20 s on", f"{1e3 * error.max():.1f} mm"),) if error.size else ()
    return (("settles", settled), *late, ("rotor at its limit", f"{100 * (found.rotors_at_limit or 0):.1f} %"))


def _hidden_states(follower: Any, observations: np.ndarray) -> np.ndarray | None:
    """The state (T, [followers,] H) of the GRU of `follower` after each of `observations`; None without a GRU."""
    rows = []
    if hasattr(follower, "hidden"):
        follower.reset()
        for observation in observations:
            follower(observation)
            rows.append(follower.hidden)
    return np.array(rows, float) if rows and rows[0] is not None else None


def _policy_file(path: Path) -> Path:
    """The policy file that `path` names: a file, a shipped policy's name, or a run directory. Raises InputError."""
    path = policy_path(path)
    if path.is_dir():
        if not (path / "policy.npz").exists():
            raise InputError(f"run directory {path} has no policy.npz; python -m mjxball.export makes one")
        return path / "policy.npz"
    if path.suffix == ".npz":
        return path
    from mjxball.baselines import CONTROLLERS

    raise InputError(
        f"{path} is no flight, policy file, run directory, module:Class or one of {', '.join(CONTROLLERS)}"
    )
