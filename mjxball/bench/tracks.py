"""The flights of mjxball-bench, version 1. Frozen: a changed value here makes another version.

A draw is the seed of all flights. The leaderboard uses draw 0; other draws are flights that nobody tuned to.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjxball.bench import VERSION
from mjxball.config import Config, cg_limit, preset, with_plant
from mjxball.control.constants import trim_limit
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics, fly_and_measure
from mjxball.plant.teams import ring_config
from mjxball.plant.trim import largest_amplitude, largest_margin
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rigs import rig_config, sample_rigs, unpadded
from mjxball.sim.scenario import CgPath, Scenario

ENGINE = "newton-euler"
SECONDS = 30.0  # of a flight
FLIGHTS = 120  # of a track, undisturbed, and as many disturbed
MARGIN = 0.15  # trim margin of every load, see `plant.trim`
SPEEDS = (0.2, 3.1)  # of the CG [rad/s]
AMPLITUDES = (0.02, 0.17)  # of the pair's CG [m]
MASSES, BELIEVED = (0.1, 0.6), 0.2  # of the pair's object [kg]
TEAMS = (3, 4, 5, 6)  # drones
LOADS = (0.5, 1.5)  # mass of a team's object over that of its plant
DIRECTIONS = tuple((math.cos(angle), math.sin(angle)) for angle in np.pi * np.arange(8) / 8)
RATIOS = (1.0, 1.5, 2.0)  # of both speeds of a path
RIGS, EACH_RIG = (2, 3, 4, 5, 6), 3  # drones of a rig, flights of each rig
RIG_LENGTH = 0.17  # length of the pair, to which criteria in metres refer [m]
NOISE, DELAY, RIG_DELAY = 1.0, 0.04, 0.02  # level, [s], [s] of random rigs
THRUST = (0.985, 1.015)  # factor on the Crazyflies' rotor forces
CRAZYFLIE = {"noise": 0.5, "estimator_drift": 1.0, "delay": 0.03, "quantize": True}
LQGS = ("lqg", "lqg-slow", "lqg-offset-free")  # references: classical followers that know the plant
RIG_LQGS = ("lqg-known-rig", "lqg-slow-known-rig")  # references that know the rig
Pair = tuple[Scenario, Scenario]  # undisturbed, disturbed


@dataclass(frozen=True)
class World:
    """Flights on one plant, and the references that know the plant."""

    config: Config
    scenarios: tuple[Pair, ...]
    references: tuple[str, ...]  # see `mjxball.bench.references`
    # Scenarios of the references where the entrant knows less: undisturbed, disturbed in turn.
    reference_scenarios: tuple[Scenario, ...] = ()
    length: float = 1.0  # factor on criteria in metres

    def fly(self, followers: Sequence[Follower], scenarios: Sequence[Scenario]) -> list[list[Metrics]]:
        """Metrics of every flight of every follower, in float64."""
        _, found = fly_and_measure(self.config, [(follower, scenarios) for follower in followers], ENGINE)
        count = len(scenarios)
        return [found[first : first + count] for first in range(0, len(found), count)]


@dataclass(frozen=True)
class Track:
    """A part of the benchmark with separate results."""

    name: str
    title: str
    worlds: Callable[[int], list[World]]  # of one draw


def _random(draw: int, track: int) -> np.random.Generator:
    return np.random.default_rng([VERSION, track, draw])


def _goal(random: np.random.Generator, reach: float = 1.0) -> tuple[float, float, float]:
    """0.3 to 1 times `reach` away along each axis, either way; overshoot is ill-defined for smaller distances."""
    sides = random.choice([-1.0, 1.0], 3)
    x, y, z = map(float, reach * sides * random.uniform(0.3, 1.0, 3))
    return x, y, z


def _both(scenario: Scenario, random: np.random.Generator, delay: float = DELAY) -> Pair:
    disturbed = Disturbance(noise=NOISE, delay=delay, seed=int(random.integers(2**31)))
    return scenario, replace(scenario, disturbance=disturbed)


def _pair(draw: int, known: bool) -> list[World]:
    config, random, scenarios = preset("paper"), _random(draw, 0 if known else 1), list[Pair]()
    while len(scenarios) < FLIGHTS:
        mass, amplitude = (float(random.uniform(*most)) for most in (MASSES, AMPLITUDES))
        scenario = Scenario(
            omega=float(random.uniform(*SPEEDS)),
            amplitude=amplitude,
            mass=mass,
            phase=float(random.uniform(0, 2 * math.pi)),
            goal=_goal(random),
            seconds=SECONDS,
        )
        if amplitude <= trim_limit(config.plant, mass, MARGIN, mass if known else BELIEVED):
            scenarios.append(_both(scenario, random))
    if known:
        return [World(config, tuple(scenarios), LQGS)]
    blind = tuple(
        (replace(calm, believed_mass=BELIEVED), replace(rough, believed_mass=BELIEVED)) for calm, rough in scenarios
    )
    return [World(config, blind, LQGS, tuple(one for pair in scenarios for one in pair))]


def _team(draw: int) -> list[World]:
    worlds, random, base = [], _random(draw, 2), with_plant(preset("paper"), "team6")
    for size in TEAMS:
        config, scenarios = ring_config(base, size), list[Pair]()
        widest = cg_limit(config.plant)
        while len(scenarios) < FLIGHTS // len(TEAMS):
            mass = config.plant.object_mass * float(random.uniform(*LOADS))
            reach = min(largest_amplitude(config, mass, MARGIN, way) for way in DIRECTIONS)
            width = float(random.uniform(0, 1))
            path = CgPath(
                direction=float(random.uniform(0, 2 * math.pi)),
                width=width,
                ratio=float(random.choice(RATIOS)),
                lead=float(random.uniform(0, 2 * math.pi)),
            )
            scenario = Scenario(
                omega=float(random.uniform(*SPEEDS)),
                amplitude=float(random.uniform(0, 1)) * min(reach, widest) / math.hypot(1, width),
                mass=mass,
                phase=float(random.uniform(0, 2 * math.pi)),
                path=path,
                goal=_goal(random),
                seconds=SECONDS,
            )
            if reach > 0:
                scenarios.append(_both(scenario, random))
        worlds.append(World(config, tuple(scenarios), LQGS))
    return worlds


def _rigs(draw: int) -> list[World]:
    worlds, random, base = [], _random(draw, 3), preset("universal")
    each = FLIGHTS // (EACH_RIG * len(RIGS))  # rigs of a size
    for size in RIGS:
        rigs = unpadded(sample_rigs(base, size, each, 1000 + draw).rigs, size)
        for row in range(each):
            config = rig_config(base, rigs, row)
            scenarios = []
            for _ in range(EACH_RIG):
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
                scenarios.append(_both(scenario, random, RIG_DELAY))
            length = max(1.0, float(rigs.length[row]) / RIG_LENGTH)
            worlds.append(World(config, tuple(scenarios), RIG_LQGS, length=length))
    return worlds


def _crazyflie(draw: int) -> list[World]:
    config, random, scenarios = preset("flight"), _random(draw, 4), list[Pair]()
    ranges = config.scenario
    while len(scenarios) < FLIGHTS:
        scenario = Scenario(
            omega=float(random.uniform(*ranges.cg_speed)),
            amplitude=float(random.uniform(*ranges.cg_amplitude)),
            mass=float(random.uniform(*ranges.object_mass)),
            believed_mass=config.plant.object_mass,
            phase=float(random.uniform(0, 2 * math.pi)),
            goal=_goal(random, ranges.goal_range),
            thrust=tuple(map(float, random.uniform(*THRUST, 2))),
            seconds=SECONDS,
        )
        rough = Disturbance(**CRAZYFLIE, seed=int(random.integers(2**31)))  # type: ignore[arg-type]
        known = scenario.believed_mass, (), False, scenario.thrust
        trims = [largest_margin(config, scenario.mass, side * scenario.amplitude, *known) for side in (-1, 1)]
        if min(trim.margin for trim in trims) >= MARGIN:
            scenarios.append((scenario, replace(scenario, disturbance=rough)))
    return [World(config, tuple(scenarios), LQGS[:1])]


TRACKS: dict[str, Track] = {
    track.name: track
    for track in (
        Track("pair", "pair, mass known", lambda draw: _pair(draw, True)),
        Track("pair-unknown", "pair, mass unknown", lambda draw: _pair(draw, False)),
        Track("team", "teams of 3 to 6", _team),
        Track("rigs", "any rig", _rigs),
        Track("crazyflie", "two Crazyflies", _crazyflie),
    )
}


@functools.cache
def worlds_of(track: str, draw: int) -> list[World]:
    """The worlds of a track for one draw; cached."""
    return TRACKS[track].worlds(draw)
