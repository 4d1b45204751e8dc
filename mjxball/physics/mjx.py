"""Accelerations of the assembly from MuJoCo MJX: the ball's slide joint is driven or rolls, its reaction acts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.assembly import ASSEMBLY, BALL, build_model
from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.control.constants import ROLLING_INERTIA, plant_constants
from mjxball.physics.engine import CgState, Engine, PlantState, Wrench
from mjxball.quiet import import_mjx

if TYPE_CHECKING:
    from jax import Array
    from jaxtyping import Float

    from mjxball.physics.engine import Scalar, Vector


def make_engine(plant: Plant, attitude: Attitude) -> Engine:
    """Return the MJX engine of `plant` for one world; use `jax.vmap` for many.

    MJX computes the mass matrix and the bias forces. With the ball's acceleration c'' prescribed, the root's
    accelerations follow from their own rows, and the force that drives the slide (whose reaction moves the
    assembly) never needs to be formed; a rolling ball adds its own row. Dynamics do not depend on where the
    assembly is or on its linear velocity, so both are zero here: that keeps float32 at its best.
    """
    stages = _Stages(plant, attitude)
    share = plant.moving_fraction

    def prescribed(
        state: PlantState, wrench: Wrench, object_mass: Scalar, cg: CgState, added: Vector | None = None
    ) -> tuple[Vector, Vector]:
        mass, bias = stages.equations(state, object_mass, cg.offset / share, cg.rate / share, added)
        n = stages.root
        force = stages.applied(state, wrench) - bias[:n] - mass[:n, n] * (cg.acceleration / share)
        return stages.result(state, _solve(mass[:n, :n], force))

    def rolling(
        state: PlantState, wrench: Wrench, object_mass: Scalar, ball_force: Scalar, added: Vector | None = None
    ) -> tuple[Vector, Vector, Scalar]:
        mass, bias = stages.equations(state, object_mass, state.ball_offset, state.ball_rate, added)
        n = stages.root
        driven = _solve(mass[:n, :n], stages.applied(state, wrench) - bias[:n])
        recoil = _solve(mass[:n, :n], -mass[:n, n])
        ball = (ball_force - bias[n] - mass[n, :n] @ driven) / (mass[n, n] + mass[n, :n] @ recoil)
        return *stages.result(state, driven + ball * recoil), ball

    return Engine(prescribed, rolling)


class _Stages:
    """MJX's smooth dynamics of one plant, with the object's mass as an argument."""

    def __init__(self, plant: Plant, attitude: Attitude):
        self._mjx = import_mjx()
        constants = plant_constants(plant, attitude)
        # Merging the welded bodies is exact and faster; a shell whose mass varies must stay a body of its own.
        model = build_model(plant, fuse=plant.moving_fraction == 1)
        # MJX's own choice is the first device of all processes, which only the first process can reach.
        here = {"device": jax.local_devices()[0], "impl": "jax"}
        self._model, self._blank = self._mjx.put_model(model, **here), self._mjx.make_data(model, **here)
        self._bodies = np.array([model.body(ASSEMBLY).id, model.body(BALL).id])
        self._fractions = np.array([1 - plant.moving_fraction, plant.moving_fraction])
        self._inertias = np.array([constants.shell_inertia_per_mass, constants.ball_inertia_per_mass])
        self._stand, self._rigid = plant.stand, plant.moving_fraction == 1
        self.root = model.nv - 1  # degrees of freedom of the root; the ball's slide comes last

    def equations(
        self, state: PlantState, object_mass: Scalar, offset: Scalar, rate: Scalar, added: Vector | None
    ) -> tuple[Float[Array, "nv nv"], Float[Array, " nv"]]:
        """Mass matrix and bias force, ball at `offset` moving at `rate`; inertia is `added`."""
        dtype = state.rates.dtype
        zero = jnp.zeros((), dtype)
        if self._stand == "free":
            position, velocity = [jnp.zeros(3, dtype), state.quaternion], [jnp.zeros(3, dtype), state.rates]
        else:
            heave = [zero[None]] if self._stand == "heave" else []
            position = [*heave, rotations.roll_of_quaternion(state.quaternion)[None]]
            velocity = [*heave, state.rates[:1]]
        model = self._loaded(object_mass, dtype)
        data = self._blank.replace(
            qpos=jnp.concatenate([*position, offset[None]]), qvel=jnp.concatenate([*velocity, rate[None]])
        )
        mjx = self._mjx
        for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne):
            data = stage(model, data)
        mass, bias = mjx.full_m(model, data), data.qfrc_bias
        return (mass, bias) if added is None else self._spun(state, mass, bias, added)

    def _spun(
        self, state: PlantState, mass: Float[Array, "nv nv"], bias: Float[Array, " nv"], added: Vector
    ) -> tuple[Float[Array, "nv nv"], Float[Array, " nv"]]:
        """With inertia about the body axes through O, without mass, on the root's rotation."""
        n = self.root
        axes = slice(3, 6) if self._stand == "free" else slice(n - 1, n)
        gyration = rotations.cross(state.rates, added * state.rates)
        inertia = added if self._stand == "free" else added[:1]
        gyration = gyration if self._stand == "free" else 0.0 * added[:1]
        return mass.at[axes, axes].add(jnp.diag(inertia)), bias.at[axes].add(gyration)

    def _loaded(self, object_mass: Scalar, dtype: Any) -> Any:
        m = self._model
        mass, inertia, armature = (a.astype(dtype) for a in (m.body_mass, m.body_inertia, m.dof_armature))
        part = slice(1, None) if self._rigid else slice(None)
        bodies, fractions, inertias = self._bodies[part], self._fractions[part], self._inertias[part]
        return m.replace(
            body_mass=mass.at[bodies].set(object_mass * fractions.astype(dtype)),
            body_inertia=inertia.at[bodies].set(object_mass * inertias.astype(dtype)),
            dof_armature=armature.at[-1].set(ROLLING_INERTIA * object_mass * self._fractions[1].astype(dtype)),
        )

    def applied(self, state: PlantState, wrench: Wrench) -> Float[Array, " root"]:
        """Generalized force of the rotors on the root."""
        force = rotations.rotate(rotations.matrix_from_quaternion(state.quaternion), wrench.force)
        if self._stand == "free":
            return jnp.concatenate([force, wrench.torque])
        heave = [force[2:]] if self._stand == "heave" else []
        return jnp.concatenate([*heave, wrench.torque[:1]])

    def result(self, state: PlantState, solution: Float[Array, " root"]) -> tuple[Vector, Vector]:
        """Accelerations of O in the world and about the body axes from the root's."""
        if self._stand == "free":
            return solution[:3], solution[3:]
        zero = jnp.zeros((), solution.dtype)
        rise = solution[0] if self._stand == "heave" else zero
        return jnp.stack([zero, zero, rise]), jnp.stack([solution[-1], zero, zero])


def _solve(mass: Float[Array, "root root"], force: Float[Array, " root"]) -> Float[Array, " root"]:
    """Solve M a = f for the root: 6 (free joint, whose linear block is the total mass times I), 2 or 1."""
    if mass.shape[0] == 1:
        return force / mass[0]
    if mass.shape[0] == 2:
        (a, b), (_, c) = mass
        return jnp.stack([c * force[0] - b * force[1], a * force[1] - b * force[0]]) / (a * c - b * b)
    total, coupling = mass[0, 0], mass[3:, :3]
    rows = [coupling[i] for i in range(3)]
    squares = jnp.stack([jnp.stack([rotations.dot(a, b) for b in rows]) for a in rows])
    push = jnp.stack([rotations.dot(row, force[:3]) for row in rows])
    angular = rotations.solve_symmetric(mass[3:, 3:] - squares / total, force[3:] - push / total)
    back = rotations.rotate_back(coupling, angular)
    return jnp.concatenate([(force[:3] - back) / total, angular])


def jax_repeat(body: Any, count: int, value: Any) -> Any:
    """Apply `body` `count` times in one compiled loop."""
    return jax.lax.scan(lambda carry, _: (body(carry), None), value, None, length=count)[0]
