"""Free fall with a driven CG conserves momentum; the object's own Newton-Euler equations hold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from euler_angles import matrix_from_euler
from plants import LIGHT_BALL, REFERENCE, VARIED, copying, paper_with, team

from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.physics import mujoco, newton_euler
from mjxball.physics.engine import CgState, Engine, PathShape, PlantState, Wrench
from mjxball.physics.motion import lissajous, sine
from mjxball.plant import plant_parameters
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

WORLDS = 4
STEP = 0.001  # [s], classical Runge-Kutta of order 4
SECONDS = 1.0
SHAPE = PathShape(np.full(WORLDS, 0.4), np.full(WORLDS, 0.7), np.full(WORLDS, 1.5), np.full(WORLDS, 1.0))


def derivative(engine: Engine, mass: np.ndarray, path: Callable, sines: tuple, state: PlantState) -> PlantState:
    """d/dt of the state in free fall, rotors off."""
    zero = np.zeros((WORLDS, 3))
    linear, angular = engine.prescribed(state, Wrench(zero, zero), mass, path(state.time, *sines))
    spin = np.concatenate([np.zeros((WORLDS, 1)), state.rates], axis=-1)
    turn = rotations.multiply_quaternions(state.quaternion, spin) / 2
    still = np.zeros(WORLDS)
    motor = 0 * state.rotor_force
    return PlantState(state.velocity, turn, linear, angular, motor, still, np.ones(WORLDS), still, still)


def advance(state: PlantState, rate: PlantState, h: float) -> PlantState:
    return state.each(lambda value, change: value + h * change, rate)


def along(plant: Plant, value: np.ndarray) -> np.ndarray:
    """The vector (n, 3) of coordinates along the load's directions."""
    found = np.zeros((len(value), 3))
    found[:, list(plant.directions)] = value.reshape(len(value), -1)
    return found


def momenta(plant: Plant, mass: np.ndarray, cg: CgState, state: PlantState) -> tuple[np.ndarray, np.ndarray]:
    """Linear momentum, and angular momentum about the moving centre of mass, summed body by body in the world."""
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    constants, share = plant_parameters(plant, Attitude()), plant.moving_fraction
    ones, still = np.ones(WORLDS), np.zeros((WORLDS, 3))
    turned = [np.array(matrix_from_euler(np.array([0.0, 0.0, drone.yaw]))) for drone in plant.drones]
    inertias = [
        *(turn @ np.diag(drone.inertia) @ turn.T for turn, drone in zip(turned, plant.drones, strict=True)),
        np.diag(plant.carrier_inertia),
        np.eye(3) * (constants.shell_inertia_per_mass * mass[:, None])[:, None, :],
        np.eye(3) * (constants.ball_inertia_per_mass * mass[:, None])[:, None, :],
    ]
    bodies = [
        *((drone.mass * ones, np.array(drone.mount) * ones[:, None], still) for drone in plant.drones),
        (plant.carrier_mass * ones, still, still),
        ((1 - share) * mass, still, still),
        (share * mass, along(plant, cg.offset / share), along(plant, cg.rate / share)),
    ]
    place = [state.position + rotations.rotate(matrix, r) for _, r, _ in bodies]
    speed = [
        state.velocity + rotations.rotate(matrix, rotations.cross(state.rates, r) + slide) for _, r, slide in bodies
    ]
    total = sum(m for m, _, _ in bodies)[:, None]
    centre = sum(m[:, None] * p for (m, _, _), p in zip(bodies, place, strict=True)) / total
    linear = sum(m[:, None] * v for (m, _, _), v in zip(bodies, speed, strict=True))
    angular = sum(
        np.cross(p - centre, m[:, None] * v) + rotations.rotate(matrix, rotations.rotate(inertia, state.rates))
        for (m, _, _), p, v, inertia in zip(bodies, place, speed, inertias, strict=True)
    )
    return linear, angular


