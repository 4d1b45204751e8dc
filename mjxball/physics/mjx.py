"""Accelerations of the assembly from MuJoCo MJX, with the ball on slide joints that are driven or roll freely."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.arrays import matmul
from mjxball.assembly import ASSEMBLY, BALL, build_model, drone_names
from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.physics.engine import CgState, Engine, PlantState, Wrench, solve_small
from mjxball.physics.mounts import require_rigid
from mjxball.plant import ROLLING_INERTIA, PlantParameters, plant_parameters
from mjxball.quiet import import_mjx

if TYPE_CHECKING:
    from jax import Array
    from jaxtyping import Float

    from mjxball.physics.engine import Coordinates, Scalar, Vector


def make_engine(plant: Plant, attitude: Attitude, parameters: PlantParameters | None = None) -> Engine:
    """Return the MJX engine of `plant` for one environment; use `jax.vmap` for many.

    `parameters` replace those of `plant`; traced ones may differ from environment to environment.

    MJX computes the mass matrix and the bias forces. If the ball's acceleration c'' is prescribed, the root's
    accelerations follow from the root's rows, and the force that drives the slides need not be computed; a rolling ball
    adds its rows. The dynamics do not depend on the assembly's position or linear velocity, so both are 0 here, which
    keeps float32 as accurate as possible.
    """
    require_rigid(plant, "mjx")
    stages = _Stages(plant, plant_parameters(plant, attitude), parameters)
    share = stages.parameters.moving_fraction

    def prescribed(
        state: PlantState, wrench: Wrench, object_mass: Scalar, cg: CgState, added: Vector | None = None
    ) -> tuple[Vector, Vector]:
        offset, rate, acceleration = (jnp.atleast_1d(value) / share for value in cg)
        mass, bias = stages.equations(state, object_mass, offset, rate, added)
        n = stages.root
        force = stages.applied(state, wrench) - bias[:n]
        for k in range(stages.slides):
            force = force - mass[:n, n + k] * acceleration[k]
        return stages.result(state, _solve(mass[:n, :n], force))

    def rolling(
        state: PlantState, wrench: Wrench, object_mass: Scalar, ball_force: Coordinates, added: Vector | None = None
    ) -> tuple[Vector, Vector, Coordinates]:
        offset, rate, pushed = map(jnp.atleast_1d, (state.ball_offset, state.ball_rate, ball_force))
        mass, bias = stages.equations(state, object_mass, offset, rate, added)
        n, slides = stages.root, range(stages.slides)
        driven = _solve(mass[:n, :n], stages.applied(state, wrench) - bias[:n])
        recoils = [_solve(mass[:n, :n], -mass[:n, n + k]) for k in slides]
        driving = [pushed[k] - bias[n + k] - matmul(mass[n + k, :n], driven) for k in slides]
        inertia = [[mass[n + i, n + j] + matmul(mass[n + i, :n], recoils[j]) for j in slides] for i in slides]
        ball = solve_small(inertia, driving)
        for acceleration, recoil in zip(ball, recoils, strict=True):
            driven = driven + acceleration * recoil
        return *stages.result(state, driven), ball[0] if stages.slides == 1 else jnp.stack(ball)

    return Engine(prescribed, rolling)


class _Stages:
    """MJX's smooth dynamics of one plant with the object's mass as an argument."""

    def __init__(self, plant: Plant, nominal: PlantParameters, parameters: PlantParameters | None):
        self._mjx = import_mjx()
        self.parameters = nominal if parameters is None else parameters
        # Merging the welded bodies is exact and faster. A shell of varying mass must stay a separate body, and so must
        # drones whose parameters differ from the model's.
        self._fused = plant.moving_fraction == 1 and parameters is None
        model = build_model(plant, fuse=self._fused)
        # By default MJX takes the first device of all processes, which only the first process can reach.
        here = {"device": jax.local_devices()[0], "impl": "jax"}
        self._model, self._blank = self._mjx.put_model(model, **here), self._mjx.make_data(model, **here)
        self._assembly, self._ball = model.body(ASSEMBLY).id, model.body(BALL).id
        self._drones = None if parameters is None else np.array([model.body(name).id for name in drone_names(plant)])
        self._stand, self.slides = plant.stand, len(plant.directions)
        self.root = model.nv - self.slides  # degrees of freedom of the root; the ball's slides come last

    def equations(
        self,
        state: PlantState,
        object_mass: Scalar,
        offset: Float[Array, " slides"],
        rate: Float[Array, " slides"],
        added: Vector | None,
    ) -> tuple[Float[Array, "nv nv"], Float[Array, " nv"]]:
        """Mass matrix and bias force with the ball at `offset` [m] moving at `rate` [m/s]; `added` is inertia."""
        dtype = state.rates.dtype
        zero = jnp.zeros((), dtype)
        if self._stand == "free":
            position, velocity = [jnp.zeros(3, dtype), state.quaternion], [jnp.zeros(3, dtype), state.rates]
        else:
            heave = [zero[None]] if self._stand == "heave" else []
            position = [*heave, rotations.roll_of_quaternion(state.quaternion)[None]]
            velocity = [*heave, state.rates[:1]]
        model = self._loaded(object_mass, dtype)
        data = self._blank.replace(qpos=jnp.concatenate([*position, offset]), qvel=jnp.concatenate([*velocity, rate]))
        mjx = self._mjx
        with jax.default_matmul_precision("highest"):  # see `arrays.matmul`
            for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.com_vel, mjx.rne):
                data = stage(model, data)
        mass, bias = _mass_matrix(model, data), data.qfrc_bias
        return (mass, bias) if added is None else self._spun(state, mass, bias, added)

    def _spun(
        self, state: PlantState, mass: Float[Array, "nv nv"], bias: Float[Array, " nv"], added: Vector
    ) -> tuple[Float[Array, "nv nv"], Float[Array, " nv"]]:
        """Add inertia `added` about the body axes through O, without mass, to the root's rotation."""
        n = self.root
        axes = slice(3, 6) if self._stand == "free" else slice(n - 1, n)
        gyration = rotations.cross(state.rates, added * state.rates)
        inertia = added if self._stand == "free" else added[:1]
        gyration = gyration if self._stand == "free" else 0.0 * added[:1]
        return mass.at[axes, axes].add(jnp.diag(inertia)), bias.at[axes].add(gyration)

    def _loaded(self, object_mass: Scalar, dtype: Any) -> Any:
        m, own = self._model, self.parameters
        mass, inertia, armature = (a.astype(dtype) for a in (m.body_mass, m.body_inertia, m.dof_armature))
        share = own.moving_fraction
        moving = object_mass * share
        mass = mass.at[self._ball].set(moving)
        inertia = inertia.at[self._ball].set(object_mass * jnp.asarray(own.ball_inertia_per_mass, dtype))
        if not self._fused:
            mass = mass.at[self._assembly].set(object_mass * (1 - share) + own.carrier_mass)
            shell = object_mass * jnp.asarray(own.shell_inertia_per_mass, dtype)
            inertia = inertia.at[self._assembly].set(shell + jnp.asarray(own.carrier_inertia, dtype))
        changed = {}
        if self._drones is not None:
            mass = mass.at[self._drones].set(own.drone_mass)
            inertia = inertia.at[self._drones].set(own.own_inertia)
            half, still = 0.5 * jnp.asarray(own.yaw, dtype), jnp.zeros(len(self._drones), dtype)
            turned = jnp.stack([jnp.cos(half), still, still, jnp.sin(half)], axis=-1)
            changed["body_pos"] = m.body_pos.astype(dtype).at[self._drones].set(own.mounts)
            changed["body_quat"] = m.body_quat.astype(dtype).at[self._drones].set(turned)
        return m.replace(
            body_mass=mass,
            body_inertia=inertia,
            dof_armature=armature.at[self.root :].set(ROLLING_INERTIA * moving),
            **changed,
        )

    def applied(self, state: PlantState, wrench: Wrench) -> Float[Array, " root"]:
        """Generalized force of the rotors on the root."""
        force = rotations.rotate(rotations.matrix_from_quaternion(state.quaternion), wrench.force)
        if self._stand == "free":
            return jnp.concatenate([force, wrench.torque])
        heave = [force[2:]] if self._stand == "heave" else []
        return jnp.concatenate([*heave, wrench.torque[:1]])

    def result(self, state: PlantState, solution: Float[Array, " root"]) -> tuple[Vector, Vector]:
        """Acceleration of O in the world and angular acceleration in body axes from the root's accelerations."""
        if self._stand == "free":
            return solution[:3], solution[3:]
        zero = jnp.zeros((), solution.dtype)
        rise = solution[0] if self._stand == "heave" else zero
        return jnp.stack([zero, zero, rise]), jnp.stack([solution[-1], zero, zero])


