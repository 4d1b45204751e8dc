"""Random rigs for training: rings of several team sizes, padded to the largest, and rigs with scaled parameters."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Attitude, Config, Plant
from mjxball.plant.parameters import AttitudeGains, PlantParameters, design_gains, plant_parameters, rigid_inertia

LOSS_MASSES, LOSS_DIRECTIONS = 6, 8


class Factors(NamedTuple):
    """Factors (...) on the parameters of a rig, named as in `config.ScenarioRanges`."""

    drone_mass_scale: Array | float = 1.0
    drone_inertia_scale: Array | float = 1.0
    mount_scale: Array | float = 1.0
    arm_scale: Array | float = 1.0
    yaw_per_thrust_scale: Array | float = 1.0
    rotor_force_scale: Array | float = 1.0
    carrier_scale: Array | float = 1.0
    attitude_gain_scale: Array | float = 1.0


def ring(plant: Plant, count: int) -> Plant:
    """A ring of `count` copies of the first drone of `plant`, spaced as its first two; drone 0 leads (ours).

    The carrier is a disc of the ring's radius. Its mass and the object's scale with the number of drones.
    """
    first, second = plant.drones[:2]
    radius = math.dist(first.mount, second.mount) / 2 / math.sin(math.pi / count)
    share, height = count / plant.count, first.mount[2]
    carrier = plant.carrier_mass * share
    drones = []
    for number in range(count):
        angle = 2 * math.pi * number / count
        place = (radius * math.cos(angle), radius * math.sin(angle), height)
        drones.append(dataclasses.replace(first, mount=place))
    return dataclasses.replace(
        plant,
        drones=tuple(drones),
        leader=0,
        carrier_mass=carrier,
        carrier_inertia=(carrier * radius**2 / 4, carrier * radius**2 / 4, carrier * radius**2 / 2),
        object_mass=plant.object_mass * share,
        object_size=(2 * radius, 2 * radius, plant.object_size[2]),
        ball_stop=0.0,
    )


def ring_config(config: Config, count: int) -> Config:
    """`config` for a `ring` of `count` drones; load and attitude gains scale with the number of drones."""
    plant, scenario, share = ring(config.plant, count), config.scenario, count / config.plant.count
    wider = plant.object_size[0] / config.plant.object_size[0]
    low, high = scenario.object_mass
    near, far = scenario.cg_amplitude
    scenario = dataclasses.replace(
        scenario, team_sizes=(), object_mass=(low * share, high * share), cg_amplitude=(near * wider, far * wider)
    )
    designed = config.attitude.design_object_mass * share
    attitude = dataclasses.replace(config.attitude, design_object_mass=designed)
    return dataclasses.replace(config, plant=plant, attitude=attitude, scenario=scenario)


def padded(parameters: PlantParameters, count: int) -> PlantParameters:
    """`parameters` padded to `count` drones; added drones have no mass, no thrust and no share of the load."""
    missing = count - parameters.size
    nothing = {"drone_mass", "own_inertia", "rotor_force_max", "load_share", "known_mass", "blocked"}

    def longer(name: str, value: Any) -> Any:
        if name not in nothing | {"mounts", "yaw", "arm", "yaw_per_thrust", "rotor_lag"}:
            return value
        more = np.repeat(value[-1:], missing, axis=0)
        return np.concatenate([value, 0.0 * more if name in nothing else more])

    return PlantParameters(**{name: longer(name, value) for name, value in parameters._asdict().items()})


def table(config: Config) -> PlantParameters:
    """Parameters of all `scenario.team_sizes` (S, ...), padded to the number of drones of the plant."""
    rings = [ring_config(config, count) for count in config.scenario.team_sizes]
    found = [padded(plant_parameters(one.plant, one.attitude), config.plant.count) for one in rings]
    gains = AttitudeGains(*(np.stack(parts) for parts in zip(*(one.gains for one in found), strict=True)))
    return PlantParameters(
        **{name: np.stack([getattr(one, name) for one in found]) for name in found[0]._fields if name != "gains"},
        gains=gains,
    )


def amplitudes_with_loss(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Object masses (M,) [kg] and CG amplitudes (S, N, M) [m] that can be held in every direction without drone n.

    Masses span `scenario.object_mass`. Amplitudes are those of the linear program of `plant.trim` with
    `scenario.trim_margin` and the leader, if it flies, at hover thrust. S counts `scenario.team_sizes`, or is 1 for the
    plant alone; a ring's are divided by its size over the plant's. Negative: none. Needs SciPy.
    """
    from mjxball.plant.trim import largest_amplitude

    scenario, most = config.scenario, config.plant.count
    masses = np.linspace(*scenario.object_mass, LOSS_MASSES)
    angles = math.pi * np.arange(LOSS_DIRECTIONS) / LOSS_DIRECTIONS
    ways = [(math.cos(angle), math.sin(angle)) for angle in angles]
    if len(config.plant.directions) == 1:
        ways = [tuple(np.eye(2)[config.plant.directions[0]])]
    found = np.full((len(scenario.team_sizes or (most,)), most, LOSS_MASSES), -1.0)
    for row, count in enumerate(scenario.team_sizes or (most,)):
        plant = ring(config.plant, count) if scenario.team_sizes else config.plant
        wide = plant.object_size[0] / config.plant.object_size[0]
        for number, (column, mass) in itertools.product(range(plant.count), enumerate(masses)):
            held = [
                largest_amplitude(plant, mass * count / most, scenario.trim_margin, way, lost=(number,)) for way in ways
            ]
            found[row, number, column] = max(min(held) / wide, -1.0)
    return masses, found


def varied(parameters: PlantParameters, factors: Factors, attitude: Attitude, object_mass: Array) -> PlantParameters:
    """`parameters` times `factors`; the attitude gains are designed anew for that rig with `object_mass` () [kg]."""
    own, carrier = parameters.drone_mass * factors.drone_mass_scale, parameters.carrier_mass * factors.carrier_scale
    found = parameters._replace(
        drone_mass=own,
        known_mass=own + parameters.load_share * carrier,
        own_inertia=parameters.own_inertia * factors.drone_inertia_scale,
        mounts=parameters.mounts * factors.mount_scale,
        arm=parameters.arm * factors.arm_scale,
        yaw_per_thrust=parameters.yaw_per_thrust * factors.yaw_per_thrust_scale,
        rotor_force_max=parameters.rotor_force_max * factors.rotor_force_scale,
        carrier_mass=carrier,
        carrier_inertia=parameters.carrier_inertia * factors.carrier_scale,
    )
    carried = object_mass * found.object_inertia_per_mass
    inertia = [rigid_inertia(found)[axis, axis] + carried[axis] for axis in range(3)]
    drones = (found.drone_mass > 0).sum()
    gains = design_gains(inertia, attitude.natural_frequency, attitude.damping, drones)
    xp = found.mounts.__array_namespace__()
    kp, kd = (factors.attitude_gain_scale * xp.stack(list(gain)) for gain in gains)
    return found._replace(gains=AttitudeGains(kp, kd))
