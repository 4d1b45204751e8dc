"""Types and functions that all physics engines share: the plant's state, wrenches, contact forces, accelerations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball import arrays
from mjxball.arrays import Array
from mjxball.config import Plant
from mjxball.control import mixer, rotations
from mjxball.plant import PlantParameters
from mjxball.plant.parameters import own_inertia

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    Scalar = Float[Array, "..."]
    # Coordinates of the load along its directions: (...) on a line, (..., 2) in a plane.
    Coordinates = Float[Array, "..."]
    Vector = Float[Array, "... 3"]
# Limits beyond which a flight counts as diverged.
MAX_POSITION, MAX_RATE = 1e3, 50.0  # [m] each coordinate, [rad/s] norm
UPWARDS = np.array([0.0, 0.0, 1.0], np.float32)  # e3


class PlantState(NamedTuple):
    """State of the rigid assembly, its rotors and a rolling ball, with any leading batch shape."""

    position: Vector  # of O in the world [m]
    quaternion: Float[Array, "... 4"]  # body -> world, (w, x, y, z)
    velocity: Vector  # of O in the world [m/s]
    rates: Vector  # angular velocity in body axes [rad/s]
    rotor_force: Float[Array, "... drones 4"]  # [N]
    ticks: Int[Array, "..."]  # half physics steps since the start of the episode
    time: Scalar  # ticks times their length [s]: summing in float32 is 2 s off after half an hour
    ball_offset: Coordinates  # of a rolling ball from O [m]; unused by prescribed motions
    ball_rate: Coordinates  # [m/s]
    loops: Float[Array, "... drones 13"] | None = None  # of a Crazyflie, see `control.crazyflie`; None: ideal
    # Drones on elastic mounts, about their own x, then y, from their places on the carrier; None: rigid mounts.
    mount_angle: Float[Array, "... drones 2"] | None = None  # [rad]
    mount_rate: Float[Array, "... drones 2"] | None = None  # [rad/s]

    def each(self, function: Callable[..., Any], *others: PlantState) -> PlantState:
        """Apply `function` to every leaf that is not None, with the same leaves of `others`."""
        rows = zip(self, *others, strict=True)
        return PlantState(*(None if row[0] is None else function(*row) for row in rows))


class CgState(NamedTuple):
    """Coordinates of the CG from O along the load's directions, and their time derivatives."""

    offset: Coordinates  # [m]
    rate: Coordinates  # [m/s]
    acceleration: Coordinates  # [m/s2]


def coordinates(value: Coordinates, directions: int) -> list[Scalar]:
    """Split the load's coordinates: `[value]` on a line, else the components of the last axis."""
    return [value] if directions == 1 else [value[..., number] for number in range(directions)]


def from_coordinates(values: Sequence[Scalar]) -> Coordinates:
    """The inverse of `coordinates`: one coordinate as it is, two along the last axis."""
    return values[0] if len(values) == 1 else arrays.joined(values)


def solve_small(matrix: Any, vector: Any) -> list[Scalar]:
    """Solve one or two equations, given as sequences or arrays."""
    if len(vector) == 1:
        return [vector[0] / matrix[0][0]]
    (a, b), (c, d) = matrix
    determinant = a * d - b * c
    return [(d * vector[0] - b * vector[1]) / determinant, (a * vector[1] - c * vector[0]) / determinant]


class PathShape(NamedTuple):
    """Shape of the CG's path in a plane, in axes turned by `direction`: (A sin a, width A sin(ratio a + lead))."""

    direction: Scalar  # of the first of both sines from body x [rad]
    width: Scalar  # amplitude of the second over that of the first; 0: a line, 1 with a lead of pi / 2: a circle
    ratio: Scalar  # angular speed of the second over that of the first; 1: an ellipse, 2: a figure of eight
    lead: Scalar  # phase of the second [rad]


class Load(NamedTuple):
    """The object's mass and the motion of its centre of gravity, and disturbances of the flight."""

    object_mass: Scalar  # true mass at the start [kg]
    believed_mass: Scalar  # mass that the hover thrust assumes [kg]
    cg_amplitude: Scalar  # of a sine [m]
    cg_speed: Scalar  # of a sine [rad/s]
    cg_phase: Scalar  # of a sine [rad]
    mass_change: Float[Array, "... changes"]  # mass added, or dropped if negative [kg]
    mass_change_time: Float[Array, "... changes"]  # when [s]
    external_force: Vector | None = None  # force on O in the world, held over a control step [N]; None: none
    rotor_lag_scale: Scalar | None = None  # factor on the rotors' time constant; None: 1
    thrust_scale: Float[Array, "... drones"] | None = None  # factor on each drone's rotor forces; None: 1
    added_inertia: Vector | None = None  # about the body axes through O, without mass [kg m2]; None: none
    # Waypoints in units of the amplitude, (..., places) or (..., places, 2), see `motion.waypoints`; None: a sine.
    cg_path: Float[Array, "... places"] | None = None
    follows_path: Scalar | None = None  # 1 where the CG follows `cg_path`, 0 where it follows the sine
    battery: Scalar | None = None  # voltage of all batteries [V]; None: motors follow the curve
    uncompensated: Scalar | None = None  # 1 where the firmware does not compensate for the battery, else 0
    cg_shape: PathShape | None = None  # of the path in a plane; None: a sine along x
    stop_time: Float[Array, "... drones"] | None = None  # when each drone's rotors stop [s]; None: never
    thrust_fade: Scalar | None = None  # share of all rotor forces that is lost in a second [1/s]; None: none
    loop_scale: Scalar | None = None  # factor on the natural frequency of the ideal attitude loops; None: 1
    rotor_drag: Scalar | None = None  # of a drone over its mass [1/s], see `physics.aerodynamics`; None: none
    wind: Vector | None = None  # velocity of the air in the world, felt by rotor drag [m/s]; None: none
    floor: Scalar | None = None  # height of the ground in the world, for ground effect [m]; None: no ground
    download: Scalar | None = None  # share of the thrust that a rotor above the object loses; None: none
    # What each drone's attitude estimate is off: roll, pitch, and yaw, by which its mount is turned [rad]; None: exact.
    attitude_error: Float[Array, "... drones 3"] | None = None
    # Physics steps of this control step in which the drones still fly `last_commands`; None: none.
    late: Scalar | None = None
    last_commands: Float[Array, "... drones 3"] | None = None


