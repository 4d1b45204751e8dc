"""The two conditions of a flight: calm, with constant errors of the sensors alone, and disturbed, as drones fly.

Levels come from public flights with motion capture (`benchmarks/sensor_levels.py`) and from published figures.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from mjxball.config import Config, Range
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario

NOISE, DRIFT = (0.5, 2.0), (0.5, 1.5)  # levels: of one drone and estimator to another
OFFSET = 1.0  # level, in both conditions
DELAY = 0.06  # the longest, a radio's way there and back with motion capture [s]
POSE_LAG = (0.0, 0.03)  # a position behind the gyro: 13 to 23 ms found [s]
GAP_RATE = (0.0, 0.25)  # 11 to 22 a minute found [1/s]
JITTER = (0.0, 0.005)  # of a laptop's period [s]
THRUST = (0.95, 1.05)  # of a drone, as 2.5 % between flights of one and its propellers leave
# rms of the wind's speed over its mean. Near the ground 0.2 with a length of 8 times the height (Dryden): at 1 m above
# 1 rad/s as rough as 0.1 with the 1 s of `GUST_TIME`.
GUST = 0.1


@dataclass(frozen=True)
class Air:
    """Ranges of what differs between kinds of drones."""

    drag: Range = (0.1, 0.5)  # Foerster 2015: 0.24; Faessler et al. 2018: 0.39 and 0.54 [1/s]
    wind: Range = (0.0, 2.0)  # outdoors, a light breeze [m/s]
    fade: Range = (0.0, 0.001)  # [1/s]
    download: Range = (0.0, 0.1)  # a V-22 in hover loses a tenth of its whole thrust
    clearance: Range = (0.06, 1.0)  # of the lower of start and goal above the ground, in one flight of two [m]
    loops: Range = (6.0, 20.0)  # of roll: gains of PX4 and Crazyflies 6, flights of a Crazyflie 6 to 9 [rad/s]
    quantized: bool = False


OUTDOORS = Air()
RIGS_AIR = dataclasses.replace(OUTDOORS, loops=(0.0, 0.0))  # random rigs have loops of 4 to 20 rad/s
CRAZYFLIE = Air((0.25, 0.45), (0.0, 0.3), (0.0, 0.002), (0.0, 0.1), (0.02, 1.0), (0.0, 0.0), True)


def in_calm(scenario: Scenario) -> Scenario:
    """`scenario` with constant errors of each drone's sensors."""
    return dataclasses.replace(scenario, disturbance=Disturbance(offset=OFFSET))


def with_disturbances(scenario: Scenario, config: Config, random: np.random.Generator, air: Air = OUTDOORS) -> Scenario:
    """`scenario` as drones fly: sensors, air, attitude loops and thrusts sampled for the flight.

    `scenario.thrust`, if given, stays; attitude loops stay those of `config` where `air.loops` is 0.
    """

    def between(ends: Range) -> float:
        return float(random.uniform(*ends))

    period, count = config.timing.control_period, config.plant.count
    drag, speed, way = between(air.drag), between(air.wind), between((0.0, 2.0 * math.pi))
    masses = sum(drone.mass for drone in config.plant.drones)
    lowest = min(0.0, scenario.goal[2])
    own = config.attitude.natural_frequency[0]
    loops = math.exp(between((math.log(air.loops[0]), math.log(air.loops[1])))) if air.loops[0] else own
    disturbance = Disturbance(
        noise=between(NOISE),
        delay=period * int(random.integers(round(DELAY / period) + 1)),
        gust=drag * masses * GUST * speed,
        gust_seed=int(random.integers(2**31)),
        estimator_drift=between(DRIFT),
        quantize=air.quantized,
        offset=OFFSET,
        pose_lag=between(POSE_LAG),
        gap_rate=between(GAP_RATE),
        jitter=min(between(JITTER), 0.5 * period),
    )
    return dataclasses.replace(
        scenario,
        disturbance=disturbance,
        thrust=scenario.thrust or tuple(map(float, random.uniform(*THRUST, count))),
        thrust_fade=between(air.fade),
        loop_scale=loops / own,
        rotor_drag=drag,
        wind=(speed * math.cos(way), speed * math.sin(way), 0.0),
        floor=lowest - between(air.clearance) if random.uniform() < 0.5 else None,
        download=between(air.download),
    )
