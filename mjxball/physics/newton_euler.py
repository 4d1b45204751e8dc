"""Closed-form accelerations of the assembly (the paper's section II, corrected; symbols of docs/model.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from mjxball import arrays
from mjxball.arrays import Array
from mjxball.config import Attitude, Plant
from mjxball.control.rotations import cross, dot, matrix_from_quaternion, rotate, solve_symmetric
from mjxball.physics.engine import CgState, Engine, PlantState, Wrench, coordinates, from_coordinates, solve_small
from mjxball.physics.mounts import require_rigid
from mjxball.plant import ROLLING_INERTIA, PlantParameters, plant_parameters
from mjxball.plant.parameters import diagonal, point_inertia, rigid_inertia, rigid_mass, rigid_moment

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Scalar, Vector


class Balance(NamedTuple):
    """M a_b + w' x S = f and S x a_b + J_O w' = n: force and moment balance about O, body axes."""

    mass: Float[Array, "... 1"]  # M [kg]
    moment: Vector  # S [kg m]
    inertia: Float[Array, "... 3 3"]  # J_O [kg m2]
    down: Vector  # u = R^T E3
    force: Vector  # f [N]
    torque: Vector  # n [N m]


def make_engine(plant: Plant, attitude: Attitude, parameters: PlantParameters | None = None) -> Engine:
    """Return the closed-form engine of `plant` on NumPy or JAX arrays of any batch shape.

    `parameters` replace those of `plant`; traced ones may differ from environment to environment.
    """
    require_rigid(plant, "newton-euler")
    params = plant_parameters(plant, attitude) if parameters is None else parameters
    accelerations = {"free": _free, "pivot": _pivot, "heave": _heave}[plant.stand]
    axes, share = plant.directions, params.moving_fraction

    def prescribed(
        state: PlantState, wrench: Wrench, object_mass: Scalar, cg: CgState, added: Vector | None = None
    ) -> tuple[Vector, Vector]:
        offset, rate, acceleration = (_along(axes, value) for value in cg)
        matrix, balance = _balance(params, state, wrench, object_mass, offset, rate, acceleration, added)
        linear, angular = accelerations(balance)
        return rotate(matrix, linear), angular

    def rolling(
        state: PlantState, wrench: Wrench, object_mass: Scalar, ball_force: Array, added: Vector | None = None
    ) -> tuple[Vector, Vector, Array]:
        w, ball_mass = state.rates, share * object_mass
        r, speed = _along(axes, state.ball_offset), _along(axes, state.ball_rate)
        matrix, balance = _balance(params, state, wrench, object_mass, share * r, share * speed, 0.0 * r, added)
        linear, angular = accelerations(balance)
        # m_b e . (a_b + w' x r + w x (w x r) + 2 w x r' + g u + r'') + 2/5 m_b x'' = F for the direction e of each
        # coordinate x of the ball at r; a_b and w' are linear in x''.
        carried = cross(w, cross(w, r)) + 2.0 * cross(w, speed) + params.gravity * balance.down
        known = linear + cross(angular, r) + carried
        forces = coordinates(ball_force, len(axes))
        driving = [force / ball_mass - known[..., axis] for axis, force in zip(axes, forces, strict=True)]
        pushes = [_along((axis,), -ball_mass) for axis in axes]
        recoils = [accelerations(balance._replace(force=push, torque=cross(r, push))) for push in pushes]
        columns = [a + cross(turning, r) for a, turning in recoils]
        rows = [[column[..., axis] for column in columns] for axis in axes]
        for number, row in enumerate(rows):
            row[number] = row[number] + (1 + ROLLING_INERTIA)
        ball = solve_small(rows, driving)
        for one, (a, turning) in zip(ball, recoils, strict=True):
            linear, angular = linear + one[..., None] * a, angular + one[..., None] * turning
        return rotate(matrix, linear), angular, from_coordinates(ball)

    return Engine(prescribed, rolling)


def _along(axes: tuple[int, ...], value: Array) -> Vector:
    """The vector (..., 3) with the coordinates `value` along the body axes `axes` and 0 elsewhere."""
    found = dict(zip(axes, coordinates(value, len(axes)), strict=True))
    zero = 0.0 * found[axes[0]]
    return arrays.joined([found.get(axis, zero) for axis in range(3)])


def _balance(
    params: PlantParameters,
    state: PlantState,
    wrench: Wrench,
    object_mass: Scalar,
    c: Vector,
    rate: Vector,
    acceleration: Vector,
    added: Vector | None,
) -> tuple[Array, Balance]:
    """R and the force and moment balance, with the object's CG at `c` moving with `rate` and `acceleration`.

    Terms quadratic in c are those of the moving mass alone, which is at c / share.
    """
    m, w, g, share = object_mass[..., None], state.rates, params.gravity, params.moving_fraction
    matrix = matrix_from_quaternion(state.quaternion)
    u = matrix[..., 2, :]
    mass = (rigid_mass(params) + object_mass)[..., None]
    moment = rigid_moment(params) + m * c
    own = diagonal(m * params.object_inertia_per_mass)
    inertia = rigid_inertia(params) + own + m[..., None] / share * point_inertia(c)
    if added is not None:
        inertia = inertia + diagonal(added)
    slip = 2.0 * cross(w, rate) + acceleration
    force = wrench.force - mass * g * u - cross(w, cross(w, moment)) - m * slip
    torque = wrench.torque - cross(w, rotate(inertia, w)) - m / share * cross(c, slip) - g * cross(moment, u)
    return matrix, Balance(mass, moment, inertia, u, force, torque)


def _free(balance: Balance) -> tuple[Vector, Vector]:
    """Eliminate a_b: (J_O - (|S|^2 1 - S S^T) / M) w' = n - S x f / M."""
    mass, moment, inertia, _, force, torque = balance
    arm = moment / mass
    angular = solve_symmetric(inertia - mass[..., None] * point_inertia(arm), torque - cross(arm, force))
    return force / mass - cross(angular, arm), angular


def _pivot(balance: Balance) -> tuple[Vector, Vector]:
    """Accelerations if O is fixed and only roll is free."""
    return 0.0 * balance.force, _along((0,), balance.torque[..., 0] / balance.inertia[..., 0, 0])


def _heave(balance: Balance) -> tuple[Vector, Vector]:
    """Accelerations if only roll and the world's vertical are free: a_b = a u."""
    mass, moment, inertia, down, force, torque = balance
    coupling = cross(moment, down)[..., 0]
    matrix = (mass[..., 0], coupling), (coupling, inertia[..., 0, 0])
    rise, roll = solve_small(matrix, (dot(down, force), torque[..., 0]))
    return rise[..., None] * down, _along((0,), roll)
