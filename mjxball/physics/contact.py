"""Wrenches that the drones exert on the object at their mounts (paper eqs. 1-2, docs/model.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjxball.config import Plant
from mjxball.control import mixer, rotations
from mjxball.control.constants import PlantConstants
from mjxball.physics.engine import PlantState

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Array, Vector


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
