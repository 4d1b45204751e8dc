"""Closed-form accelerations of the assembly (the paper's section II, corrected: docs/model.md)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.control.constants import ROLLING_INERTIA, PlantConstants, plant_constants
from mjxball.physics.engine import Array, CgState, Engine, PlantState, Wrench

if TYPE_CHECKING:
    from mjxball.physics.engine import Matrix, Scalar, Vector

# solve(mass, moment S, inertia J_O, down u = R^T E3, force, torque) -> (a_b, w') in body axes
Solve = Callable[[Array, Array, Array, Array, Array, Array], tuple[Array, Array]]


def make_engine(plant: Plant, attitude: Attitude) -> Engine:
    """Return the closed-form engine of `plant`, on NumPy or JAX arrays of any batch shape."""
    constants = plant_constants(plant, attitude)
    solve = {"free": _solve_free, "pivot": _solve_pivot, "heave": _solve_heave}[plant.stand]
    axis = "xy".index(plant.cg_axis)

    def prescribed(
        state: PlantState, wrench: Wrench, object_mass: Scalar, cg: CgState, added: Vector | None = None
    ) -> tuple[Vector, Vector]:
        terms = _terms(plant, constants, state, wrench, object_mass, cg, added)
        matrix, (mass, moment, inertia, down, force, torque) = terms
        pushed = _shift(force, axis, -object_mass * cg.acceleration)
        linear, angular = solve(mass, moment, inertia, down, pushed, torque)
        return rotations.rotate(matrix, linear), angular

    def rolling(
        state: PlantState, wrench: Wrench, object_mass: Scalar, ball_force: Scalar, added: Vector | None = None
    ) -> tuple[Vector, Vector, Scalar]:
        xp = state.rates.__array_namespace__()
        share = plant.moving_fraction
        ball_mass = share * object_mass
        cg = CgState(share * state.ball_offset, share * state.ball_rate, xp.zeros_like(ball_mass))
        terms = _terms(plant, constants, state, wrench, object_mass, cg, added)
        matrix, (mass, moment, inertia, down, force, torque) = terms
        linear, angular = solve(mass, moment, inertia, down, force, torque)
        recoil = _shift(xp.zeros_like(force), axis, -ball_mass)
        linear_1, angular_1 = solve(mass, moment, inertia, down, recoil, xp.zeros_like(torque))
        # m_b (e . a_b + x (w_e^2 - |w|^2) + g e . u + x'') + 2/5 m_b x'' = F, and a_b is linear in x''.
        rates = state.rates
        spin = state.ball_offset * (rates[..., axis] ** 2 - rotations.dot(rates, rates))
        driving = ball_force / ball_mass - linear[..., axis] - spin - plant.gravity * down[..., axis]
        ball = driving / (1 + ROLLING_INERTIA + linear_1[..., axis])
        linear, angular = linear + ball[..., None] * linear_1, angular + ball[..., None] * angular_1
        return rotations.rotate(matrix, linear), angular, ball

    return Engine(prescribed, rolling)


def _shift(vector: Vector, axis: int, amount: Scalar) -> Vector:
    """`vector` with `amount` added to component `axis`."""
    xp = vector.__array_namespace__()
    return xp.stack([vector[..., i] + amount if i == axis else vector[..., i] for i in range(3)], axis=-1)


def _terms(
    plant: Plant,
    constants: PlantConstants,
    state: PlantState,
    wrench: Wrench,
    object_mass: Scalar,
    cg: CgState,
    added: Vector | None,
) -> tuple[Matrix, tuple[Scalar, Vector, Matrix, Vector, Vector, Vector]]:
    """R, and (M, S, J_O, u, f, n) of docs/model.md without the term of c''."""
    rates = state.rates
    xp = rates.__array_namespace__()
    axis, share = "xy".index(plant.cg_axis), plant.moving_fraction
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    down = matrix[..., 2, :]  # u = R^T E3
    zero = xp.zeros_like(rates)
    mass = float(constants.drone_mass.sum()) + object_mass
    moment = _shift(zero + xp.asarray(constants.drone_moment, dtype=rates.dtype), axis, object_mass * cg.offset)
    inertia = _inertia(plant, constants, rates.dtype, object_mass, cg.offset, added)
    offset, rate = _shift(zero, axis, cg.offset), _shift(zero, axis, cg.rate)
    weight = object_mass[..., None]
    slip = 2 * rotations.cross(rates, rate)
    swing = rotations.cross(rates, rotations.cross(rates, moment))
    force = wrench.force - (plant.gravity * mass)[..., None] * down - swing - weight * slip
    torque = (
        wrench.torque
        - rotations.cross(rates, rotations.rotate(inertia, rates))
        - weight / share * rotations.cross(offset, slip)
        - plant.gravity * rotations.cross(moment, down)
    )
    return matrix, (mass, moment, inertia, down, force, torque)


def _inertia(
    plant: Plant, constants: PlantConstants, dtype: Any, object_mass: Scalar, offset: Scalar, added: Vector | None
) -> Matrix:
    """J_O: drones, shell and ball, which sits at c / share, and what is added."""
    xp = object_mass.__array_namespace__()
    own = xp.asarray(constants.object_inertia_per_mass, dtype=dtype)
    square = offset * offset / plant.moving_fraction
    still = xp.zeros_like(square)
    moving = [still if name == plant.cg_axis else square for name in "xyz"]
    drones = xp.asarray(constants.drone_inertia, dtype=dtype)
    rows = []
    for i in range(3):
        diagonal = object_mass * (own[i] + moving[i])
        if added is not None:
            diagonal = diagonal + added[..., i]
        rows.append(xp.stack([drones[i, j] + (diagonal if i == j else still) for j in range(3)], axis=-1))
    return xp.stack(rows, axis=-2)


def _solve_free(
    mass: Scalar, moment: Vector, inertia: Matrix, down: Vector, force: Vector, torque: Vector
) -> tuple[Vector, Vector]:
    """Eliminate a_b: (J_O + [S]x[S]x / M) w' = n - S x f / M, the inertia about the assembly's centre of mass."""
    arm = moment / mass[..., None]
    central = inertia - mass[..., None, None] * rotations.point_inertia(arm)
    angular = rotations.solve_symmetric(central, torque - rotations.cross(arm, force))
    return force / mass[..., None] - rotations.cross(angular, arm), angular


def _solve_pivot(
    mass: Scalar, moment: Vector, inertia: Matrix, down: Vector, force: Vector, torque: Vector
) -> tuple[Vector, Vector]:
    """O stands still and only roll is free."""
    xp = torque.__array_namespace__()
    roll = torque[..., 0] / inertia[..., 0, 0]
    still = xp.zeros_like(roll)
    return xp.zeros_like(force), xp.stack([roll, still, still], axis=-1)


def _solve_heave(
    mass: Scalar, moment: Vector, inertia: Matrix, down: Vector, force: Vector, torque: Vector
) -> tuple[Vector, Vector]:
    """Only roll and the world's vertical are free: a_b = a u."""
    xp = torque.__array_namespace__()
    coupling = rotations.cross(moment, down)[..., 0]
    lift, twist, j = rotations.dot(down, force), torque[..., 0], inertia[..., 0, 0]
    determinant = mass * j - coupling * coupling
    rise = (j * lift - coupling * twist) / determinant
    roll = (mass * twist - coupling * lift) / determinant
    still = xp.zeros_like(roll)
    return rise[..., None] * down, xp.stack([roll, still, still], axis=-1)
