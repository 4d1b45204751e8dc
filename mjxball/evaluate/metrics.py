"""Numbers that describe a flight (definitions: design section 9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjxball.rewards import paper_reward
from mjxball.rollout import Trajectory

RMSE_UNTIL = 20.0  # [s]
PAPER_STEPS = 1000  # of an episode, over which the paper's reward is summed
STEADY_AFTER = 20.0  # [s]
WAYPOINT_SECONDS = 10.0  # [s] after the last waypoint became the goal, before which nothing is steady
SETTLED_WITHIN = 0.02  # of the initial error
NEARLY_SETTLED_WITHIN = 0.10
SATURATED_WITHIN = 1e-6  # of the largest rotor force
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
    settling_time_10: float | None  # the same for 10 % [s]
    paper_return: float | None  # the paper's reward, summed over the first 1000 steps (20 s)
    effort: float | None  # rms deviation of the follower's rotor forces from those at the start, hover [N]
    smoothness: float | None  # rms change of the follower's pitch and roll command from step to step [rad]
    saturation: float | None  # share of all rotors and steps at 0 or the largest force
    failed: bool  # |e_o| beyond d_term, or a value that is not finite


def measure(flight: Trajectory, termination_distance: float, rotor_force_max: float = 5.5) -> Metrics:
    """Metrics of one flight (no batch axis)."""
    error = flight.error
    distance = np.linalg.norm(error, axis=-1)
    failed = bool(flight.diverged) or not np.isfinite(distance).all() or bool((distance > termination_distance).any())
    changed = np.flatnonzero(np.diff(flight.target, axis=0).any(axis=1))
    leg = int(changed[-1]) + 1 if changed.size else 0  # the step at which the last waypoint became the goal
    since = flight.time[leg:] - flight.time[leg]
    steady = flight.time >= max(STEADY_AFTER, flight.time[leg] + WAYPOINT_SECONDS if leg else 0.0) - 1e-9
    peaks = np.abs(error[steady]).max(axis=0) if steady[:-1].any() else [None] * 3
    rotors = flight.rotor_force[:, 1]
    changes = np.diff(flight.follower_command[:, :2], axis=0)
    at_a_limit = (rotors <= SATURATED_WITHIN * rotor_force_max) | (rotors >= (1 - SATURATED_WITHIN) * rotor_force_max)
    difference = flight.follower_command - flight.leader_command
    return Metrics(
        rmse=_number(np.sqrt(np.mean(distance[flight.time <= RMSE_UNTIL + 1e-9] ** 2))),
        settling_time=_settling_time(since, distance[leg:], SETTLED_WITHIN),
        overshoot=_overshoot(flight.position, flight.goal) if leg == 0 else None,
        x_peak=_number(peaks[0]),
        y_peak=_number(peaks[1]),
        z_peak=_number(peaks[2]),
        max_tilt=_number(np.hypot(flight.euler[:, 0], flight.euler[:, 1]).max()),
        action_error=_number(np.sqrt(np.mean(difference**2))),
        settling_time_10=_settling_time(since, distance[leg:], NEARLY_SETTLED_WITHIN),
        paper_return=_number(paper_reward(flight.leader_command, flight.follower_command)[:PAPER_STEPS].sum()),
        effort=_number(np.sqrt(np.mean((rotors - rotors[0]) ** 2))),
        smoothness=_number(np.sqrt(np.mean(changes**2))),
        saturation=_number(at_a_limit.mean()),
        failed=failed,
    )


def _settling_time(time: np.ndarray, distance: np.ndarray, share: float) -> float | None:
    outside = np.flatnonzero(~(distance <= share * distance[0]))
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
