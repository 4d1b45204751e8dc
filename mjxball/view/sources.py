"""Where a flight comes from: a file that holds one, or a follower that is flown on the spot."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import preset
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.view.flight_file import Flight, check_flight, flight_of, is_flight, load_flight


def flight_from(source: str, changes: Mapping[str, Any], physics: str) -> Flight:
    """The flight that `source` names.

    A flight file or a flight log is read. A policy file, a run directory (its `policy.npz`) or the name of a classical
    follower is flown through its reference scenario with `changes` to the fields of `Scenario`, on the paper's plant;
    a policy made for Crazyflies on its own. Raises InputError if it is none of these.
    """
    path = Path(source)
    if path.suffix == ".npz" and is_flight(path):
        return load_flight(path)
    if path.is_file() and path.suffix != ".npz":
        return read_log(path)
    return _flown(source, changes, physics)


def read_log(path: Path) -> Flight:
    """The flight in a log of `mjxball.fly`, from where its motors first turned.

    The CG, the object's mass and the contact forces are not in a log: they are 0 and the plant's mass here, and no page
    shows them.
    """
    from mjxball.fly.recording import read_recording

    if path.suffix != ".jsonl":
        raise InputError(f"{path} is no flight (.npz), flight log (.jsonl), policy (.npz) or run directory")
    recording = read_recording(path)
    for remark in recording.remarks:
        print(remark, file=sys.stderr)  # noqa: T201
    rows = len(recording.time)
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(recording.quaternion))
    arrays = {
        "time": recording.time,
        "position": recording.position,
        "velocity": recording.velocity,
        "euler": euler,
        "quaternion": recording.quaternion,
        "rotor_force": recording.rotor_force,
        "leader_command": np.nan_to_num(recording.leader),
        "follower_command": np.nan_to_num(recording.follower),
        "cg_offset": np.zeros(rows),
        "object_mass": np.full(rows, recording.config.plant.object_mass),
        "contact_force": np.zeros((rows, 2, 3)),
        "target": recording.goal,
    }
    title = f"{recording.policy}, flown (ball and contact forces were not measured)"
    return check_flight(Flight(title, recording.config.plant, arrays), str(path))


def _flown(source: str, changes: Mapping[str, Any], physics: str) -> Flight:
    from mjxball.baselines import LAWS, make_baseline
    from mjxball.evaluate.policies import load_policy, native_config
    from mjxball.evaluate.scenarios import REFERENCE, standard_scenarios
    from mjxball.sim.rollout import simulate

    setup, reference, path = preset("paper"), REFERENCE, Path(source)
    if source in LAWS:
        follower: Any = make_baseline(source, setup)
    else:
        file = _policy_file(path)
        native = native_config(file)
        if native is not None:
            setup, reference = native, standard_scenarios(native)[-1]
        follower = load_policy(file, setup)
        follower.name = path.name if path.is_dir() else follower.name
    tuples: Any = {name: tuple(value) if isinstance(value, list) else value for name, value in changes.items()}
    scenario = dataclasses.replace(reference, **tuples)
    flown = simulate(setup, follower, scenario, physics)
    motion = f"CG ±{100 * scenario.amplitude:g} cm at {scenario.omega:g} rad/s"
    if setup.motion.kind == "rolling":
        motion = f"ball from {100 * scenario.ball_start:g} cm"
    return flight_of(flown, setup.plant, f"{follower.name}: {motion}, {scenario.mass:g} kg")


def _policy_file(path: Path) -> Path:
    if path.is_dir():
        if not (path / "policy.npz").exists():
            raise InputError(f"run directory {path} has no policy.npz; python -m mjxball.export makes one")
        return path / "policy.npz"
    if path.suffix == ".npz":
        return path
    from mjxball.baselines import LAWS

    raise InputError(f"{path} is no flight, policy file, run directory or one of {', '.join(LAWS)}")
