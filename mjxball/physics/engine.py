"""What every physics engine shares: the plant's state, the rotors' wrench, and the accelerations it must provide."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

Array = Any


class PlantState(NamedTuple):
    """State of the rigid assembly, its rotors and a rolling ball, any leading batch shape."""

    position: Array  # (..., 3) of O in the world [m]
    quaternion: Array  # (..., 4) body -> world, (w, x, y, z)
    velocity: Array  # (..., 3) of O in the world [m/s]
    rates: Array  # (..., 3) angular velocity in body axes [rad/s]
    rotor_force: Array  # (..., 2, 4) leader, follower [N]
    time: Array  # (...) since the start of the episode [s]
    ball_offset: Array  # (...) of a rolling ball from O along the CG axis [m]; unused by prescribed motions
    ball_rate: Array  # (...) [m/s]
    loops: Array | None = None  # (..., 2, 13) what a Crazyflie's own loops carry, see `control.crazyflie`; None: ideal

    def each(self, function: Callable[..., Any], *others: PlantState) -> PlantState:
        """`function` of every leaf that there is, and of the same leaf of `others`."""
        rows = zip(self, *others, strict=True)
        return PlantState(*(None if row[0] is None else function(*row) for row in rows))


class CgState(NamedTuple):
    """CG offset from O along the CG axis, with consistent derivatives."""

    offset: Array  # (...) [m]
    rate: Array  # (...) [m/s]
    acceleration: Array  # (...) [m/s2]


class Load(NamedTuple):
    """The object's mass and the motion of its centre of gravity."""

    object_mass: Array  # (...) true mass at the start [kg]
    believed_mass: Array  # (...) mass that the hover thrust assumes [kg]
    cg_amplitude: Array  # (...) of a sine [m]
    cg_speed: Array  # (...) of a sine [rad/s]
    cg_phase: Array  # (...) of a sine [rad]
    mass_change: Array  # (..., k) mass added, or dropped if negative [kg]
    mass_change_time: Array  # (..., k) when [s]
    external_force: Array | None = None  # (..., 3) force on O in the world, held over a control step [N]; None: none
    rotor_lag_scale: Array | None = None  # (...) factor on the rotors' time constant; None: 1
    thrust_scale: Array | None = None  # (..., 2) factor on the rotor forces of leader and follower; None: 1
    added_inertia: Array | None = None  # (..., 3) about the body axes through O, without mass [kg m2]; None: none
    cg_path: Array | None = None  # (..., k) places in [-1, 1] that the CG visits instead of a sine, see `motion.visits`
    follows_path: Array | None = None  # (...) 1 where it does, 0 where it follows the sine
    battery: Array | None = None  # (...) voltage of both batteries [V]; None: motors follow the curve
    uncompensated: Array | None = None  # (...) 1 where the firmware does not compensate for the battery, else 0


class Wrench(NamedTuple):
    """All rotors' wrench on the assembly about O, body axes."""

    force: Array  # (..., 3) [N]
    torque: Array  # (..., 3) [N m]


class Engine(NamedTuple):
    """Accelerations of the assembly. Both functions return the acceleration of O in the world (..., 3) [m/s2]
    and the angular acceleration in body axes (..., 3) [rad/s2]; directions that a stand locks are 0.
    """

    # prescribed(state, wrench, object_mass (...), cg, added_inertia (..., 3) or None):
    #   the CG follows `cg`, driven by whatever force that takes
    prescribed: Callable[[PlantState, Wrench, Array, CgState, Array | None], tuple[Array, Array]]
    # rolling(state, wrench, object_mass (...), force (...) on the ball along the axis [N], added_inertia):
    #   the ball at state.ball_offset rolls freely; returns its acceleration (...) [m/s2] as well
    rolling: Callable[[PlantState, Wrench, Array, Array, Array | None], tuple[Array, Array, Array]]