@pytest.mark.parametrize("make_engine", [newton_euler.make_engine, mujoco.make_engine], ids=["closed form", "MuJoCo"])
@pytest.mark.parametrize(
    "plant",
    [REFERENCE, VARIED, LIGHT_BALL, team(3, 1), team(6, 2, moving_fraction=0.4)],
    ids=["reference", "varied", "light_ball", "three", "six and a light ball"],
)
def test_free_fall_conserves_momentum(plant: Plant, make_engine: object) -> None:
    """MuJoCo's ball is driven by the computed slide force, whose reaction must act; the closed form never forms it."""
    engine = make_engine(plant, Attitude())
    random = np.random.default_rng(6)
    mass = random.uniform(0.1, 0.6, WORLDS)
    reach = plant.moving_fraction * min(plant.object_size[axis] for axis in plant.directions) / 2
    path = sine if len(plant.directions) == 1 else lambda *given: lissajous(*given, SHAPE)
    sines = (random.uniform(0.3, 1, WORLDS) * reach, random.uniform(1, 3.1, WORLDS), random.uniform(0, 6, WORLDS))
    rates = random.normal(size=(WORLDS, 3))
    rates *= 3 / np.linalg.norm(rates, axis=-1, keepdims=True)
    quaternion = random.normal(size=(WORLDS, 4))
    state = PlantState(
        position=random.normal(size=(WORLDS, 3)),
        quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
        velocity=random.normal(size=(WORLDS, 3)),
        rates=rates,
        rotor_force=np.zeros((WORLDS, plant.count, 4)),
        ticks=np.zeros(WORLDS, int),
        time=np.zeros(WORLDS),
        ball_offset=np.zeros(WORLDS),
        ball_rate=np.zeros(WORLDS),
    )
    linear, angular = momenta(plant, mass, path(state.time, *sines), state)
    for _ in range(round(SECONDS / STEP)):
        k1 = derivative(engine, mass, path, sines, state)
        k2 = derivative(engine, mass, path, sines, advance(state, k1, STEP / 2))
        k3 = derivative(engine, mass, path, sines, advance(state, k2, STEP / 2))
        k4 = derivative(engine, mass, path, sines, advance(state, k3, STEP))
        mean = k1.each(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k2, k3, k4)
        state = advance(state, mean, STEP)
    later_linear, later_angular = momenta(plant, mass, path(state.time, *sines), state)
    fallen = np.zeros((WORLDS, 3))
    rigid = sum(drone.mass for drone in plant.drones) + plant.carrier_mass
    fallen[:, 2] = -(rigid + mass) * plant.gravity * SECONDS
    # 1e-9 relative is the bound: RK4 at 1 ms leaves a truncation error near (3 rad/s x 1 ms)^4 x 1 s.
    scale_linear = np.linalg.norm(linear + fallen, axis=-1).max()
    assert np.abs(later_linear - linear - fallen).max() <= 1e-9 * scale_linear
    assert (np.linalg.norm(later_angular - angular, axis=-1) <= 1e-9 * np.linalg.norm(angular, axis=-1)).all()
    assert np.linalg.norm(state.rates, axis=-1).max() > 1  # it kept tumbling


@pytest.mark.parametrize("physics", ["newton-euler", "mujoco"])
def test_objects_own_equations_hold_with_the_contact_wrenches(physics: str) -> None:
    """Newton at the moving CG and Euler about it, from differences of the flown trajectory's own accelerations."""
    config = paper_with(VARIED)
    plant, constants = config.plant, plant_parameters(config.plant, config.attitude)
    flight = simulate(config, copying(config), Scenario(omega=2.0, amplitude=0.1, mass=0.3, seconds=4.0), physics)
    matrix = rotations.matrix_from_quaternion(flight.quaternion)
    flown = (flight.position, flight.quaternion, flight.velocity, flight.rates, flight.rotor_force)
    state = PlantState(*flown, None, flight.time, None, None)
    from mjxball.physics.engine import total_wrench

    ones = np.ones_like(flight.time)
    cg = sine(flight.time, 0.1 * ones, 2.0 * ones, 0.0 * ones)
    wrench = total_wrench(plant, constants, flight.rotor_force)
    linear, angular = newton_euler.make_engine(plant, config.attitude).prescribed(state, wrench, 0.3 * ones, cg)
    along = np.array([1.0, 0, 0])
    c, rate, acceleration = (value[:, None] * along for value in cg)
    w = flight.rates
    at_cg = (
        rotations.rotate_back(matrix, linear)
        + np.cross(angular, c)
        + np.cross(w, np.cross(w, c))
        + 2 * np.cross(w, rate)
        + acceleration
    )
    force = flight.contact_force.sum(axis=1)
    newton = 0.3 * at_cg - force + 0.3 * plant.gravity * matrix[:, 2, :]
    own = 0.3 * constants.ball_inertia_per_mass
    lever = constants.mounts - c[:, None, :]
    torque = flight.contact_torque.sum(axis=1) + np.cross(lever, flight.contact_force).sum(axis=1)
    euler = own * angular + np.cross(w, own * w) - torque
    # 1e-9 of the forces and torques at play, newtons and newton metres of order 1
    assert np.abs(newton).max() <= 1e-9 * np.abs(force).max()
    assert np.abs(euler).max() <= 1e-9 * np.abs(flight.contact_torque).max()