def _mass_matrix(model: Any, data: Any) -> Float[Array, "nv nv"]:
    """The mass matrix of degrees of freedom in one chain, as `mjx.full_m`, from MJX's composite inertias.

    Written as sums: a small matrix product for each environment takes XLA a third of the step on a CPU.
    """
    composite, motion = data._impl.crb[np.asarray(model.dof_bodyid)], data.cdof
    (xx, yy, zz, xy, xz, yz), moment, mass = composite[:, :6].T, composite[:, 6:9], composite[:, 9:]
    turning, moving = motion[:, :3], motion[:, 3:]
    x, y, z = turning.T
    spin = jnp.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], axis=-1)
    momentum = jnp.concatenate(
        [spin + rotations.cross(moment, moving), mass * moving - rotations.cross(moment, turning)], axis=-1
    )
    lower = sum(momentum[:, None, k] * motion[None, :, k] for k in range(6))
    below = np.tri(model.nv, dtype=bool)
    return jnp.where(below, lower, lower.T) + jnp.diag(model.dof_armature)


def _solve(mass: Float[Array, "root root"], force: Float[Array, " root"]) -> Float[Array, " root"]:
    """Solve M a = f for a root of size 6 (free joint, whose linear block is the total mass times I), 2 or 1."""
    if len(force) <= 2:
        return jnp.stack(solve_small(mass, force))
    total, coupling = mass[0, 0], mass[3:, :3]
    rows = [coupling[i] for i in range(3)]
    squares = jnp.stack([jnp.stack([rotations.dot(a, b) for b in rows]) for a in rows])
    push = jnp.stack([rotations.dot(row, force[:3]) for row in rows])
    angular = rotations.solve_symmetric(mass[3:, 3:] - squares / total, force[3:] - push / total)
    back = rotations.rotate_back(coupling, angular)
    return jnp.concatenate([(force[:3] - back) / total, angular])
