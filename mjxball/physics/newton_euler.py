"""Closed-form accelerations of the assembly (the paper's section II, corrected: docs/model.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from mjxball.arrays import Array
from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.physics.engine import CgState, Engine, PlantState, Wrench, coordinates, joined
from mjxball.plant import ROLLING_INERTIA, PlantParameters, parts, plant_parameters
from mjxball.plant.parameters import rigid_inertia, rigid_mass, rigid_moment, shell_and_ball
from mjxball.plant.parts import Part, Parts, Rows

if TYPE_CHECKING:
    from mjxball.physics.engine import Scalar, Vector


class Balance(NamedTuple):
    """Force and moment balance of the assembly about O, body axes, by component (docs/model.md)."""

    mass: Part  # M [kg]
    moment: Parts  # S [kg m]
    inertia: Rows  # J_O [kg m2]
    down: Parts  # u = R^T E3
    force: Parts  # right-hand side f [N]
    torque: Parts  # right-hand side n [N m]


def make_engine(plant: Plant, attitude: Attitude, parameters: PlantParameters | None = None) -> Engine:
    """Return the closed-form engine of `plant`, on NumPy or JAX arrays of any batch shape.

    `parameters`: its numbers, if they are not those of `plant`; traced ones may differ from world to world.
    """
    numbers = plant_parameters(plant, attitude) if parameters is None else parameters
    solve = {"free": _solve_free, "pivot": _solve_pivot, "heave": _solve_heave}[plant.stand]
    axes = plant.directions
    share, gravity = parts.entry(numbers.moving_fraction), parts.entry(numbers.gravity)

    def prescribed(
        state: PlantState, wrench: Wrench, object_mass: Scalar, cg: CgState, added: Vector | None = None
    ) -> tuple[Vector, Vector]:
        offset, rate, acceleration = (_along(axes, value) for value in cg)
        matrix, balance = _balance(numbers, state, wrench, object_mass, offset, rate, added)
        drawn = parts.scale(-object_mass, acceleration)
        balance = balance._replace(
            force=parts.add(balance.force, drawn),
            torque=parts.add(balance.torque, _over(parts.cross(offset, drawn), share)),
        )
        return _in_world(matrix, *solve(balance), state)

    def rolling(
        state: PlantState, wrench: Wrench, object_mass: Scalar, ball_force: Array, added: Vector | None = None
    ) -> tuple[Vector, Vector, Array]:
        ball_mass = parts.times(share, object_mass)
        place, speed = _along(axes, state.ball_offset), _along(axes, state.ball_rate)
        offset, rate = parts.scale(share, place), parts.scale(share, speed)
        matrix, balance = _balance(numbers, state, wrench, object_mass, offset, rate, added)
        linear, angular = solve(balance)
        rates = parts.split(state.rates)
        # m_b e . (a_b + w' x r + w x (w x r) + 2 w x r' + g u + r'') + 2/5 m_b x'' = F for the direction e of each
        # coordinate x of the ball at r; a_b and w' are linear in x''.
        carried = parts.add(parts.cross(rates, parts.cross(rates, place)), parts.scale(2.0, parts.cross(rates, speed)))
        known = parts.add(_at(linear, angular, place), parts.add(carried, parts.scale(gravity, balance.down)))
        driving = [
            force / ball_mass - known[axis]
            for axis, force in zip(axes, coordinates(ball_force, len(axes)), strict=True)
        ]
        recoils = []
        for axis in axes:
            push: Parts = tuple(-ball_mass if k == axis else 0.0 for k in range(3))  # type: ignore[assignment]
            recoils.append(solve(balance._replace(force=push, torque=parts.cross(place, push))))
        columns = [_at(*recoil, place) for recoil in recoils]
        inertia = [
            [(1 + ROLLING_INERTIA if i == j else 0.0) + columns[j][axis] for j in range(len(axes))]
            for i, axis in enumerate(axes)
        ]
        ball = parts.solve_small(inertia, driving)
        for one, (a, w) in zip(ball, recoils, strict=True):
            linear, angular = parts.add(linear, parts.scale(one, a)), parts.add(angular, parts.scale(one, w))
        return *_in_world(matrix, linear, angular, state), joined(ball)

    return Engine(prescribed, rolling)


def _along(axes: tuple[int, ...], value: Array) -> Parts:
    """The vector whose coordinates along the body axes `axes` are `value`."""
    found: list[Part] = [0.0, 0.0, 0.0]
    for axis, part in zip(axes, coordinates(value, len(axes)), strict=True):
        found[axis] = part
    return found[0], found[1], found[2]


def _over(vector: Parts, divisor: Part) -> Parts:
    return parts.over(vector[0], divisor), parts.over(vector[1], divisor), parts.over(vector[2], divisor)


def _at(linear: Parts, angular: Parts, place: Parts) -> Parts:
    """Acceleration at `place` from that of O and the angular one, without what velocities contribute."""
    return parts.add(linear, parts.cross(angular, place))


def _in_world(matrix: Array, linear: Parts, angular: Parts, state: PlantState) -> tuple[Vector, Vector]:
    like = state.rates[..., 0]
    return rotations.rotate(matrix, parts.stacked(linear, like)), parts.stacked(angular, like)


def _balance(
    numbers: PlantParameters,
    state: PlantState,
    wrench: Wrench,
    object_mass: Scalar,
    offset: Parts,
    rate: Parts,
    added: Vector | None,
) -> tuple[Array, Balance]:
    """R, and the balance without the term of c''; `offset` and `rate` of the object's CG."""
    share, gravity = parts.entry(numbers.moving_fraction), parts.entry(numbers.gravity)
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    rates, down = parts.split(state.rates), parts.split(matrix[..., 2, :])  # u = R^T E3
    mass = parts.plus(rigid_mass(numbers), object_mass)
    moment = parts.add(rigid_moment(numbers), parts.scale(object_mass, offset))
    inertia = _inertia(numbers, object_mass, offset, added)
    slip = parts.scale(2.0, parts.cross(rates, rate))
    swing = parts.cross(rates, parts.cross(rates, moment))
    force = parts.subtract(parts.split(wrench.force), parts.scale(parts.times(gravity, mass), down))
    force = parts.subtract(parts.subtract(force, swing), parts.scale(object_mass, slip))
    gyration = parts.cross(rates, parts.rotate(inertia, rates))
    dragged = parts.scale(parts.over(object_mass, share), parts.cross(offset, slip))
    weight = parts.scale(gravity, parts.cross(moment, down))
    torque = parts.subtract(parts.split(wrench.torque), gyration)
    torque = parts.subtract(parts.subtract(torque, dragged), weight)
    return matrix, Balance(mass, moment, inertia, down, force, torque)


