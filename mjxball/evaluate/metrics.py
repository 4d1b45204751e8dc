"""Numbers that describe a flight (definitions: docs/metrics.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config, Plant
from mjxball.evaluate.running_metrics import RunningMetrics, begin, update
from mjxball.sim.rollout import Flights, simulate_batch
from mjxball.sim.scenario import Scenario
from mjxball.sim.trajectory import Trajectory

NEVER_WITHIN = 0.1  # [s] of the end: not settled
ROUNDING = 1e-5  # [s] of a time in float32


@dataclass(frozen=True)
class Metrics:
    """Metrics of one flight; None where the flight was too short, never settled, or gave no finite number."""

    rmse: float | None  # root mean square of |e_o| over the first 20 s [m]
    settling_time: float | None  # last time |e_o| exceeds 2 % of its start, None: never settled [s]
    overshoot: float | None  # max over axes of max p_i / goal_i - 1, axes with goal 0 skipped; None with waypoints
    x_peak: float | None  # largest |e_x| at t >= 20 s [m]
    y_peak: float | None  # [m]
    z_peak: float | None  # [m]
    plane_peak: float | None  # largest hypot(e_x, e_y) at t >= 20 s [m]
    max_tilt: float | None  # largest hypot(roll, pitch) [rad]
    action_error: float | None  # rms over time, followers and (roll, pitch, az) of follower minus leader command
    paper_return: float | None  # the paper's reward, summed over the first 1000 steps (20 s)
    effort: float | None  # rms deviation of the followers' rotor forces from those at the start, hover [N]
    smoothness: float | None  # rms change of the followers' pitch and roll commands from step to step [rad]
    saturation: float | None  # share of the followers' rotors and all steps at 0 or the largest force
    rotors_at_limit: float | None  # share of steps in which any rotor is within 1 % of 0 or of its largest force
    rotor_power: float | None  # mean of sum F^1.5 over all rotors, over that at the start, hover
    command_spread: float | None  # rms of the followers' roll and pitch about their mean; None: one follower [rad]
    failed: bool  # |e_o| beyond d_term, or a value that is not finite
    rotor_limit_share: float | None = None  # as rotors_at_limit, of the one rotor that is longest at a limit
    reached: float | None = None  # first time |e_o| is within `radius`, None: never [s]
    arrival: float | None = None  # last time |e_o| exceeds `radius`, None: it does in the end [s]
    late_error: float | None = None  # largest |e_o| after `deadline` [m]

    @property
    def peak(self) -> float:
        """Root of the squared x, y, z peaks [m]; NaN of a flight too short to have them."""
        peaks = [peak for peak in (self.x_peak, self.y_peak, self.z_peak) if peak is not None]
        return math.hypot(*peaks) if len(peaks) == 3 else math.nan

    @property
    def axis_peak(self) -> float:
        """Largest of the x, y, z peaks [m]; inf of a flight that failed."""
        peaks = (peak for peak in (self.x_peak, self.y_peak, self.z_peak) if peak is not None)
        return math.inf if self.failed else max(peaks, default=math.nan)


def results(running: RunningMetrics) -> list[Metrics]:
    """Metrics of every flight."""
    t = RunningMetrics(*(np.asarray(leaf, float) for leaf in running))
    square, difference, returned, effort, change, saturated, limited, power, spread = (t.sums - t.excess).T
    with np.errstate(invalid="ignore", divide="ignore"):
        peaks = np.where((t.steady > 1)[:, None], t.peaks, np.nan)
        goal = np.where(t.target == 0, np.nan, t.target)
        over = np.where(t.leg[:, None] > 0, np.nan, t.furthest / np.abs(goal))
        last = t.time - NEVER_WITHIN - ROUNDING
        settled = np.where(np.isneginf(t.outside), 0.0, t.outside - t.leg)
        settled = np.where(t.outside >= last, np.nan, settled)
        arrival = np.where(np.isnan(t.radius) | (t.beyond >= last), np.nan, np.fmax(t.beyond, 0.0))
        columns = {
            "rmse": np.sqrt(square / t.early),
            "settling_time": settled,
            "overshoot": np.fmax.reduce(over, axis=1) - 1,
            "x_peak": peaks[:, 0],
            "y_peak": peaks[:, 1],
            "z_peak": peaks[:, 2],
            "plane_peak": peaks[:, 3],
            "max_tilt": t.tilt,
            "action_error": np.sqrt(difference / t.steps),
            "paper_return": returned,
            "effort": np.sqrt(effort / t.steps),
            "smoothness": np.sqrt(change / np.maximum(t.steps - 1, 1)),
            "saturation": saturated / t.steps,
            "rotors_at_limit": limited / t.steps,
            "rotor_limit_share": t.limited.max(axis=(-2, -1)) / t.steps,
            "rotor_power": power / t.steps / t.hover_power,
            "command_spread": np.sqrt(spread / t.steps) if t.hover.shape[1] > 1 else spread * np.nan,
            "reached": t.reached,
            "arrival": arrival,
            "late_error": t.late_error,
        }
    rows = zip(*columns.values(), strict=True)
    named = (dict(zip(columns, map(_number, row), strict=True)) for row in rows)
    return [Metrics(**numbers, failed=bool(failed)) for numbers, failed in zip(named, t.failed, strict=True)]


def rotor_limits(plant: Plant, scenarios: Sequence[Scenario]) -> np.ndarray:
    """Largest force (n, N) of a rotor of every drone in each flight [N]; NaN of a drone that is lost in it.

    What a drone gives less than it is asked for (`Scenario.thrust`) lowers its limit; a stopped rotor has none.
    """
    found = np.array([np.array(plant.of_drones("rotor_force_max")) * (s.thrust or 1.0) for s in scenarios])
    for number, scenario in enumerate(scenarios):
        found[number, [drone for drone, _ in scenario.lost]] = np.nan
    return found


def fly_and_measure(
    config: Config,
    flights: Flights,
    physics: str = "mjx",
    radius: Array | float = math.nan,
    deadline: Array | float = math.nan,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Trajectory, list[Metrics]]:
    """Every flight of `simulate_batch`, with its metrics; `radius` and `deadline` as in `begin`."""
    flown, scenarios = simulate_batch(config, flights, physics, progress), [one for _, part in flights for one in part]
    limit, most = config.scenario.termination_distance, rotor_limits(config.plant, scenarios)
    return flown, measure_batch(flown, limit, most, config.plant.leader, radius, deadline)


def measure(
    flight: Trajectory,
    termination_distance: float = 2.5,
    rotor_force_max: Array | float = 5.5,
    leader: int = 0,
    radius: float = math.nan,
    deadline: float = math.nan,
) -> Metrics:
    """Metrics of one recorded flight (no batch axis)."""
    return measure_batch(flight.batched(), termination_distance, rotor_force_max, leader, radius, deadline)[0]


def measure_batch(
    flights: Trajectory,
    termination_distance: float,
    rotor_force_max: Array | float = 5.5,
    leader: int = 0,
    radius: Array | float = math.nan,
    deadline: Array | float = math.nan,
) -> list[Metrics]:
    """Metrics of every flight of a recorded batch; `radius` and `deadline` as in `begin`."""
    first = flights.row(0)
    running = begin(first.position, first.target, first.rotor_force, leader, radius, deadline)
    for number in range(len(flights.time)):
        running = update(running, flights.row(number), termination_distance, rotor_force_max, leader)
    return results(running)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
