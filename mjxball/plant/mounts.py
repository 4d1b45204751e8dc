"""Elastic mounts: the two hinges on which a drone turns about its own x and y, against springs and dampers.

`plant.mount_frequency` f is the frequency of a drone of inertia J on a carrier that is held still, so the stiffness is
k = (2 pi f)^2 J and the damping c = 4 pi f zeta J. In a rig of N equal drones on a carrier of inertia H, f is also the
frequency of drones that turn against one another; all of them turn against the carrier at f sqrt(1 + N J / H).
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

from mjxball.config import Plant
from mjxball.errors import InputError

STEPS_A_PERIOD = 4  # fewest physics steps in a period of the mount's oscillation


class Hinge(NamedTuple):
    """Constants of one hinge."""

    stiffness: float  # [N m/rad]
    damping: float  # [N m s/rad]
    armature: float  # added inertia that stands for the implicit part of the integration [kg m2]


def hinge(plant: Plant, inertia: float, step: float = 0.0) -> Hinge:
    """Constants for a drone of `inertia` [kg m2] about the hinge, for physics steps of `step` [s].

    The steps move positions by half a step, velocities by the accelerations there, and positions by half a step. Spring
    and damper are integrated by the trapezoidal rule, which stays stable on a carrier that is light: the acceleration a
    changes their torque by -(h^2 k / 4 + h c / 2) a. Stiffness and damping are those whose discrete oscillation has
    exactly the plant's frequency and damping ratio. `step` 0: the constants of continuous time. Raises InputError for
    a step of more than a quarter of the period.
    """
    frequency, ratio = 2 * math.pi * plant.mount_frequency, plant.mount_damping
    pole = frequency * complex(-ratio, math.sqrt(1 - ratio**2))
    if step * plant.mount_frequency * STEPS_A_PERIOD > 1 + 1e-9:
        longest = 1e3 / (STEPS_A_PERIOD * plant.mount_frequency)
        raise InputError(
            f"plant.mount_frequency {plant.mount_frequency:g} Hz needs physics steps of at most {longest:.3g} ms, a "
            f"quarter of its period, and they are {1e3 * step:.3g} ms"
        )
    if step:
        pole = 2 / step * cmath.tanh(pole * step / 2)
    stiffness, damping = abs(pole) ** 2 * inertia, -2 * pole.real * inertia
    return Hinge(stiffness, damping, step * step * stiffness / 4 + step * damping / 2)
