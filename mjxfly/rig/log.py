"""Logs of a flight or a bench run, brought to one form: what both drones were sent and what they measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.crazyflie import PERIOD, PairGains
from mjxball.errors import InputError
from mjxball.policy.container import read_arrays
from mjxball.reading import check_times, following
from mjxfly.limits import NAMES
from mjxfly.log_consistency import UNEVEN, faults
from mjxfly.recording import GUIDED, FlightLog, Outage, load, numbers, outages
from mjxfly.setpoints import CurveName

STATE = 13  # numbers of a drone's state in an .npz: position, velocity, quaternion (w, x, y, z), body rates
OFF_THE_GROUND = 0.03  # [m] above the start of a flight from which on nothing touches the pair
STEPS = (5e-4, 0.2)  # [s] between two rows, as a rule: what is slower or faster is in another unit
LONGEST_HOLD = 0.4  # [s] without a setpoint after which what the firmware does is not what is modelled


class Log(NamedTuple):
    """A log on the ticks of the drones' loops, 2 ms apart; leader and follower on the axis of size 2."""

    setpoints: np.ndarray  # (K, 2, 4) roll, pitch [deg], yaw rate [deg/s], thrust, as on the wire, held
    climb: np.ndarray  # (K,) vertical velocity of O [m/s]
    euler: np.ndarray  # (K, 3) of the body, the mean of both drones [rad]
    rates: np.ndarray  # (K, 3) likewise [rad/s]
    usable: np.ndarray  # (K,) True: guided flight, off the ground, and both drones' states are known
    every: int  # ticks between two measurements
    remarks: tuple[str, ...] = ()  # what was left out, or should be known, a line each
    stand: str | None = None  # of the rig that flew, as its log has it
    gains: PairGains | None = None  # that were flown, likewise
    curves: tuple[CurveName, CurveName] | None = None  # of leader's and follower's firmware, likewise
    volts: float | None = None  # of the batteries under load, the median; None: not measured


def read_log(path: Path, assumed: Config | None = None) -> Log:
    """A log of `mjxfly --log`, or an .npz of time (T,), setpoints (T, 2, 4), states (T, 2, 13).

    What another program logged is of the rig `assumed`, see `flight_log.read`. Raises InputError.
    """
    if path.suffix != ".npz":
        return _of_flight(load(path, assumed))
    try:
        data = read_arrays(str(path), "log")
        arrays = [np.asarray(data[name], float) for name in ("time", "setpoints", "states")]
        return make_log(arrays[0], arrays[1], arrays[0], [arrays[2][:, 0], arrays[2][:, 1]])
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"log {path} is no .npz of time, setpoints, states: {error}") from None


def make_log(
    sent_at: np.ndarray,
    setpoints: np.ndarray,
    seen_at: np.ndarray | Sequence[np.ndarray],
    states: Sequence[np.ndarray],
    guided: np.ndarray | None = None,
) -> Log:
    """Bring setpoints (T, 2, 4) at `sent_at` and two drones' `states` (S, 13) at `seen_at` onto the ticks.

    `guided` (T,) says at which setpoints of a flight, which starts on the ground, the laws were in command; if it is
    not given, they always were, in the air. Rows with numbers that are none are missing. Raises ValueError if the
    arrays are unsound, or of clocks that differ.
    """
    times = [seen_at, seen_at] if isinstance(seen_at, np.ndarray) else list(seen_at)
    count = len(sent_at)
    if setpoints.shape != (count, 2, 4) or any(s.shape != (len(t), STATE) for s, t in zip(states, times, strict=True)):
        raise ValueError("shapes do not fit: time (T,), setpoints (T, 2, 4), states (T, 2, 13)")
    if min(count, *map(len, times)) < 2:
        raise ValueError("it holds fewer than two rows")
    kept, remarks = _kept((sent_at, *times), (setpoints, *states))
    sent_at, setpoints = sent_at[kept[0]], setpoints[kept[0]]
    guided = None if guided is None else guided[kept[0]]
    times = [t[own] for t, own in zip(times, kept[1:], strict=True)]
    states = [rows[own] for rows, own in zip(states, kept[1:], strict=True)]
    flown = slice(None) if guided is None else guided
    for fault in faults((sent_at[flown], setpoints[flown]), list(zip(times, states, strict=True))):
        raise ValueError(fault)
    grid = np.arange(max(t[0] for t in (sent_at, *times)), min(t[-1] for t in (sent_at, *times)), PERIOD)
    latest = np.searchsorted(sent_at, grid + 1e-9, side="right") - 1
    rows = [_on_grid(grid, t, s) for t, s in zip(times, states, strict=True)]
    climb, euler, rates = (np.mean(parts, axis=0) for parts in zip(*rows, strict=True))
    every = max(1, round(float(np.median(np.diff(times[0]))) / PERIOD))
    usable = grid - sent_at[latest] < LONGEST_HOLD
    if guided is not None:
        height = np.mean([np.interp(grid, t, s[:, 2] - s[0, 2]) for t, s in zip(times, states, strict=True)], axis=0)
        usable &= guided[latest] & (height > OFF_THE_GROUND)
    found = [gap for name, t, s in zip(NAMES, times, states, strict=True) for gap in outages(name, t, s, t[-1])]
    return Log(setpoints[latest], climb, euler, rates, usable & ~_within(grid, found), every, remarks)


