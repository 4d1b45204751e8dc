"""Recordings of other programs (`log_bags`, `log_cfclient`) as records of the flight log.

Our own bags contain the lines of the log. Any other recording has the states of two drones and the setpoints sent to
them, but neither the rig nor the gains.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.crazyflie import pair_gains
from mjxball.errors import InputError
from mjxfly.limits import NAMES
from mjxfly.log_bags import Found, is_bag, read_bag
from mjxfly.log_cfclient import read_cfclient
from mjxfly.log_consistency import ALIKE, TURNING, known, lag
from mjxfly.log_rows import IMPOSSIBLE, NEEDED, Drone, at, attitude, called, sound
from mjxfly.log_schema import SCHEMA, Record, StatePacket
from mjxfly.log_sources import TOPICS, VARIABLES, Samples
from mjxfly.packets import DroneState
from mjxfly.supervisor import FlightState
from mjxfly.telemetry import Rig

UNKNOWN = "an unknown follower"  # policy name of a flight that another program recorded
MAX_DEVIATION = 0.5  # largest deviation of the drones' relative position from the rig's, over its length


def is_foreign(path: Path) -> bool:
    """Whether `path` is a folder, a bag or a CSV file, so not a file of JSON lines."""
    return path.is_dir() or path.suffix == ".csv" or is_bag(path)


def read(path: Path, remark: Callable[[str], None], assumed: Config | None = None) -> bytes | list[Record]:
    """The lines of our own log in the bag `path`, or records made from another program's recording.

    Rig, firmware and gains of the latter are those of `assumed`, by default the preset flight. `remark` is called with
    notes on the data. Raises InputError with what was found and what was expected.
    """
    config = configs.preset("flight") if assumed is None else assumed
    if path.suffix == ".csv":
        raise InputError(
            f"{path} is CSV, and an export of ours is not read back; expected its .jsonl or .mcap, or of cfclient the "
            "folder of leader and follower"
        )
    if path.is_dir() and any((path / name).is_dir() for name in NAMES):
        pair = _of_cfclient(path, remark)
    else:
        found = read_bag(path, remark)
        if found.lines:
            return found.lines
        pair = _of_bag(path, found, Rig.of_plant(config.plant), remark)
    states = [_states(own, name, remark) for name, own in zip(NAMES, pair, strict=True)]
    remark("it does not say which rig flew: plant and gains are assumed")
    return _records(config, states, [own["sent"] for own in pair])


def _of_cfclient(path: Path, remark: Callable[[str], None]) -> list[Drone]:
    """Leader and follower from cfclient's CSV files, on one clock: both drones have the stick's body rates."""
    pair = list(read_cfclient(path, remark).values())
    for number, (name, own) in enumerate(zip(NAMES, pair, strict=True)):
        lacking = [what for what in (*NEEDED, "rates") if what not in own]
        if lacking:
            wanted = ", ".join(variable for variable, one in VARIABLES.items() if one.quantity == lacking[0])
            raise InputError(f"{path / name} has no {lacking[0]}; expected all numbers of it of {wanted}")
        pair[number] = sound(path, own, name, remark)
    found = lag(pair[0]["rates"], pair[1]["rates"], TURNING)
    if found.alike < ALIKE:
        raise InputError(
            f"{path} is of two clocks: at best the drones' rates agree by {found.alike:.2f}; expected {ALIKE:g} or "
            "more, of two drones on one stick"
        )
    remark(f"the follower's clock is put {-found.at_begin:+.3f} s to the leader's, where their rates agree")
    pair[1] = {name: (found.on_first_clock(times), rows) for name, (times, rows) in pair[1].items()}
    _check_overlap(path, dict(zip(NAMES, pair, strict=True)))
    return pair


def _of_bag(path: Path, found: Found, rig: Rig, remark: Callable[[str], None]) -> list[Drone]:
    """Leader and follower from a bag, by their names, or by their places on the stick."""
    whole = {name: own for name, own in found.series.items() if own.keys() >= set(NEEDED)}
    if whole.keys() >= set(NAMES):
        whole = {name: whole[name] for name in NAMES}
    if len(whole) != 2:
        names = [f"/DRONE/{last} ({TOPICS[last].type})" for last in ("pose", "odom", "cmd_vel_legacy")]
        raise InputError(
            f"bag {path} holds {len(whole)} drones with poses and setpoints; expected two, each with {names[0]} or "
            f"{names[1]}, and {names[2]}; found {found.has}"
        )
    whole = {name: sound(path, own, name, remark) for name, own in whole.items()}
    _check_overlap(path, whole)
    if whole.keys() == set(NAMES):
        return [*whole.values()]
    (one, first), (other, second) = whole.items()
    apart = _from_each_other(first, second)
    sides = [float(np.linalg.norm(sign * apart - rig.span)) for sign in (1.0, -1.0)]
    if min(sides) > MAX_DEVIATION * np.linalg.norm(rig.span):
        raise InputError(
            f"bag {path}: {one} is {_vector_text(apart)} m from {other}; expected {_vector_text(rig.span)}, as leader "
            "and follower are on this rig: name another with --plant, or call the drones so"
        )
    if sides[1] < sides[0]:
        one, first, other, second = other, second, one, first
    remark(f"by their places on the rig {one} is taken for the leader and {other} for the follower")
    return [first, second]


def _vector_text(vector: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in vector)


def _from_each_other(first: Drone, second: Drone) -> np.ndarray:
    """(3,) median position of `first` relative to `second`, in the axes of `first` [m]."""
    time, position = first["position"]
    matrices = rotations.matrix_from_quaternion(attitude(time, first))
    return np.median(np.einsum("nji,nj->ni", matrices, position - at(time, second["position"])), axis=0)


def _check_overlap(path: Path, pair: dict[str, Drone]) -> None:
    """Raise InputError if the series of both drones have no time in common; the battery does not count."""
    spans = {
        f"{called(quantity)} of {name}": (time[0], time[-1])
        for name, own in pair.items()
        for quantity, (time, _) in own.items()
        if quantity != "battery"
    }
    late, early = max(spans, key=lambda one: spans[one][0]), min(spans, key=lambda one: spans[one][1])
    if spans[late][0] >= spans[early][1]:
        raise InputError(
            f"{path}: {late} begins at {spans[late][0]:.1f} s, and {early} ends at {spans[early][1]:.1f} s; expected "
            "them to overlap"
        )


def _states(own: Drone, name: str, remark: Callable[[str], None]) -> list[tuple[float, DroneState]]:
    """(time, state) of one drone at the times of its positions, where all other quantities are known."""
    time, position = own["position"]
    quaternion = attitude(time, own)
    derived = []
    moving = own.get("velocity", own.get("along"))
    if moving is not None:
        velocity = at(time, moving)
    else:
        velocity = np.gradient(position, time, axis=0)
        derived.append("velocities")
    if "rates" in own:
        rates = at(time, own["rates"])
    else:
        change = np.gradient(quaternion, time, axis=0)
        rates = 2 * np.asarray(rotations.multiply_quaternions(rotations.conjugate(quaternion), change))[:, 1:]
        derived.append("rates")
    if derived:
        remark(f"the {name}'s {' and '.join(derived)} are differences of its poses")
    for what, values in (("position", position), ("velocity", velocity), ("rates", rates)):
        if (largest := float(np.abs(values).max())) > IMPOSSIBLE:
            raise InputError(f"the {name}'s {what} reaches {largest:.3g}, expected metres, m/s and rad/s")
    battery = at(time, own["battery"])[:, 0] if "battery" in own else np.full(len(time), np.nan)
    complete = np.logical_and.reduce(
        [known(time, own[what][0]) for what in ("quaternion", "velocity", "along", "rates") if what in own]
    )
    rows = zip(position, velocity, quaternion, rates, battery, strict=True)
    return [
        (float(now), DroneState(*row[:4], 0, float(row[4])))
        for now, row, is_known in zip(time, rows, complete, strict=True)
        if is_known
    ]


def _records(config: Config, states: list[list[tuple[float, DroneState]]], sent: list[Samples]) -> list[Record]:
    """A header, states, and a tick for each setpoint of the leader once the follower has one, all in state FLY."""
    header = {"schema": SCHEMA, "policy": UNKNOWN, "config": config, "gains": pair_gains(config.autopilot)}
    found: list[Record] = []
    for name, own in zip(NAMES, states, strict=True):
        found += [{"t": now, "kind": "state", "drone": name, "raw": StatePacket(0, state)} for now, state in own]
    (times, leader), (others, follower) = sent
    latest = np.searchsorted(others, times, side="right") - 1
    goal = np.full(3, np.nan)
    for now, own, row in zip(times[latest >= 0], leader[latest >= 0], latest[latest >= 0], strict=True):
        setpoints = np.stack([own, follower[row]])
        state = FlightState.FLY if (setpoints[:, 3] > 0).all() else FlightState.DONE
        found.append({"t": float(now), "kind": "tick", "state": state.value, "goal": goal, "sent": setpoints})
    found.sort(key=lambda one: float(one["t"]))
    first, last = found[0]["t"], found[-1]["t"]
    return [{"t": first, "kind": "header", **header}, *found, {"t": last, "kind": "end", "code": 0}]
