"""The tracks of mjxball-bench: plants, and how flights on them are sampled.

A draw is the seed of all flights. The leaderboard uses draw 0; other draws are flights that nobody tuned to. The
conditions have different flights, so that no follower can recognise a calm flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mjxball.bench import CONDITIONS, VERSION
from mjxball.bench.conditions import CRAZYFLIE, OUTDOORS, RIGS_AIR, Air, in_calm, with_disturbances
from mjxball.config import Config, cg_limit, preset, with_plant
from mjxball.control.constants import trim_limit
from mjxball.plant.teams import ring_config
from mjxball.plant.trim import largest_amplitude, largest_margin
from mjxball.sim.goals import GoalMotion
from mjxball.sim.rigs import RigTable, rig_config, sample_rigs, unpadded
from mjxball.sim.scenario import CgPath, Scenario

SECONDS = 30.0  # of a flight
FLIGHTS = 120  # of a track in each condition
RADIUS, CRAZYFLIE_RADIUS, MOVING_RADIUS = 0.010, 0.020, 0.020  # about the goal, calm [m]
DISTURBED_RADIUS = 2.0  # radius of disturbed flights over that of calm ones
RIG_LENGTH = 0.17  # length of a rig up to which the radius is as above [m]
MARGIN = 0.15  # trim margin of every load, see `plant.trim`
SPEEDS = (0.2, 3.1)  # of the CG [rad/s]
AMPLITUDES = (0.02, 0.17)  # of the pair's CG [m]
MASSES, BELIEVED = (0.1, 0.6), 0.2  # of the pair's object [kg]
# Of the Crazyflies' CG [rad/s], [m], object [kg] and goals [m]
CRAZYFLIE_SPEEDS, CRAZYFLIE_AMPLITUDES, CRAZYFLIE_MASSES, CRAZYFLIE_GOALS = (0.2, 1.2), (0.0, 0.02), (0.015, 0.02), 0.5
TEAMS = (3, 4, 5, 6)  # drones
LOADS = (0.5, 1.5)  # mass of a team's object over that of its plant
DIRECTIONS = tuple((math.cos(angle), math.sin(angle)) for angle in np.pi * np.arange(8) / 8)
RATIOS = (1.0, 1.5, 2.0)  # of both speeds of a path
RIGS, EACH_RIG = (2, 3, 4, 5, 6), 3  # drones of a rig, flights of each rig
GOAL_SPEED, CIRCLES = (0.1, 0.5), (0.3, 1.0)  # of goals that move [m/s], radii of their circles [m]
RAMP = (3.0, 15.0)  # ends of ramps [s], in one flight of two
# Samples a flight in a condition; None: its load cannot be trimmed.
Sampler = Callable[[np.random.Generator, str], Scenario | None]


@dataclass(frozen=True)
class PlantFlights:
    """How flights on one plant are sampled.

    `config` is the nominal plant, which followers know; its deviations in a flight are in the scenario.
    """

    config: Config
    sample: Sampler
    count: int = FLIGHTS  # in each condition
    radius: float = RADIUS  # in the condition calm [m]
    moving: bool = False  # whether the goal moves all the time

    def radius_in(self, condition: str) -> float:
        """Radius [m] about the goal within which a flight in `condition` must stay."""
        return self.radius * (DISTURBED_RADIUS if condition == "disturbed" else 1.0)


@dataclass(frozen=True)
class Track:
    """A part of the benchmark with separate results."""

    name: str
    title: str
    flights: Callable[[int], list[PlantFlights]]  # of one draw


def candidate(track: str, draw: int, plant: int, condition: str, number: int, sample: Sampler) -> Scenario | None:
    """Candidate `number` in a condition on one plant of a track: the same whatever other candidates are sampled."""
    place = list(TRACKS).index(track), plant, CONDITIONS.index(condition)
    return sample(np.random.default_rng([VERSION, draw, *place, number]), condition)


def _goal(random: np.random.Generator, distance: float = 1.0) -> tuple[float, float, float]:
    """0.3 to 1 times `distance` away along each axis, either way."""
    sides = random.choice([-1.0, 1.0], 3)
    x, y, z = map(float, distance * sides * random.uniform(0.3, 1.0, 3))
    return x, y, z


def _as_in(
    condition: str, scenario: Scenario, config: Config, random: np.random.Generator, air: Air = OUTDOORS
) -> Scenario:
    return with_disturbances(scenario, config, random, air) if condition == "disturbed" else in_calm(scenario)


def _pair(draw: int, known: bool) -> list[PlantFlights]:
    config = preset("paper")

    def sample(random: np.random.Generator, condition: str) -> Scenario | None:
        mass, amplitude = (float(random.uniform(*most)) for most in (MASSES, AMPLITUDES))
        believed = mass if known else BELIEVED
        if amplitude > trim_limit(config.plant, mass, MARGIN, believed):
            return None
        scenario = Scenario(
            omega=float(random.uniform(*SPEEDS)),
            amplitude=amplitude,
            mass=mass,
            believed_mass=believed,
            phase=float(random.uniform(0, 2 * math.pi)),
            goal=_goal(random),
            seconds=SECONDS,
        )
        return _as_in(condition, scenario, config, random)

    return [PlantFlights(config, sample)]


def _moving(draw: int) -> list[PlantFlights]:
    (pair,) = _pair(draw, True)

    def sample(random: np.random.Generator, condition: str) -> Scenario | None:
        scenario = pair.sample(random, condition)
        return scenario and replace(scenario, goal=(0.0, 0.0, 0.0), goal_motion=_goal_motion(random))

    return [PlantFlights(pair.config, sample, radius=MOVING_RADIUS, moving=True)]


def _goal_motion(random: np.random.Generator) -> GoalMotion:
    """A ramp in any direction, which ends in one flight of two, or a horizontal circle either way."""
    speed = float(random.uniform(*GOAL_SPEED))
    if random.uniform() < 0.5:
        way = random.standard_normal(3)
        x, y, z = map(float, speed * way / np.linalg.norm(way))
        until = float(random.uniform(*RAMP)) if random.uniform() < 0.5 else math.inf
        return GoalMotion((x, y, z), until)
    radius, phase = float(random.uniform(*CIRCLES)), float(random.uniform(0, 2 * math.pi))
    return GoalMotion(radius=radius, speed=float(random.choice([-1.0, 1.0])) * speed / radius, phase=phase)


def _team(draw: int) -> list[PlantFlights]:
    base = with_plant(preset("paper"), "team6")
    configs = [ring_config(base, size) for size in TEAMS]
    each = FLIGHTS // len(TEAMS)
    return [PlantFlights(config, partial(_sample_team, config), each, _radius(config)) for config in configs]


def _radius(config: Config) -> float:
    """That of a plant by its length, the largest distance of a drone from O [m]."""
    return RADIUS * max(1.0, max(math.hypot(*drone.mount) for drone in config.plant.drones) / RIG_LENGTH)


def _sample_team(config: Config, random: np.random.Generator, condition: str) -> Scenario | None:
    mass = config.plant.object_mass * float(random.uniform(*LOADS))
    most = min(largest_amplitude(config, mass, MARGIN, way) for way in DIRECTIONS)
    if most <= 0:
        return None
    width = float(random.uniform(0, 1))
    path = CgPath(
        direction=float(random.uniform(0, 2 * math.pi)),
        width=width,
        ratio=float(random.choice(RATIOS)),
        lead=float(random.uniform(0, 2 * math.pi)),
    )
    scenario = Scenario(
        omega=float(random.uniform(*SPEEDS)),
        amplitude=float(random.uniform(0, 1)) * min(most, cg_limit(config.plant)) / math.hypot(1, width),
        mass=mass,
        phase=float(random.uniform(0, 2 * math.pi)),
        path=path,
        goal=_goal(random),
        seconds=SECONDS,
    )
    return _as_in(condition, scenario, config, random)


def _rigs(draw: int) -> list[PlantFlights]:
    found, base = [], preset("universal")
    each = FLIGHTS // (EACH_RIG * len(RIGS))  # rigs of a size
    for size in RIGS:
        rigs = unpadded(sample_rigs(base, size, each, 1000 + draw).rigs, size)
        for row in range(each):
            config = rig_config(base, rigs, row)
            found.append(PlantFlights(config, partial(_sample_rig, config, rigs, row), EACH_RIG, _radius(config)))
    return found


def _sample_rig(config: Config, rigs: RigTable, row: int, random: np.random.Generator, condition: str) -> Scenario:
    path = CgPath(float(random.uniform(0, 2 * math.pi)), float(random.uniform(0, 1)), 1.0, math.pi / 2)
    scenario = Scenario(
        omega=float(random.uniform(*SPEEDS)),
        amplitude=float(random.uniform(0, rigs.reach[row])),
        mass=float(rigs.object_mass[row]),
        believed_mass=float(rigs.believed_mass[row]),
        thrust=tuple(map(float, rigs.thrust[row])),
        phase=float(random.uniform(0, 2 * math.pi)),
        path=path,
        goal=_goal(random),
        seconds=SECONDS,
    )
    return _as_in(condition, scenario, config, random, RIGS_AIR)


def _crazyflie(draw: int) -> list[PlantFlights]:
    config = preset("flight")
    return [PlantFlights(config, partial(_sample_crazyflie, config), radius=CRAZYFLIE_RADIUS)]


def _sample_crazyflie(config: Config, random: np.random.Generator, condition: str) -> Scenario | None:
    scenario = Scenario(
        omega=float(random.uniform(*CRAZYFLIE_SPEEDS)),
        amplitude=float(random.uniform(*CRAZYFLIE_AMPLITUDES)),
        mass=float(random.uniform(*CRAZYFLIE_MASSES)),
        believed_mass=config.plant.object_mass,
        phase=float(random.uniform(0, 2 * math.pi)),
        goal=_goal(random, CRAZYFLIE_GOALS),
        seconds=SECONDS,
    )
    scenario = _as_in(condition, scenario, config, random, CRAZYFLIE)
    known = scenario.believed_mass, (), False, scenario.thrust or (1.0, 1.0)
    trims = [largest_margin(config, scenario.mass, side * scenario.amplitude, *known) for side in (-1, 1)]
    return scenario if min(trim.margin for trim in trims) >= MARGIN else None


TRACKS: dict[str, Track] = {
    track.name: track
    for track in (
        Track("pair", "pair, mass known", lambda draw: _pair(draw, True)),
        Track("pair-unknown", "pair, mass unknown", lambda draw: _pair(draw, False)),
        Track("team", "teams of 3 to 6", _team),
        Track("rigs", "random rigs", _rigs),
        Track("crazyflie", "two Crazyflies", _crazyflie),
        Track("moving", "pair, goals that move", _moving),
    )
}
