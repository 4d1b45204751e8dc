"""Logs of a flight or a bench run, resampled for identification: setpoints and measurements of both drones."""

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

STATE = 13  # columns of a drone's state in an .npz: position, velocity, quaternion (w, x, y, z), body rates
OFF_THE_GROUND = 0.03  # [m] height above the start from which on there is no ground contact
STEPS = (5e-4, 0.2)  # [s] plausible period of the rows; anything else has another unit of time
LONGEST_HOLD = 0.4  # [s] oldest usable setpoint; the level-out of the firmware that follows is not modelled


class Log(NamedTuple):
    """A log resampled to the K ticks of the drones' loops, 2 ms apart; axis 1 of size 2 is leader, follower."""

    setpoints: np.ndarray  # (K, 2, 4) roll, pitch [deg], yaw rate [deg/s], thrust, as on the wire, zero-order hold
    climb: np.ndarray  # (K,) vertical velocity of O [m/s]
    euler: np.ndarray  # (K, 3) attitude of the body, mean of both drones [rad]
    rates: np.ndarray  # (K, 3) body rates, mean of both drones [rad/s]
    usable: np.ndarray  # (K,) True: guided flight, off the ground, and both drones' states are known
    every: int  # ticks between two measurements
    remarks: tuple[str, ...] = ()  # warnings for the user, a line each
    stand: str | None = None  # the following four are None if the log does not contain them
    gains: PairGains | None = None
    curves: tuple[CurveName, CurveName] | None = None  # force curves of leader and follower
    volts: float | None = None  # median battery voltage under load


def read_log(path: Path, assumed: Config | None = None) -> Log:
    """Read a log of `mjxfly --log`, or an .npz of time (T,), setpoints (T, 2, 4), states (T, 2, 13).

    `assumed` is the configuration of a log that another program wrote, see `flight_log.read`. Raises InputError.
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
    measured_at: np.ndarray | Sequence[np.ndarray],
    states: Sequence[np.ndarray],
    guided: np.ndarray | None = None,
) -> Log:
    """Resample setpoints (T, 2, 4) at times `sent_at` and both drones' `states` (S, 13) at times `measured_at`.

    `guided` (T,) says at which setpoints the controllers were in command of a flight that starts on the ground; None
    means always, and in the air. Rows that are not finite are left out. Raises ValueError if shapes or values are wrong
    or the clocks of setpoints and states differ.
    """
    times = [measured_at, measured_at] if isinstance(measured_at, np.ndarray) else list(measured_at)
    count = len(sent_at)
    if setpoints.shape != (count, 2, 4) or any(s.shape != (len(t), STATE) for s, t in zip(states, times, strict=True)):
        raise ValueError("shapes do not fit: time (T,), setpoints (T, 2, 4), states (T, 2, 13)")
    if min(count, *map(len, times)) < 2:
        raise ValueError("it holds fewer than two rows")
    kept, remarks = _valid_rows((sent_at, *times), (setpoints, *states))
    sent_at, setpoints = sent_at[kept[0]], setpoints[kept[0]]
    guided = None if guided is None else guided[kept[0]]
    times = [t[rows] for t, rows in zip(times, kept[1:], strict=True)]
    states = [state[rows] for state, rows in zip(states, kept[1:], strict=True)]
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


def _valid_rows(times: Sequence[np.ndarray], series: Sequence[np.ndarray]) -> tuple[list[np.ndarray], tuple[str, ...]]:
    """Return the indices of the valid rows of setpoints and both drones' states, and remarks on the others.

    Valid rows are finite, increase in time, and have unit quaternions. Raises ValueError if fewer than two are left.
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
    """Climb (K,), Euler angles (K, 3) and body rates (K, 3) interpolated at the times `grid` (K,)."""
    quaternion = states[:, 6:10] / np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    euler = np.unwrap(rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion)), axis=0)

    def interpolated(columns: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(grid, time, column) for column in columns.T], axis=1)

    return np.interp(grid, time, states[:, 5]), interpolated(euler), interpolated(states[:, 10:13])


def _within(grid: np.ndarray, gaps: Sequence[Outage]) -> np.ndarray:
    """Return a mask (K,) of the times that lie in one of the `gaps`."""
    inside = np.zeros(len(grid), bool)
    for gap in gaps:
        inside |= (grid > gap.begin) & (grid < gap.end)
    return inside


def _of_flight(flown: FlightLog) -> Log:
    """Resample a flight from the start of its motors, where the integrals of the drones' loops begin."""
    ticks = [one for one in flown.records if one["kind"] == "tick"]
    own = [[one for one in flown.records if one["kind"] == "state" and one["drone"] == name] for name in NAMES]
    guided = np.array([one["state"] == GUIDED for one in ticks])
    if not guided.any():
        raise InputError(f"flight log {flown.path} holds no guided flight: its controllers were never in command")
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
