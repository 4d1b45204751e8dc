"""`Scenario`, the settings of one flight, and the checks on it."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import numpy as np

from mjxball.config import Config, ball_limit, cg_limit, range_of
from mjxball.errors import InputError
from mjxball.sim.disturbances import Disturbance, check_disturbance
from mjxball.sim.goals import GoalMotion

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class CgPath:
    """Shape of the CG's path in the plane, see `physics.engine.PathShape`. The default is a sine along body x."""

    direction: float = 0.0  # of the first sine from body x [rad]
    width: float = 0.0  # amplitude of the second sine, across, over that of the first
    ratio: float = 1.0  # angular speed of the second over that of the first
    lead: float = 0.0  # phase of the second [rad]


FASTEST, HEAVIEST = range_of("scenario.cg_speed")[1], range_of("scenario.object_mass")[1]
CIRCLE = CgPath(width=1.0, lead=math.pi / 2)
OF_PLANT: Any = None  # value of a field that is taken from the plant, see `of_plant`
AMPLITUDE, GOAL = 0.05, 1.0  # [m] where the plant allows them
MOVES = {"free": (1.0, 1.0, 1.0), "pivot": (0.0, 0.0, 0.0), "heave": (0.0, 0.0, 1.0)}  # by stand: axes free for O


@dataclass(frozen=True)
class Scenario:
    """One flight from rest at the origin, with rotors at the believed hover thrust, to the goal.

    How the CG moves (sine, waveform, rolling ball) is set by `config.motion`; the parameters of a sine are here. Load
    and goal that are not given are those of the plant (`of_plant`).
    """

    omega: float = 0.31  # angular speed of the CG's sine [rad/s]
    amplitude: float = OF_PLANT  # of the CG's sine [m]
    mass: float = OF_PLANT  # true mass of the object [kg]
    believed_mass: float | None = None  # mass that the hover thrust assumes, None: the true one [kg]
    goal: tuple[float, float, float] = OF_PLANT  # of O [m]
    seconds: float = 45.0
    phase: float = 0.0  # of the CG's sine [rad]
    mass_changes: tuple[tuple[float, float], ...] = ()  # (time [s], mass added or, if negative, dropped [kg])
    path: CgPath = field(default_factory=CgPath)  # of a CG that moves in the plane
    ball_start: float = 0.0  # of a rolling ball from O along the CG axis, in the plane along x [m]
    ball_start_across: float = 0.0  # in the plane along y [m]
    ball_velocity: tuple[float, float] = (0.0, 0.0)  # at the start, along and across [m/s]
    start_position: Vector3 = (0.0, 0.0, 0.0)  # of O [m]
    start_velocity: Vector3 = (0.0, 0.0, 0.0)  # of O [m/s]
    start_tilt: tuple[float, float] = (0.0, 0.0)  # roll, pitch [rad]
    waypoints: tuple[tuple[float, Vector3], ...] = ()  # (time [s], next goal of O [m]), in order
    goal_motion: GoalMotion = field(default_factory=GoalMotion)  # on top of goal and waypoints
    disturbance: Disturbance = field(default_factory=Disturbance)
    thrust: tuple[float, ...] = ()  # factor on every drone's rotor forces; (): 1
    thrust_fade: float = 0.0  # share of all thrust that is lost in a second [1/s]
    lost: tuple[tuple[int, float], ...] = ()  # (number of a drone, time at which its rotors stop [s])
    loop_scale: float = 1.0  # factor on the natural frequency of ideal attitude loops
    rotor_lag_scale: float = 1.0  # factor on the rotors' time constant
    rotor_drag: float = 0.0  # of a drone over its mass [1/s]
    wind: Vector3 = (0.0, 0.0, 0.0)  # velocity of the air, felt by rotor drag [m/s]
    floor: float | None = None  # height of the ground, for ground effect; None: no ground [m]
    download: float = 0.0  # share of its thrust that a rotor above the object loses


def of_plant(config: Config, scenario: Scenario) -> Scenario:
    """`scenario` with load and goal of `config`'s plant where it gives none.

    The mass is the plant's, clipped to the training range. The amplitude is 5 cm, the goal 1 m away on every axis that
    a stand leaves free; both are less where the object or the training range is smaller.
    """
    ranges, plant = config.scenario, config.plant
    distance = min(GOAL, ranges.goal_range)
    defaults: dict[str, Any] = {
        "mass": min(max(plant.object_mass, ranges.object_mass[0]), ranges.object_mass[1]),
        "amplitude": min(AMPLITUDE, cg_limit(plant), ranges.cg_amplitude[1]),
        "goal": tuple(distance * free for free in MOVES[plant.stand]),
    }
    return replace(scenario, **{name: value for name, value in defaults.items() if getattr(scenario, name) is OF_PLANT})