def _inertia(numbers: PlantParameters, object_mass: Scalar, offset: Parts, added: Vector | None) -> Rows:
    """J_O: drones, carrier, shell and ball, which sits at c / share, and what is added."""
    shell, ball = shell_and_ball(numbers)
    share = parts.entry(numbers.moving_fraction)
    spread = [_over(row, share) for row in parts.point_inertia(offset)]
    per_mass = parts.add_rows(parts.diagonal(parts.add(shell, ball)), (spread[0], spread[1], spread[2]))
    load = parts.scale_rows(object_mass, per_mass)
    if added is not None:
        load = parts.add_rows(load, parts.diagonal(parts.split(added)))
    return parts.add_rows(rigid_inertia(numbers), load)


def _solve_free(balance: Balance) -> tuple[Parts, Parts]:
    """Eliminate a_b: (J_O + [S]x[S]x / M) w' = n - S x f / M, the inertia about the assembly's centre of mass."""
    mass, moment, inertia, _, force, torque = balance
    arm = _over(moment, mass)
    off = parts.scale_rows(mass, parts.point_inertia(arm))
    central = tuple(parts.subtract(a, b) for a, b in zip(inertia, off, strict=True))
    angular = parts.solve_symmetric(central, parts.subtract(torque, parts.cross(arm, force)))  # type: ignore[arg-type]
    return parts.subtract(_over(force, mass), parts.cross(angular, arm)), angular


def _solve_pivot(balance: Balance) -> tuple[Parts, Parts]:
    """O stands still and only roll is free."""
    return parts.ZERO, (parts.over(balance.torque[0], balance.inertia[0][0]), 0.0, 0.0)


def _solve_heave(balance: Balance) -> tuple[Parts, Parts]:
    """Only roll and the world's vertical are free: a_b = a u."""
    mass, moment, inertia, down, force, torque = balance
    coupling = parts.cross(moment, down)[0]
    lift, twist, j = parts.dot(down, force), torque[0], inertia[0][0]
    determinant = parts.minus(parts.times(mass, j), parts.times(coupling, coupling))
    rise = parts.over(parts.minus(parts.times(j, lift), parts.times(coupling, twist)), determinant)
    roll = parts.over(parts.minus(parts.times(mass, twist), parts.times(coupling, lift)), determinant)
    return parts.scale(rise, down), (roll, 0.0, 0.0)
