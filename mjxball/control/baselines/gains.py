"""Numbers of the pitch axis that the classical followers are built from."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.constants import plant_constants
from mjxball.errors import InputError


class PitchGains(NamedTuple):
    """The pair's pitch axis and the attitude loop around it."""

    kp: float  # of one drone's attitude loop [N m/rad]
    kd: float  # [N m s/rad]
    inertia: float  # of the assembly about O, CG at O, nominal object [kg m2]
    half_length: float  # from O to each drone [m]
    drone_mass: tuple[float, float]  # leader, follower [kg]
    share: tuple[float, float]  # of the object's weight that each carries
    gravity: float  # [m/s2]
    lag: float  # of the rotors [s]
    period: float  # between two commands [s]
    natural_frequency: tuple[float, float]  # of the closed roll and pitch loops [rad/s]
    damping: float


def copied_law(config: Config) -> tuple[Any, ...]:
    """What `observation.copy_command` takes after the observation, for the configured leader."""
    law = config.leader
    return law.kp, law.kd, config.plant.gravity, law.tilt_limit, law.vertical_limit


def pitch_gains(config: Config, name: str) -> PitchGains:
    """Gains for the follower `name`; InputError unless the CG moves along x between two drones on a free pair."""
    plant, attitude = config.plant, config.attitude
    if plant.cg_axis != "x" or plant.stand != "free":
        raise InputError(f"follower {name!r} balances a free pair along x; this plant is another")
    constants = plant_constants(plant, attitude)
    inertia = np.diag(constants.drone_inertia) + plant.object_mass * constants.object_inertia_per_mass
    roll, pitch, _ = attitude.natural_frequency
    led, followed = map(float, constants.share)
    return PitchGains(
        kp=constants.gains.kp[1],
        kd=constants.gains.kd[1],
        inertia=float(inertia[1]),
        half_length=0.5 * (plant.leader_mount[0] - plant.follower_mount[0]),
        drone_mass=(plant.leader_mass, plant.follower_mass),
        share=(led, followed),
        gravity=plant.gravity,
        lag=plant.rotor_lag,
        period=config.timing.control_period,
        natural_frequency=(roll, pitch),
        damping=attitude.damping,
    )