def check_scenario(config: Config, scenario: Scenario) -> Scenario:
    """`scenario` completed by `of_plant`; raises InputError with one sentence if it does not fit the plant."""
    scenario = of_plant(config, scenario)
    if len(scenario.goal) != 3:
        raise InputError(f"goal takes 3 numbers, not {len(scenario.goal)}")
    if not np.isfinite(_flat(astuple(replace(scenario, goal_motion=GoalMotion(until=0.0))))).all():
        raise InputError("every number of a scenario must be finite")
    if scenario.mass <= 0:
        raise InputError(f"mass must be positive, not {scenario.mass:g} kg")
    if not 0 <= (scenario.believed_mass or 0) <= HEAVIEST:
        raise InputError(f"believed mass must be between 0 and {HEAVIEST:g} kg, not {scenario.believed_mass:g}")
    if not 0 <= scenario.omega <= FASTEST:
        raise InputError(f"omega must be between 0 and {FASTEST:g} rad/s, not {scenario.omega:g}")
    if scenario.amplitude < 0:
        raise InputError(f"amplitude must not be negative, but is {scenario.amplitude:g} m")
    left = scenario.mass + np.cumsum([mass for _, mass in sorted(scenario.mass_changes)])
    if (left <= 0).any():
        raise InputError(f"the mass changes would leave {left.min():.3g} kg of object; it must stay positive")
    if any(time < 0 for time, _ in scenario.mass_changes):
        raise InputError("the time of a mass change must not be negative")
    check_disturbance(scenario.disturbance, config.timing.control_period)
    limit, in_plane = cg_limit(config.plant), len(config.plant.directions) == 2
    if not in_plane and (scenario.path != CgPath() or scenario.ball_start_across or scenario.ball_velocity[1]):
        raise InputError(f"a path in the plane needs plant.cg_axis xy; this load moves along {config.plant.cg_axis}")
    reached = scenario.amplitude * max(1.0, abs(scenario.path.width))
    if config.motion.kind == "sine" and reached > limit + 1e-12:
        raise InputError(f"amplitude {reached:g} m leaves the object: the CG reaches {limit:.4g} m")
    ball = math.hypot(scenario.ball_start, scenario.ball_start_across)
    if ball > ball_limit(config.plant) + 1e-12:
        raise InputError(f"ball start {ball:g} m lies beyond the end stop at {ball_limit(config.plant):.4g} m")
    _check_drones(config.plant.count, scenario)
    _check_goals(config, scenario)
    _check_air(config, scenario)
    if scenario.seconds < config.timing.control_period or scenario.seconds > 86_400:
        raise InputError(f"seconds must be between one control period and a day, not {scenario.seconds:g}")
    return scenario


def _check_drones(count: int, scenario: Scenario) -> None:
    if scenario.thrust and (len(scenario.thrust) != count or min(scenario.thrust) < 0):
        raise InputError(f"thrust must be {count} factors that are not negative, one for each drone")
    for number, time in scenario.lost:
        if number != int(number) or not 0 <= number < count or time < 0:
            raise InputError(f"a lost drone must be a number from 0 to {count - 1} with a time, not {number}:{time:g}")


def _check_goals(config: Config, scenario: Scenario) -> None:
    limit = config.scenario.termination_distance
    before = scenario.start_position
    for goal in (scenario.goal, *(place for _, place in scenario.waypoints)):
        far = np.linalg.norm(np.subtract(goal, before))
        if far > limit:
            raise InputError(f"goal {goal} is {far:.3g} m away, beyond d_term = {limit:g} m")
        before = goal
    moves = scenario.goal_motion
    if not np.isfinite((*moves.velocity, moves.radius, moves.speed, moves.phase)).all() or not moves.until >= 0:
        raise InputError("every number of a goal's motion must be finite, and its ramp must end after the start")
    times = [time for time, _ in scenario.waypoints]
    if times != sorted(times) or any(time <= 0 for time in times):
        raise InputError("waypoints must come in order of time, after the start")


def _check_air(config: Config, scenario: Scenario) -> None:
    if min(scenario.loop_scale, scenario.rotor_lag_scale) <= 0:
        raise InputError("loop scale and rotor lag scale must be positive")
    if scenario.loop_scale != 1 and config.autopilot.kind != "ideal":
        raise InputError("loop scale is of ideal attitude loops; a Crazyflie's gains are those of autopilot")
    if min(scenario.rotor_drag, scenario.thrust_fade) < 0:
        raise InputError("rotor drag and thrust fade must not be negative")
    if scenario.thrust_fade * scenario.seconds >= 1:
        raise InputError(f"a thrust fade of {scenario.thrust_fade:g}/s leaves no thrust after {scenario.seconds:g} s")
    if any(scenario.wind) and not scenario.rotor_drag:
        raise InputError("wind acts through rotor drag, which is 0")
    if not 0 <= scenario.download < 1:
        raise InputError(f"download must be at least 0 and below 1, not {scenario.download:g}")


def _flat(value: Any) -> list[float]:
    """All values in nested tuples as floats, without None."""
    if isinstance(value, tuple):
        return [number for part in value for number in _flat(part)]
    return [] if value is None else [float(value)]
