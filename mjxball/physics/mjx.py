"""Accelerations of the assembly from MuJoCo MJX: the ball's slide joint is driven, so its reaction acts."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from mjxball.assembly import BALL, build_model
from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.physics.constants import box_inertia_per_mass
from mjxball.physics.engine import Acceleration, PlantState, Wrench
from mjxball.physics.motion import CgState
from mjxball.quiet import import_mjx

Array = Any
SLIDE = 6  # degree of freedom of the ball's joint; 0..5 are the free joint's


def make_acceleration(plant: Plant, attitude: Attitude) -> Acceleration:
    """Return the MJX `engine.Acceleration` of `plant` for one world; use `jax.vmap` for many.

    MJX computes the mass matrix and the bias forces. The ball's acceleration is prescribed, c''; the six
    accelerations of the free joint follow from their own rows, and the force that drives the slide (whose
    reaction moves the assembly) never needs to be formed. Dynamics do not depend on where the assembly is
    or on its linear velocity, so both are zero here: that keeps float32 at its best.
    """
    mjx = import_mjx()
    model = build_model(plant, fuse=True)
    world = mjx.put_model(model)
    blank = mjx.make_data(model)
    ball = model.body(BALL).id
    box = jnp.asarray(box_inertia_per_mass(plant.object_size))

    def acceleration(state: PlantState, wrench: Wrench, object_mass: Array, cg: CgState) -> tuple[Array, Array]:
        dtype = state.rates.dtype
        m = world.replace(
            body_mass=world.body_mass.astype(dtype).at[ball].set(object_mass),
            body_inertia=world.body_inertia.astype(dtype).at[ball].set(object_mass * box.astype(dtype)),
        )
        zero = jnp.zeros(3, dtype)
        data = blank.replace(
            qpos=jnp.concatenate([zero, state.quaternion, cg.offset[None]]),
            qvel=jnp.concatenate([zero, state.rates, cg.rate[None]]),
        )
        for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne):
            data = stage(m, data)
        mass_matrix = mjx.full_m(m, data)
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        applied = jnp.concatenate([rotations.rotate(matrix, wrench.force), wrench.torque])
        force = applied - data.qfrc_bias[:SLIDE] - mass_matrix[:SLIDE, SLIDE] * cg.acceleration
        solution = _solve_free_joint(mass_matrix[:SLIDE, :SLIDE], force)
        return solution[:3], solution[3:]

    return acceleration


def _solve_free_joint(mass_matrix: Array, force: Array) -> Array:
    """Solve M a = f (6,) for a free joint's mass matrix, whose linear block is the total mass times I."""
    mass = mass_matrix[0, 0]
    coupling = mass_matrix[3:, :3]
    central = mass_matrix[3:, 3:] - coupling @ coupling.T / mass
    angular = rotations.solve_symmetric(central, force[3:] - coupling @ force[:3] / mass)
    return jnp.concatenate([(force[:3] - angular @ coupling) / mass, angular])


def jax_repeat(body: Any, count: int, value: Any) -> Any:
    """Apply `body` `count` times in one compiled loop."""
    return jax.lax.scan(lambda carry, _: (body(carry), None), value, None, length=count)[0]
