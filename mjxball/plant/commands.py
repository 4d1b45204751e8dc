"""Rotor forces that attitude commands can produce, as rows of the linear program of `mjxball.plant.trim` (ours).

At level hover an ideal attitude loop gives a torque of its gain times its tilt command, and no yaw torque. The rate
loops of Crazyflies integrate until they hold the load, so commands can produce any rotor force.
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


class CommandLimits(NamedTuple):
    """Gains and command limits of drones with ideal attitude loops."""

    gains: tuple[float, float]  # of each drone's loop about roll and pitch [N m/rad]
    tilt: float  # largest roll or pitch [rad]
    vertical: float  # largest acceleration up or down [m/s2]


def commanded(plant: Plant | Config) -> tuple[Plant, CommandLimits | None]:
    """The plant, and its command limits; None where commands can produce any rotor force, and for a `Plant` alone."""
    if isinstance(plant, Plant):
        return plant, None
    config = plant
    if config.autopilot.kind != "ideal":
        return config.plant, None
    roll, pitch, _ = map(float, plant_parameters(config.plant, config.attitude).gains.kp)
    return config.plant, CommandLimits((roll, pitch), config.command.tilt_limit, config.command.vertical_limit)


def command_rows(
    plant: Plant, commands: CommandLimits | None, drones: np.ndarray, factor: np.ndarray, believes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (yaw torques (A, 4 N), commands (3 A, 4 N), commands at hover (3 A,)) of the A drones numbered `drones`.

    Times all rotor forces [N], the first are yaw torques, which have to be 0; the second minus commands at hover are
    (roll, pitch, vertical) commands over their limits. `factor` (N,) as `thrust` of `largest_margin`, `believes` (N,)
    [kg] the mass that each drone's hover thrust assumes.
    """
    columns = 4 * plant.count
    if commands is None:
        return np.zeros((0, columns)), np.zeros((0, columns)), np.zeros(0)
    yaw_rows, rows, at_hover = [], [], []
    for number in drones:
        x, y, _ = plant.drones[number].mount
        thrust, roll, pitch, yaw = wrench_per_force(plant, number)
        roll, pitch = roll - y * thrust, pitch + x * thrust  # about the drone's own centre
        for axis, torque in enumerate((roll, pitch)):
            rows.append(_placed(torque / (commands.gains[axis] * commands.tilt * factor[number]), number, plant.count))
        rows.append(_placed(thrust / (believes[number] * commands.vertical * factor[number]), number, plant.count))
        at_hover += [0.0, 0.0, plant.gravity / commands.vertical]
        yaw_rows.append(_placed(yaw, number, plant.count))
    return np.reshape(yaw_rows, (-1, columns)), np.reshape(rows, (-1, columns)), np.array(at_hover)


def _placed(row: np.ndarray, number: int, count: int) -> np.ndarray:
    """A row (4 N,) of zeros with `row` (4,) at the rotors of drone `number`."""
    found = np.zeros((count, 4))
    found[number] = row
    return found.ravel()


def wrench_per_force(plant: Plant, number: int) -> Float[np.ndarray, "4 4"]:
    """Wrench about O (T, tau_x, tau_y, tau_z) per unit force of each rotor of one drone, a column per rotor [1, m]."""
    drone, arm = plant.drones[number], plant.of_drones("arm")[number]
    cosine, sine = math.cos(drone.yaw), math.sin(drone.yaw)
    own = lever(arm, plant.layout) * np.array(PLACES[plant.layout], dtype=float)
    x, y = (own @ [[cosine, sine], [-sine, cosine]] + drone.mount[:2]).T
    return np.array([np.ones(4), y, -x, plant.of_drones("yaw_per_thrust")[number] * np.array(SPIN[plant.layout])])
