"""What every physics engine shares: the plant's state, wrenches, contact forces, and the accelerations it provides."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.config import Plant
from mjxball.control import mixer, rotations
from mjxball.control.constants import PlantConstants

Array = Any  # NumPy's or JAX's
if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    Scalar = Float[Array, "..."]
    Vector = Float[Array, "... 3"]
    Matrix = Float[Array, "... 3 3"]
# A flight beyond one of these has diverged: the physics no longer holds, and no flight came back from there.
MAX_POSITION, MAX_RATE = 1e3, 50.0  # [m] each coordinate, [rad/s] norm


class PlantState(NamedTuple):
    """State of the rigid assembly, its rotors and a rolling ball, any leading batch shape."""

    position: Vector  # of O in the world [m]
    quaternion: Float[Array, "... 4"]  # body -> world, (w, x, y, z)
    velocity: Vector  # of O in the world [m/s]
    rates: Vector  # angular velocity in body axes [rad/s]
    rotor_force: Float[Array, "... 2 4"]  # leader, follower [N]
    time: Scalar  # since the start of the episode [s]
    ball_offset: Scalar  # of a rolling ball from O along the CG axis [m]; unused by prescribed motions
    ball_rate: Scalar  # [m/s]
    loops: Float[Array, "... 2 13"] | None = None  # of a Crazyflie, see `control.crazyflie`; None: ideal

    def each(self, function: Callable[..., Any], *others: PlantState) -> PlantState:
        """`function` of every leaf that there is, and of the same leaf of `others`."""
        rows = zip(self, *others, strict=True)
        return PlantState(*(None if row[0] is None else function(*row) for row in rows))


class CgState(NamedTuple):
    """CG offset from O along the CG axis, with consistent derivatives."""

    offset: Scalar  # [m]
    rate: Scalar  # [m/s]
    acceleration: Scalar  # [m/s2]


class Load(NamedTuple):
    """The object's mass and the motion of its centre of gravity."""

    object_mass: Scalar  # true mass at the start [kg]
    believed_mass: Scalar  # mass that the hover thrust assumes [kg]
    cg_amplitude: Scalar  # of a sine [m]
    cg_speed: Scalar  # of a sine [rad/s]
    cg_phase: Scalar  # of a sine [rad]
    mass_change: Float[Array, "... changes"]  # mass added, or dropped if negative [kg]
    mass_change_time: Float[Array, "... changes"]  # when [s]
    external_force: Vector | None = None  # force on O in the world, held over a control step [N]; None: none
    rotor_lag_scale: Scalar | None = None  # factor on the rotors' time constant; None: 1
    thrust_scale: Float[Array, "... 2"] | None = None  # factor on the rotor forces of leader and follower; None: 1
    added_inertia: Vector | None = None  # about the body axes through O, without mass [kg m2]; None: none
    cg_path: Float[Array, "... places"] | None = None  # in [-1, 1], see `motion.visits`; None: the CG follows the sine
    follows_path: Scalar | None = None  # 1 where it does, 0 where it follows the sine
    battery: Scalar | None = None  # voltage of both batteries [V]; None: motors follow the curve
    uncompensated: Scalar | None = None  # 1 where the firmware does not compensate for the battery, else 0


class Wrench(NamedTuple):
    """All rotors' wrench on the assembly about O, body axes."""

    force: Vector  # [N]
    torque: Vector  # [N m]


class Engine(NamedTuple):
    """Accelerations of the assembly. Both functions return the acceleration of O in the world [m/s2]
    and the angular acceleration in body axes [rad/s2]; directions that a stand locks are 0.
    """

    # prescribed(state, wrench, object_mass, cg, added_inertia):
    #   the CG follows `cg`, driven by whatever force that takes
    prescribed: Callable[[PlantState, Wrench, Scalar, CgState, Vector | None], tuple[Vector, Vector]]
    # rolling(state, wrench, object_mass, force on the ball along the axis [N], added_inertia):
    #   the ball at state.ball_offset rolls freely; returns its acceleration [m/s2] as well
    rolling: Callable[[PlantState, Wrench, Scalar, Scalar, Vector | None], tuple[Vector, Vector, Scalar]]


def contact_wrenches(
    plant: Plant, constants: PlantConstants, state: PlantState, linear: Vector, angular: Vector
) -> tuple[Float[Array, "... 2 3"], Float[Array, "... 2 3"]]:
    """Contact forces [N] and torques [N m] of leader and follower on the object, body axes.

    `linear` is the acceleration of O in the world, `angular` in body axes:
    F_i = T_i e3 - m_i g R^T E3 - m_i a_i, a_i = a_b + w' x r_i + w x (w x r_i),
    tau_i = tau_rotor,i - w x I_i w - I_i w', torques about each drone's own centre.
    """
    xp = state.rates.__array_namespace__()
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    rates, down = state.rates, matrix[..., 2, :]
    body = rotations.rotate_back(matrix, linear)
    rotors = mixer.wrench_from_rotors(state.rotor_force, plant.arm, plant.yaw_per_thrust, plant.layout)
    forces, torques = [], []
    for drone, inertia in enumerate((plant.leader_inertia, plant.follower_inertia)):
        mass = float(constants.drone_mass[drone])
        mount = xp.asarray(constants.mounts[drone], dtype=rates.dtype)
        own = xp.asarray(inertia, dtype=rates.dtype)
        lever = rotations.cross(angular, mount) + rotations.cross(rates, rotations.cross(rates, mount))
        thrust = rotors[..., drone, 0]
        still = xp.zeros_like(thrust)
        push = xp.stack([still, still, thrust], axis=-1)
        forces.append(push - mass * (plant.gravity * down + body + lever))
        torques.append(rotors[..., drone, 1:] - rotations.cross(rates, own * rates) - own * angular)
    return xp.stack(forces, axis=-2), xp.stack(torques, axis=-2)


def has_diverged(plant: PlantState) -> Bool[Array, "..."]:
    """(...) true where a value of `plant` is not finite, or position or rates are beyond what the physics is for."""
    xp, batch = plant.position.__array_namespace__(), plant.position.ndim - 1
    with np.errstate(invalid="ignore", over="ignore"):
        far = (xp.abs(plant.position) > MAX_POSITION).any(axis=-1)
        far = far | ((plant.rates * plant.rates).sum(axis=-1) > MAX_RATE**2)
    for leaf in plant:
        if leaf is not None:
            far = far | ~xp.isfinite(leaf).all(axis=tuple(range(batch, leaf.ndim)))
    return far
