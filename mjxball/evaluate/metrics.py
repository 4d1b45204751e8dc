"""Numbers that describe a flight (definitions: docs/metrics.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjxball.rewards import paper_reward
from mjxball.rollout import Tick, Trajectory

RMSE_UNTIL = 20.0  # [s]
PAPER_STEPS = 1000  # of an episode, over which the paper's reward is summed
STEADY_AFTER = 20.0  # [s]
WAYPOINT_SECONDS = 10.0  # [s] after the last waypoint became the goal, before which nothing is steady
SETTLED_WITHIN, NEARLY_SETTLED_WITHIN = 0.02, 0.10  # of the error at the start of the last leg
SATURATED_WITHIN = 1e-6  # of the largest rotor force
NEVER_WITHIN = 0.1  # [s] of the end: not settled
TINY = 1e-9  # [s]


@dataclass(frozen=True)
class Metrics:
    """Metrics of one flight; None where the flight was too short, never settled, or gave no finite number."""

    rmse: float | None  # root mean square of |e_o| over the first 20 s [m]
    settling_time: float | None  # last time |e_o| exceeds 2 % of its start, None: never settled [s]
    overshoot: float | None  # max over axes of max p_i / goal_i - 1, axes with goal 0 skipped; None with waypoints
    x_peak: float | None  # largest |e_x| at t >= 20 s [m]
    y_peak: float | None  # [m]
    z_peak: float | None  # [m]
    max_tilt: float | None  # largest hypot(roll, pitch) [rad]
    action_error: float | None  # rms over time and (roll, pitch, az) of follower minus leader command
    settling_time_10: float | None  # as settling_time, for 10 % [s]
    paper_return: float | None  # the paper's reward, summed over the first 1000 steps (20 s)
    effort: float | None  # rms deviation of the follower's rotor forces from those at the start, hover [N]
    smoothness: float | None  # rms change of the follower's pitch and roll command from step to step [rad]
    saturation: float | None  # share of the follower's rotors and all steps at 0 or the largest force
    failed: bool  # |e_o| beyond d_term, or a value that is not finite


class Meter:
    """Measures n flights while they fly: `add` every step in order, then `results`."""

    def __init__(self, termination_distance: float, rotor_force_max: float):
        self._limit, self._force_max = termination_distance, rotor_force_max
        self._steps = 0

    def add(self, tick: Tick) -> None:
        """Take one control step of all flights into account."""
        error = tick.target - tick.position
        distance = np.linalg.norm(error, axis=-1)
        rotors, tilts = tick.rotor_force[:, 1], tick.follower_command[:, :2]
        if self._steps == 0:
            self._begin(tick, distance, rotors)
        else:
            self._new_leg(tick, distance)
        early = tick.time <= RMSE_UNTIL + TINY
        self._square += distance**2 if early else 0.0
        self._early += early
        for share, last in self._outside.items():
            last[~(distance <= share * self._initial)] = tick.time
        steady = tick.time >= np.maximum(STEADY_AFTER, self._steady_from) - TINY
        self._peaks = np.where(steady[:, None], np.fmax(self._peaks, np.abs(error)), self._peaks)
        self._steady += steady
        self._furthest = np.fmax(self._furthest, tick.position)
        self._tilt = np.fmax(self._tilt, np.hypot(tick.euler[:, 0], tick.euler[:, 1]))
        self._difference += np.mean((tick.follower_command - tick.leader_command) ** 2, axis=-1)
        if self._steps < PAPER_STEPS:
            self._return += paper_reward(tick.leader_command, tick.follower_command)
        self._effort += np.mean((rotors - self._hover) ** 2, axis=-1)
        self._change += np.mean((tilts - self._tilts) ** 2, axis=-1)
        slack = SATURATED_WITHIN * self._force_max
        self._saturated += np.mean((rotors <= slack) | (rotors >= self._force_max - slack), axis=-1)
        self._failed |= tick.diverged | ~(distance <= self._limit)
        self._tilts, self._target, self._time = tilts, tick.target, tick.time
        self._steps += 1

    def results(self) -> list[Metrics]:
        """Metrics of every flight."""
        with np.errstate(invalid="ignore", divide="ignore"):
            peaks = np.where((self._steady > 1)[:, None], self._peaks, np.nan)
            goal = np.where(self._target == 0, np.nan, self._target)
            over = np.where(self._leg[:, None] > 0, np.nan, self._furthest / goal)
            overshoot = np.fmax.reduce(over, axis=1) - 1
            columns = {
                "rmse": np.sqrt(self._square / self._early),
                "settling_time": self._settled(SETTLED_WITHIN),
                "overshoot": overshoot,
                "x_peak": peaks[:, 0],
                "y_peak": peaks[:, 1],
                "z_peak": peaks[:, 2],
                "max_tilt": self._tilt,
                "action_error": np.sqrt(self._difference / self._steps),
                "settling_time_10": self._settled(NEARLY_SETTLED_WITHIN),
                "paper_return": self._return,
                "effort": np.sqrt(self._effort / self._steps),
                "smoothness": np.sqrt(self._change / max(self._steps - 1, 1)),
                "saturation": self._saturated / self._steps,
            }
        rows = zip(*columns.values(), strict=True)
        named = (dict(zip(columns, map(_number, row), strict=True)) for row in rows)
        return [Metrics(**numbers, failed=bool(failed)) for numbers, failed in zip(named, self._failed, strict=True)]

    def _begin(self, tick: Tick, distance: np.ndarray, rotors: np.ndarray) -> None:
        n = len(distance)
        self._square, self._difference, self._return, self._effort, self._change, self._saturated = np.zeros((6, n))
        self._early, self._steady, self._failed = 0, np.zeros(n, int), np.zeros(n, bool)
        self._initial, self._leg, self._steady_from = distance, np.zeros(n), np.zeros(n)
        self._outside = {share: np.full(n, -np.inf) for share in (SETTLED_WITHIN, NEARLY_SETTLED_WITHIN)}
        self._peaks, self._furthest, self._tilt = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full(n, np.nan)
        self._hover, self._tilts, self._target = rotors, tick.follower_command[:, :2], tick.target

    def _new_leg(self, tick: Tick, distance: np.ndarray) -> None:
        """Where the goal has changed, settling and peaks start again."""
        changed = (tick.target != self._target).any(axis=-1)
        if not changed.any():
            return
        self._initial = np.where(changed, distance, self._initial)
        self._leg = np.where(changed, tick.time, self._leg)
        self._steady_from = np.where(changed, tick.time + WAYPOINT_SECONDS, self._steady_from)
        self._peaks[changed], self._steady[changed] = np.nan, 0
        for last in self._outside.values():
            last[changed] = -np.inf

    def _settled(self, share: float) -> np.ndarray:
        last = self._outside[share]
        settled = np.where(np.isneginf(last), 0.0, last - self._leg)
        return np.where(last >= self._time - NEVER_WITHIN - TINY, np.nan, settled)


def measure(flight: Trajectory, termination_distance: float, rotor_force_max: float = 5.5) -> Metrics:
    """Metrics of one recorded flight (no batch axis)."""
    return measure_batch(flight.batched(), termination_distance, rotor_force_max)[0]


def measure_batch(flights: Trajectory, termination_distance: float, rotor_force_max: float = 5.5) -> list[Metrics]:
    """Metrics of every flight of a recorded batch."""
    meter = Meter(termination_distance, rotor_force_max)
    for number in range(len(flights.time)):
        meter.add(flights.tick(number))
    return meter.results()


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
