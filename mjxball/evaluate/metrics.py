"""Numbers that describe a flight (definitions: design section 9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjxball.rollout import Trajectory

RMSE_UNTIL = 20.0  # [s]
STEADY_AFTER = 20.0  # [s]
SETTLED_WITHIN = 0.02  # of the initial error
NEVER_WITHIN = 0.1  # [s] of the end: not settled


@dataclass(frozen=True)
class Metrics:
    """Metrics of one flight; None where the flight was too short, never settled, or gave no finite number."""

    rmse: float | None  # root mean square of |e_o| over the first 20 s [m]
    settling_time: float | None  # last time |e_o| exceeds 2 % of its start, None: never settled [s]
    overshoot: float | None  # max over axes of max p_i / goal_i - 1, axes with goal 0 skipped
    x_peak: float | None  # largest |e_x| at t >= 20 s [m]
    y_peak: float | None  # [m]
    z_peak: float | None  # [m]
    max_tilt: float | None  # largest hypot(roll, pitch) [rad]
    action_error: float | None  # rms over time and (roll, pitch, az) of follower minus leader command
    failed: bool  # |e_o| beyond d_term, or a value that is not finite


def measure(flight: Trajectory, termination_distance: float) -> Metrics:
    """Metrics of one flight (no batch axis)."""
    error = flight.error
    distance = np.linalg.norm(error, axis=-1)
    failed = bool(flight.diverged) or not np.isfinite(distance).all() or bool((distance > termination_distance).any())
    steady = flight.time >= STEADY_AFTER - 1e-9
    peaks = np.abs(error[steady]).max(axis=0) if flight.time[-1] > STEADY_AFTER + 1e-9 else [None] * 3
    difference = flight.follower_command - flight.leader_command
    return Metrics(
        rmse=_number(np.sqrt(np.mean(distance[flight.time <= RMSE_UNTIL + 1e-9] ** 2))),
        settling_time=_settling_time(flight.time, distance),
        overshoot=_overshoot(flight.position, flight.goal),
        x_peak=_number(peaks[0]),
        y_peak=_number(peaks[1]),
        z_peak=_number(peaks[2]),
        max_tilt=_number(np.hypot(flight.euler[:, 0], flight.euler[:, 1]).max()),
        action_error=_number(np.sqrt(np.mean(difference**2))),
        failed=failed,
    )


def _settling_time(time: np.ndarray, distance: np.ndarray) -> float | None:
    outside = np.flatnonzero(~(distance <= SETTLED_WITHIN * distance[0]))
    if not outside.size:
        return 0.0
    last = float(time[outside[-1]])
    return None if last >= time[-1] - NEVER_WITHIN - 1e-9 else last


def _overshoot(position: np.ndarray, goal: np.ndarray) -> float | None:
    axes = goal != 0
    if not axes.any():
        return None
    return _number((position[:, axes] / goal[axes]).max() - 1)


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None
