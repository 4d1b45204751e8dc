"""Inertia and control authority of a pair of Crazyflies about roll, pitch and yaw."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie
from mjxball.control.constants import hover
from mjxball.plant import plant_parameters
from mjxball.plant.rotors import lever

NAMES = ("roll", "pitch", "yaw")
DRONE = np.array([1.66e-5, 1.66e-5, 2.93e-5])  # inertia for which the delivered gains were found good [kg m2]


class Axis(NamedTuple):
    """One body axis of the coupled pair when the loops of both drones give the same output."""

    name: str
    inertia: float  # about O, ball at O [kg m2]
    gain: float  # angular acceleration per unit of the rate loops' output [deg/s2]
    inertia_ratio: float  # half of `inertia` over `DRONE`
    trim: float  # output that holds the largest constant moment: the ball at an end stop [1]
    headroom: float  # output at which a motor of the hovering pair reaches full power [1]


def inertia_about_o(config: Config) -> np.ndarray:
    """Inertia (3,) of the assembly about O with the moving mass at O [kg m2]."""
    constants = plant_parameters(config.plant, config.attitude)
    return np.diag(constants.drone_inertia) + config.plant.object_mass * constants.object_inertia_per_mass


def axes(config: Config) -> tuple[Axis, ...]:
    """Roll, pitch and yaw of the pair in `config`."""
    plant = config.plant
    command, slope = hover(config)
    # A roll output moves each motor by half of it, a yaw output by all of it.
    tilting = 2 * 4 * lever(plant.arm, plant.layout) / 2 * slope
    torque = np.array([tilting, tilting, 2 * 4 * plant.yaw_per_thrust * slope])
    inertia = inertia_about_o(config)
    stop = plant.ball_stop or min(plant.object_size[axis] for axis in plant.directions) / 2
    moment = plant.moving_fraction * plant.object_mass * plant.gravity * stop
    loaded = np.array(["y" in plant.cg_axis, "x" in plant.cg_axis, False])
    gain, trim = np.degrees(torque / inertia), loaded * moment / torque
    spare = crazyflie.FULL - command
    room = (2 * spare, 2 * spare, spare)
    return tuple(map(Axis, NAMES, *(map(float, row) for row in (inertia, gain, inertia / (2 * DRONE), trim, room))))
