"""What of a drone's rotor forces can be commanded: rows for the linear program of `mjxball.plant.trim` (ours).

At level hover an ideal attitude loop gives a torque of its gain times its tilt command, and no yaw torque. The rate
loops of Crazyflies integrate until they hold the load: there any force can be commanded.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.config import Config, Plant
from mjxball.plant.parameters import plant_parameters
from mjxball.plant.rotors import PLACES, SPIN, lever

if TYPE_CHECKING:
    from jaxtyping import Float


class Commands(NamedTuple):
    """What drones with ideal attitude loops may be commanded."""

    gains: tuple[float, float]  # of each drone's loop about roll and pitch [N m/rad]
    tilt: float  # largest roll or pitch [rad]
    vertical: float  # largest acceleration up or down [m/s2]


def commanded(plant: Plant | Config) -> tuple[Plant, Commands | None]:
    """The plant, and what may be commanded; None: any force."""
    if isinstance(plant, Plant):
        return plant, None
    config = plant
    if config.autopilot.kind != "ideal":
        return config.plant, None
    roll, pitch, _ = map(float, plant_parameters(config.plant, config.attitude).gains.kp)
    return config.plant, Commands((roll, pitch), config.command.tilt_limit, config.command.vertical_limit)


def asked_rows(
    plant: Plant, commands: Commands | None, drones: np.ndarray, factor: np.ndarray, believes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(yaw torques (A, 4 N), commands (3 A, 4 N) per force of a rotor, commands (3 A,) that hover at no force).

    Of the A numbered `drones` that answer commands; commands over their limits. `factor` (N,) as `thrust` of
    `largest_margin`, `believes` (N,) the mass that each drone's hover thrust is for [kg].
    """
    columns = 4 * plant.count
    if commands is None:
        return np.zeros((0, columns)), np.zeros((0, columns)), np.zeros(0)
    twist, asked, level = [], [], []
    for number in drones:
        x, y, _ = plant.drones[number].mount
        thrust, roll, pitch, yaw = effect_of(plant, number)
        roll, pitch = roll - y * thrust, pitch + x * thrust  # about the drone's own centre
        for axis, torque in enumerate((roll, pitch)):
            asked.append(_placed(torque / (commands.gains[axis] * commands.tilt * factor[number]), number, plant.count))
        asked.append(_placed(thrust / (believes[number] * commands.vertical * factor[number]), number, plant.count))
        level += [0.0, 0.0, plant.gravity / commands.vertical]
        twist.append(_placed(yaw, number, plant.count))
    return np.reshape(twist, (-1, columns)), np.reshape(asked, (-1, columns)), np.array(level)


def _placed(row: np.ndarray, number: int, count: int) -> np.ndarray:
    """(4 N,) with `row` (4,) at the rotors of drone `number`."""
    found = np.zeros((count, 4))
    found[number] = row
    return found.ravel()


def effect_of(plant: Plant, number: int) -> Float[np.ndarray, "4 4"]:
    """Wrench about O (T, tau_x, tau_y, tau_z) per force of each of a drone's rotors, columns rotor by rotor [1, m]."""
    drone, arm = plant.drones[number], plant.of_drones("arm")[number]
    cosine, sine = math.cos(drone.yaw), math.sin(drone.yaw)
    own = lever(arm, plant.layout) * np.array(PLACES[plant.layout], dtype=float)
    x, y = (own @ [[cosine, sine], [-sine, cosine]] + drone.mount[:2]).T
    return np.array([np.ones(4), y, -x, plant.of_drones("yaw_per_thrust")[number] * np.array(SPIN[plant.layout])])
