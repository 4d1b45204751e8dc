"""Closed-form accelerations of the assembly (design section 4: the paper's section II, corrected)."""

from __future__ import annotations

from typing import Any

from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.physics.constants import plant_constants
from mjxball.physics.engine import Acceleration, PlantState, Wrench
from mjxball.physics.motion import CgState

Array = Any


def make_acceleration(plant: Plant, attitude: Attitude) -> Acceleration:
    """Return the closed-form `engine.Acceleration` of `plant`, on NumPy or JAX arrays of any batch shape."""
    constants = plant_constants(plant, attitude)
    drone_mass = float(constants.drone_mass.sum())
    drone_moment = constants.drone_mass @ constants.mounts  # sum m_i r_i (3,) [kg m]

    def acceleration(state: PlantState, wrench: Wrench, object_mass: Array, cg: CgState) -> tuple[Array, Array]:
        rates = state.rates
        xp = rates.__array_namespace__()
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        zero = xp.zeros_like(cg.offset)

        def along_x(value: Array) -> Array:
            return xp.stack([value, zero, zero], axis=-1)

        mass = drone_mass + object_mass
        offset, slide_rate, slide_acceleration = (along_x(value) for value in cg)
        moment = xp.asarray(drone_moment, dtype=rates.dtype) + object_mass[..., None] * offset  # S
        inertia = _inertia_about_origin(xp, constants, rates.dtype, object_mass, cg.offset)  # J_O
        down = plant.gravity * matrix[..., 2, :]  # g R^T E3
        weight = object_mass[..., None]

        coriolis = 2 * rotations.cross(rates, slide_rate) + slide_acceleration
        centripetal = rotations.cross(rates, rotations.cross(rates, moment))
        force = wrench.force - mass[..., None] * down - centripetal - weight * coriolis
        torque = (
            wrench.torque
            - rotations.cross(rates, rotations.rotate(inertia, rates))
            - weight * rotations.cross(offset, coriolis)
            - rotations.cross(moment, down)
        )
        # Eliminate a: (J_O + [S]x[S]x / M) w' = n - S x f / M, the inertia about the assembly's centre of mass.
        arm = moment / mass[..., None]
        central = inertia - mass[..., None, None] * _point_inertia(xp, arm)
        angular = rotations.solve_symmetric(central, torque - rotations.cross(arm, force))
        linear = force / mass[..., None] - rotations.cross(angular, arm)
        return rotations.rotate(matrix, linear), angular

    return acceleration


def _point_inertia(xp: Any, r: Array) -> Array:
    """|r|^2 I - r r^T (..., 3, 3) of `r` (..., 3)."""
    square = (r * r).sum(axis=-1)[..., None, None]
    return square * xp.eye(3, dtype=r.dtype) - r[..., :, None] * r[..., None, :]


def _inertia_about_origin(xp: Any, constants: Any, dtype: Any, object_mass: Array, offset: Array) -> Array:
    box = xp.asarray(constants.box_inertia_per_mass, dtype=dtype)
    square = offset * offset
    moving = xp.stack([xp.zeros_like(square), square, square], axis=-1)
    diagonal = object_mass[..., None] * (box + moving)
    return xp.asarray(constants.drone_inertia, dtype=dtype) + diagonal[..., None, :] * xp.eye(3, dtype=dtype)
