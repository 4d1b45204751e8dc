"""Attitudes and rates of drones on elastic mounts (`plant.mounts`), which only the C MuJoCo engine simulates."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjxball.arrays import Array, joined
from mjxball.config import Plant
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.physics.engine import PlantState

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Vector


def require_rigid(plant: Plant, physics: str) -> None:
    """Raise InputError if `plant` has elastic mounts, which the engine `physics` does not support."""
    if plant.mount_frequency:
        raise InputError(
            f"the engine {physics} has no elastic mounts: set plant.mount_frequency to 0, or simulate with "
            "--physics mujoco"
        )


def own_quaternion(
    quaternion: Float[Array, "... 4"], angle: Float[Array, "... drones 2"], yaw: Float[Array, " drones"]
) -> Float[Array, "... drones 4"]:
    """Attitude of every drone: the carrier's `quaternion`, turned by the hinges' `angle` about the drone's x, then y.

    `yaw` of the drones on the carrier [rad] is taken off, so that rigid mounts give the carrier's attitude.
    """
    return rotations.multiply_quaternions(quaternion[..., None, :], _turned(angle, yaw))


def own_rates(
    rates: Vector,
    angle: Float[Array, "... drones 2"],
    rate: Float[Array, "... drones 2"],
    yaw: Float[Array, " drones"],
) -> Float[Array, "... drones 3"]:
    """Angular velocity of every drone in the axes of `own_quaternion` [rad/s]; `rate` is that of `angle`."""
    xp = angle.__array_namespace__()
    roll, pitch = rate[..., 0], rate[..., 1]
    swing = joined([xp.cos(angle[..., 1]) * roll, pitch, xp.sin(angle[..., 1]) * roll])
    matrix = rotations.matrix_from_quaternion(_turned(angle, yaw))
    return rotations.rotate_back(matrix, rates[..., None, :]) + rotations.turned_about_z(swing, yaw)


def own_motion(state: PlantState, yaw: Float[Array, " drones"]) -> tuple[Array, Array]:
    """(roll, pitch, yaw [rad], body rates [rad/s]) of every drone, each (..., N, 3); (..., 1, 3) on rigid mounts."""
    if state.mount_angle is None or state.mount_rate is None:
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
        return euler[..., None, :], state.rates[..., None, :]
    own = own_quaternion(state.quaternion, state.mount_angle, yaw)
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(own))
    return euler, own_rates(state.rates, state.mount_angle, state.mount_rate, yaw)


def _turned(angle: Float[Array, "... drones 2"], yaw: Float[Array, " drones"]) -> Float[Array, "... drones 4"]:
    """Rotation of every drone on its hinges, Rz(yaw) Rx Ry Rz(-yaw), as a quaternion."""
    xp = angle.__array_namespace__()
    half = angle / 2
    cosine, sine = xp.cos(half), xp.sin(half)
    (c_roll, c_pitch), (s_roll, s_pitch) = ((part[..., 0], part[..., 1]) for part in (cosine, sine))
    vector = joined([s_roll * c_pitch, c_roll * s_pitch, s_roll * s_pitch])
    return xp.concat([(c_roll * c_pitch)[..., None], rotations.turned_about_z(vector, yaw)], axis=-1)