class Wrench(NamedTuple):
    """Wrench of all rotors on the assembly about O, body axes."""

    force: Vector  # [N]
    torque: Vector  # [N m]


class Engine(NamedTuple):
    """Accelerations of the assembly. Both functions return the acceleration of O in the world [m/s2]
    and the angular acceleration in body axes [rad/s2]; directions that a stand locks are 0. With elastic mounts the
    angular acceleration of `PlantState.mount_angle` (..., N, 2) follows [rad/s2]; the engine then moves the wrenches of
    `state.rotor_force` from the carrier to the turned drones.
    """

    # prescribed(state, wrench, object_mass, cg, added_inertia):
    #   the CG follows `cg`, driven by whatever force that takes
    prescribed: Callable[[PlantState, Wrench, Scalar, CgState, Vector | None], tuple[Array, ...]]
    # rolling(state, wrench, object_mass, force on the ball along its directions [N], added_inertia):
    #   the ball at state.ball_offset rolls freely; returns its acceleration [m/s2] as well
    rolling: Callable[[PlantState, Wrench, Scalar, Coordinates, Vector | None], tuple[Array, ...]]


class Air(NamedTuple):
    """Effects of the air on the drones, see `physics.aerodynamics`; None where absent."""

    lift: Float[Array, "... drones 4"] | None = None  # factor on the lift of each rotor, at the same yaw moment
    drag: Float[Array, "... drones 3"] | None = None  # force on each drone, body axes [N]


STILL = Air()


def rotor_wrenches(
    plant: Plant, parameters: PlantParameters, rotor_force: Float[Array, "... drones 4"], air: Air = STILL
) -> Float[Array, "... drones 4"]:
    """(T, tau_x, tau_y, tau_z) [N, N m] of each drone's rotors about its own centre, body axes."""
    own = parameters.arm, parameters.yaw_per_thrust, plant.layout
    wrench = mixer.wrench_from_rotors(rotor_force, *own)
    if air.lift is not None:
        lifted = mixer.wrench_from_rotors(air.lift * rotor_force, *own)
        wrench = wrench.__array_namespace__().concat([lifted[..., :3], wrench[..., 3:]], axis=-1)
    return mixer.turned(wrench, parameters.yaw)


def total_wrench(
    plant: Plant, parameters: PlantParameters, rotor_force: Float[Array, "... drones 4"], air: Air = STILL
) -> Wrench:
    """Wrench about O of all rotors, `rotor_force` [N]: T e3 and the sum of tau_i + r_i x T_i e3 over the drones.

    The drag of the air on a drone is added to its thrust T_i e3.
    """
    drones = rotor_wrenches(plant, parameters, rotor_force, air)
    force = drones[..., :1] * UPWARDS
    force = force if air.drag is None else force + air.drag
    torque = drones[..., 1:] + rotations.cross(parameters.mounts, force)
    return Wrench(force.sum(axis=-2), torque.sum(axis=-2))


def contact_wrenches(
    plant: Plant,
    parameters: PlantParameters,
    state: PlantState,
    linear: Vector,
    angular: Vector,
    air: Air = STILL,
) -> tuple[Float[Array, "... drones 3"], Float[Array, "... drones 3"]]:
    """Contact forces [N] and torques [N m] of every drone on the carrier, body axes, about each drone's own centre.

    `linear` is the acceleration of O in the world [m/s2], `angular` the angular acceleration in body axes [rad/s2], D_i
    the drag of the air:

        F_i = T_i e3 + D_i - m_i g R^T E3 - m_i a_i,  a_i = a_b + w' x r_i + w x (w x r_i)
        tau_i = tau_rotor,i - w x I_i w - I_i w'
    """
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    held = parameters.gravity * matrix[..., 2, :] + rotations.rotate_back(matrix, linear)
    held, rates, turning = (vector[..., None, :] for vector in (held, state.rates, angular))
    mounts, own, cross = parameters.mounts, own_inertia(parameters), rotations.cross
    lever = cross(turning, mounts) + cross(rates, cross(rates, mounts))
    rotors = rotor_wrenches(plant, parameters, state.rotor_force, air)
    force = rotors[..., :1] * UPWARDS - parameters.drone_mass[..., None] * (held + lever)
    force = force if air.drag is None else force + air.drag
    torque = rotors[..., 1:] - cross(rates, rotations.rotate(own, rates)) - rotations.rotate(own, turning)
    return force, torque


def has_diverged(plant: PlantState) -> Bool[Array, "..."]:
    """(...) true where a value of `plant` is not finite, or position or rates exceed `MAX_POSITION` or `MAX_RATE`."""
    xp, batch = plant.position.__array_namespace__(), plant.position.ndim - 1
    with np.errstate(invalid="ignore", over="ignore"):
        far = (xp.abs(plant.position) > MAX_POSITION).any(axis=-1)
        far = far | ((plant.rates * plant.rates).sum(axis=-1) > MAX_RATE**2)
    for leaf in plant:
        if leaf is not None:
            far = far | ~xp.isfinite(leaf).all(axis=tuple(range(batch, leaf.ndim)))
    return far