def _kept(times: Sequence[np.ndarray], series: Sequence[np.ndarray]) -> tuple[list[np.ndarray], tuple[str, ...]]:
    """Of setpoints and both drones' states the rows that are whole, in the order of time, and what is missing.

    Raises ValueError if too little is left.
    """
    kept, remarks = [], []
    for name, time, rows in zip(("setpoints", *NAMES), times, series, strict=True):
        whole = np.isfinite(time) & np.isfinite(rows.reshape(len(rows), -1)).all(axis=1)
        if name in NAMES:
            whole &= np.abs(np.linalg.norm(rows[:, 6:10], axis=1) - 1) <= UNEVEN
        found = np.flatnonzero(whole)
        if len(found) < 2:
            raise ValueError("numbers are missing or not finite")
        try:
            found = found[following(time[found].tolist())]
            check_times(time[found].tolist(), *STEPS)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        if lost := len(time) - len(found):
            remarks.append(f"{lost} rows of its {name} are missing")
        kept.append(found)
    return kept, tuple(remarks)


def _on_grid(grid: np.ndarray, time: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    quaternion = states[:, 6:10] / np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    euler = np.unwrap(rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion)), axis=0)

    def interpolated(columns: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(grid, time, column) for column in columns.T], axis=1)

    return np.interp(grid, time, states[:, 5]), interpolated(euler), interpolated(states[:, 10:13])


def _within(grid: np.ndarray, gaps: Sequence[Outage]) -> np.ndarray:
    """(K,) whether each time lies in one of the `gaps`."""
    inside = np.zeros(len(grid), bool)
    for gap in gaps:
        inside |= (grid > gap.begin) & (grid < gap.end)
    return inside


def _of_flight(flown: FlightLog) -> Log:
    """A flight from where its motors turn, since the integrals that it is flown with begin there."""
    ticks = [one for one in flown.records if one["kind"] == "tick"]
    own = [[one for one in flown.records if one["kind"] == "state" and one["drone"] == name] for name in NAMES]
    guided = np.array([one["state"] == GUIDED for one in ticks])
    if not guided.any():
        raise InputError(f"flight log {flown.path} holds no guided flight: its laws were never in command")
    try:
        log = make_log(
            np.array([one["t"] for one in ticks]),
            np.array([one["sent"] for one in ticks]),
            [np.array([one["t"] for one in rows]) for rows in own],
            [np.array([numbers(one["raw"].state) for one in rows]) for rows in own],
            guided,
        )
    except ValueError as error:
        raise InputError(f"flight log {flown.path} cannot be used: {error}") from None
    volts = [one["raw"].state.battery for rows in own for one in rows]
    return log._replace(
        remarks=(*flown.remarks, *log.remarks),
        stand=flown.config.plant.stand,
        gains=flown.setup.gains,
        curves=flown.setup.curves,
        volts=None if np.isnan(volts).any() else float(np.median(volts)),
    )
