"""Logs of a flight or a bench run, brought to one form: what both drones were sent and what they measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxball.control.crazyflie import PERIOD
from mjxball.errors import InputError
from mjxball.fly import journal, packets

STATE = 13  # numbers of a drone's state in an .npz: position, velocity, quaternion (w, x, y, z), body rates
FLYING = "fly"  # state of the runner in which both laws fly
LONGEST_GAP = 0.2  # [s] without a state before a log is refused


class Log(NamedTuple):
    """A log on the ticks of the drones' loops, 2 ms apart; leader and follower on the axis of size 2."""

    setpoints: np.ndarray  # (K, 2, 4) roll, pitch [deg], yaw rate [deg/s], thrust, as on the wire, held
    climb: np.ndarray  # (K,) vertical velocity of O [m/s]
    euler: np.ndarray  # (K, 3) of the body, the mean of both drones [rad]
    rates: np.ndarray  # (K, 3) likewise [rad/s]
    every: int  # ticks between two measurements


def read_log(path: Path) -> Log:
    """A log of `mjxball.fly --log`, or an .npz of time (T,), setpoints (T, 2, 4), states (T, 2, 13).

    Raises InputError.
    """
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as data:
                arrays = [np.asarray(data[name], float) for name in ("time", "setpoints", "states")]
                return make_log(arrays[0], arrays[1], arrays[0], [arrays[2][:, 0], arrays[2][:, 1]])
        return _of_journal(path)
    except OSError as error:
        raise InputError(f"log {path} cannot be read: {error.strerror or error}") from None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"log {path} is none of mjxball.fly and no .npz of time, setpoints, states: {error}") from None


def make_log(sent_at: np.ndarray, setpoints: np.ndarray, seen_at: Any, states: list[np.ndarray]) -> Log:
    """Bring setpoints (T, 2, 4) at `sent_at` and two drones' `states` (S, 13) at `seen_at` onto the ticks."""
    times = seen_at if isinstance(seen_at, list) else [seen_at, seen_at]
    count = len(sent_at)
    if setpoints.shape != (count, 2, 4) or any(s.shape != (len(t), STATE) for s, t in zip(states, times, strict=True)):
        raise ValueError("shapes do not fit: time (T,), setpoints (T, 2, 4), states (T, 2, 13)")
    if count < 2 or not all(np.isfinite(part).all() for part in (sent_at, setpoints, *states, *times)):
        raise ValueError("numbers are missing or not finite")
    if any((np.diff(t) <= 0).any() or np.diff(t).max() > LONGEST_GAP for t in (sent_at, *times)):
        raise ValueError(f"times do not increase, or leave a gap of more than {LONGEST_GAP:g} s")
    grid = np.arange(max(t[0] for t in (sent_at, *times)), min(t[-1] for t in (sent_at, *times)), PERIOD)
    held = setpoints[np.searchsorted(sent_at, grid + 1e-9, side="right") - 1]
    rows = [_on_grid(grid, t, s) for t, s in zip(times, states, strict=True)]
    climb, euler, rates = (np.mean(parts, axis=0) for parts in zip(*rows, strict=True))
    every = max(1, round(float(np.median(np.diff(times[0]))) / PERIOD))
    return Log(held, climb, euler, rates, every)


def _on_grid(grid: np.ndarray, time: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    quaternion = states[:, 6:10] / np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    euler = np.unwrap(rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion)), axis=0)

    def interpolated(columns: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(grid, time, column) for column in columns.T], axis=1)

    return np.interp(grid, time, states[:, 5]), interpolated(euler), interpolated(states[:, 10:13])


def _of_journal(path: Path) -> Log:
    """The guided part of a flight."""
    sent_at, sent = [], []
    seen: dict[str, tuple[list[float], list[np.ndarray]]] = {"leader": ([], []), "follower": ([], [])}
    for record in journal.read(path):
        if record["kind"] == "tick" and record["state"] == FLYING:
            sent_at.append(float(record["t"]))
            sent.append(record["sent"])
        elif record["kind"] == "state":
            state = packets.unpack_state(bytes.fromhex(record["raw"]))
            times, states = seen[record["drone"]]
            times.append(float(record["t"]))
            states.append(np.concatenate([state.position, state.velocity, state.quaternion, state.rates]))
    if len(sent) < 2 or not all(times for times, _ in seen.values()):
        raise ValueError("it holds no guided flight of two drones")
    both = [(np.array(times), np.array(states)) for times, states in seen.values()]
    spans = [(t > sent_at[0] - LONGEST_GAP) & (t < sent_at[-1] + LONGEST_GAP) for t, _ in both]
    guided = [(t[span], s[span]) for (t, s), span in zip(both, spans, strict=True)]
    return make_log(np.array(sent_at), np.array(sent, float), [t for t, _ in guided], [s for _, s in guided])
