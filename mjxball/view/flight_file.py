"""A recorded flight as a file: one `.npz` without pickles. Reading verifies everything it uses; NumPy alone."""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Plant
from mjxball.errors import InputError
from mjxball.policy.file import write_whole

if TYPE_CHECKING:
    from mjxball.sim.rollout import Trajectory

FORMAT = "mjxball flight 1"
MAX_BYTES = 256 * 2**20
# What is shown of a `rollout.Trajectory`, and the shape of a row.
SHAPES: dict[str, tuple[int, ...]] = {
    "time": (),
    "position": (3,),
    "velocity": (3,),
    "euler": (3,),
    "quaternion": (4,),
    "rotor_force": (2, 4),
    "leader_command": (3,),
    "follower_command": (3,),
    "cg_offset": (),
    "object_mass": (),
    "contact_force": (2, 3),
    "target": (3,),
}


@dataclass(frozen=True)
class Flight:
    """One flight of T rows: arrays (T, ...) in SI units, named and laid out as in `rollout.Trajectory`."""

    title: str
    plant: Plant
    arrays: dict[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def flight_of(trajectory: Trajectory, plant: Plant, title: str) -> Flight:
    """A single recorded `trajectory` as a flight."""
    return Flight(title, plant, {name: np.asarray(getattr(trajectory, name), float) for name in SHAPES})


def save_flight(path: str | os.PathLike[str], flight: Flight) -> None:
    """Write `flight` to `path`, whole or not at all."""
    about = {"format": FORMAT, "title": flight.title, "plant": configs.to_dict(flight.plant)}
    stream = BytesIO()
    arrays: dict[str, Any] = {name: array.astype(np.float32) for name, array in flight.arrays.items() if name != "time"}
    np.savez_compressed(stream, about=np.array(json.dumps(about)), time=flight["time"], **arrays)
    write_whole(path, stream.getvalue())


def load_flight(path: str | os.PathLike[str]) -> Flight:
    """Read and verify a flight; raise InputError with one sentence on anything unsound."""
    arrays = _read(str(path))
    try:
        about = json.loads(str(arrays.pop("about")))
        if about["format"] != FORMAT:
            raise ValueError
        title = str(about["title"])
        settings = configs.to_dict(configs.Config())
        plant = configs.from_dict({**settings, "plant": about["plant"]}).plant
    except (KeyError, TypeError, ValueError, RecursionError):
        raise InputError(f"{path} is not a flight that this version reads") from None
    return check_flight(Flight(title[:200], plant, arrays), str(path))


def check_flight(flight: Flight, name: str) -> Flight:
    """`flight` if every array has its shape and is finite and time runs, else InputError."""
    rows = np.shape(flight.arrays.get("time", 0.0))
    if len(rows) != 1 or rows[0] < 2:
        raise InputError(f"{name}: a flight needs a time of at least two rows")
    for field, shape in SHAPES.items():
        array = flight.arrays.get(field)
        if array is None or array.dtype.kind != "f" or array.shape != rows + shape:
            raise InputError(f"{name}: {field} is missing or not of shape {rows + shape}")
        if not np.isfinite(array).all():
            raise InputError(f"{name}: {field} holds a value that is not finite")
    if (np.diff(flight["time"]) <= 0).any():
        raise InputError(f"{name}: time must increase from row to row")
    return Flight(flight.title, flight.plant, {field: flight[field] for field in SHAPES})


def is_flight(path: Path) -> bool:
    """True if `path` looks like a flight's file rather than a policy's."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "about.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def _read(name: str) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(name) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise InputError(f"{name} is not a flight: it unpacks to more than {MAX_BYTES >> 20} MiB")
        with np.load(name, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"flight {name} cannot be read: {error.strerror or error}") from None
    except Exception:  # zipfile, zlib and NumPy raise a dozen kinds for damaged bytes
        raise InputError(f"flight {name} cannot be read: it is damaged or not an .npz") from None
