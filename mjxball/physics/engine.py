"""What every physics engine shares: the plant's state, the rotors' wrench, and the accelerations it must provide."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mjxball.physics.motion import CgState

Array = Any


class PlantState(NamedTuple):
    """State of the rigid assembly and its rotors, any leading batch shape."""

    position: Array  # (..., 3) of O in the world [m]
    quaternion: Array  # (..., 4) body -> world, (w, x, y, z)
    velocity: Array  # (..., 3) of O in the world [m/s]
    rates: Array  # (..., 3) angular velocity in body axes [rad/s]
    rotor_force: Array  # (..., 2, 4) leader, follower [N]
    time: Array  # (...) since the start of the episode [s]


class Load(NamedTuple):
    """The object's mass and the prescribed motion of its centre of gravity."""

    object_mass: Array  # (...) true mass [kg]
    believed_mass: Array  # (...) mass that the hover thrust assumes [kg]
    cg_amplitude: Array  # (...) [m]
    cg_speed: Array  # (...) [rad/s]
    cg_phase: Array  # (...) [rad]


class Wrench(NamedTuple):
    """All rotors' wrench on the assembly about O, body axes."""

    force: Array  # (..., 3) [N]
    torque: Array  # (..., 3) [N m]


# acceleration(state, wrench, object_mass (...) [kg], cg)
#   -> (acceleration of O in the world (..., 3) [m/s2], angular acceleration in body axes (..., 3) [rad/s2])
Acceleration = Callable[[PlantState, Wrench, Array, CgState], tuple[Array, Array]]
