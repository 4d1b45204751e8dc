"""Drones on elastic mounts in C MuJoCo: closed forms of their oscillation, conservation, the limit of rigid mounts."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco as mj
import numpy as np
import pytest
from plants import LIGHT_BALL, copying, paper_with, team
from tables import rows

from mjxball.assembly import drone_names
from mjxball.config import Config, Plant, Timing, apply_overrides, preset, with_plant
from mjxball.control import observation as layout
from mjxball.control import rotations
from mjxball.control.axes import inertia_about_o
from mjxball.errors import InputError
from mjxball.physics import mjx, mujoco, newton_euler
from mjxball.physics.autopilot import make_autopilot
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.mounts import own_motion, own_quaternion, own_rates
from mjxball.physics.step import (
    acting_wrench,
    make_accelerations,
    make_numpy_plant_step,
    make_plant_step,
    start_state,
)
from mjxball.plant import plant_parameters
from mjxball.plant.mounts import hinge
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.goals import Goal
from mjxball.sim.rollout import flown_contact_wrenches, simulate
from mjxball.sim.scenario import Scenario
from mjxball.sim.sensors import Sample, SensorModel

PAIR = preset("flight")
TOGETHER, OPPOSED = (1.0, 1.0), (1.0, -1.0)  # how two drones swing


def mounted(config: Config, frequency: float, damping: float = 0.02, **settings: object) -> Config:
    """`config` on mounts of `frequency` [Hz]; `settings` by path with __ for the dot."""
    changed = {name.replace("__", "."): value for name, value in settings.items()}
    return apply_overrides(config, {"plant.mount_frequency": frequency, "plant.mount_damping": damping, **changed})


def at_rest(config: Config, count: int = 1) -> tuple[PlantState, Load]:
    """The start of `config`, with rotors off, and its load at O."""
    zero, ones = np.zeros(count), np.ones(count)
    vector = np.zeros((count, 3))
    mass = config.plant.object_mass * ones
    ball = np.zeros((count, 2)) if len(config.plant.directions) == 2 else zero
    state = start_state(config, vector, vector, vector, mass, ball)
    nothing = np.zeros((count, 0))
    return state._replace(rotor_force=0 * state.rotor_force), Load(mass, mass, zero, ones, zero, nothing, nothing)


def passive_step(config: Config):
    """One control period without any control: the rotors are off."""
    engine = mujoco.make_engine(config.plant, config.attitude, config.physics_step)
    return make_plant_step(config, engine, autopilot=lambda state, _, load: (state.loops, 0 * state.rotor_force))


def flown(config: Config, state: PlantState, load: Load, periods: int) -> list[PlantState]:
    """`state` and those after each of so many control periods without control."""
    step, states = passive_step(config), [state]
    for _ in range(periods):
        states.append(step(states[-1], np.zeros((*state.time.shape, config.plant.count, 3)), load))
    return states


def oscillation(time: np.ndarray, angle: np.ndarray) -> tuple[float, float]:
    """(frequency [Hz], damping ratio) of a decaying oscillation about 0 by linear prediction, exact without noise.

    y'' + 2 zeta w y' + w^2 y = 0 sampled: y[n + 1] = 2 a cos(b) y[n] - a^2 y[n - 1] with a = exp(-zeta w h).
    """
    (one, other), *_ = np.linalg.lstsq(np.stack([angle[1:-1], angle[:-2]], axis=1), angle[2:], rcond=None)
    pole = np.log(np.roots([1.0, -one, -other]).astype(complex)[0]) / (time[1] - time[0])
    return abs(pole) / (2 * math.pi), -pole.real / abs(pole)


@pytest.mark.parametrize("axis", [0, 1])
def test_free_oscillation(axis: int) -> None:
    """Two drones of inertia J on a carrier of inertia H: f against each other, f sqrt(1 + 2 J / H) against the carrier.

    The integration is exact for the first. The second is slower by (w h)^2 / 12 at most, the trapezoidal rule's error.
    """
    config = mounted(PAIR, 8.0, 0.03, timing__control_period=0.001, timing__physics_steps=2, autopilot__kind="ideal")
    own = PAIR.plant.drones[0].inertia[axis]
    ratio = math.sqrt(1 + 2 * own / (inertia_about_o(PAIR)[axis] - 2 * own))
    for shape, factor in ((OPPOSED, 1.0), (TOGETHER, ratio)):
        state, load = at_rest(config)
        rate = np.zeros((1, 2, 2))
        rate[0, :, axis] = 1e-4 * np.array(shape)  # so small that the carrier's motion is linear
        states = flown(config, state._replace(mount_rate=rate), load, 100)
        time = np.array([one.time[0] for one in states])
        angle = np.array([one.mount_angle[0, 0, axis] for one in states])
        frequency, damping = oscillation(time, angle)
        error = (2 * math.pi * 8.0 * factor * config.physics_step) ** 2 / 12 if factor > 1 else 0.0
        assert frequency == pytest.approx(8.0 * factor, rel=error + 1e-6), shape
        assert damping == pytest.approx(0.03 * factor, rel=3 * error + 1e-5), shape


def test_exact_at_the_longest_step() -> None:
    """Four steps a period: frequency and damping of drones against each other are still those of the plant."""
    config = mounted(PAIR, 125.0, 0.05)
    state, load = at_rest(config)
    swing = 1e-3 * np.array([[OPPOSED, OPPOSED]]).swapaxes(1, 2)
    step = passive_step(replace(config, timing=replace(config.timing, control_period=0.002, physics_steps=1)))
    angles = []
    for _ in range(60):
        angles.append(state.mount_angle[0, 0, 0])
        state = step(state._replace(mount_rate=swing) if not angles[-1] else state, np.zeros((1, 2, 3)), load)
    frequency, damping = oscillation(0.002 * np.arange(60), np.array(angles))
    assert frequency == pytest.approx(125.0, rel=1e-5)
    assert damping == pytest.approx(0.05, rel=1e-4)


def test_a_carrier_without_mass_is_refused() -> None:
    with pytest.raises(InputError, match="carrier that has a mass"):
        mujoco.make_engine(mounted(preset("paper"), 20.0).plant, PAIR.attitude)


def test_longer_steps_are_refused() -> None:
    plant = replace(PAIR.plant, mount_frequency=126.0)
    with pytest.raises(InputError, match=r"at most 1\.98 ms"):
        hinge(plant, 1e-5, 0.002)
    with pytest.raises(InputError, match="quarter of its period"):
        make_numpy_plant_step(replace(PAIR, plant=plant), "mujoco")


@rows("make", [newton_euler.make_engine, mjx.make_engine])
def test_other_engines_refuse(make) -> None:
    with pytest.raises(InputError, match="no elastic mounts"):
        make(replace(PAIR.plant, mount_frequency=20.0), PAIR.attitude)


def momentum(config: Config, state: PlantState) -> tuple[np.ndarray, np.ndarray, float]:
    """Linear momentum, angular momentum about O's start [SI], kinetic and elastic energy; drones and object by hand."""
    plant, parameters = config.plant, plant_parameters(config.plant, config.attitude)
    matrix = rotations.matrix_from_quaternion(state.quaternion)[0]
    own = rotations.matrix_from_quaternion(own_quaternion(state.quaternion, state.mount_angle, parameters.yaw))[0]
    rates = own_rates(state.rates, state.mount_angle, state.mount_rate, parameters.yaw)[0]
    velocity, turning = state.velocity[0], matrix @ state.rates[0]
    held = plant.carrier_inertia + plant.object_mass * parameters.object_inertia_per_mass
    mass = plant.carrier_mass + plant.object_mass
    linear, spin = mass * velocity, matrix @ (held * state.rates[0])
    angular = spin + mass * np.cross(state.position[0], velocity)
    energy = 0.5 * mass * velocity @ velocity + 0.5 * turning @ spin
    for number, drone in enumerate(plant.drones):
        turn = rotations.matrix_from_quaternion(np.array([math.cos(drone.yaw / 2), 0.0, 0.0, math.sin(drone.yaw / 2)]))
        lever = matrix @ drone.mount
        speed = velocity + np.cross(turning, lever)
        about = own[number] @ (turn @ np.diag(drone.inertia) @ turn.T) @ rates[number]
        linear = linear + drone.mass * speed
        angular = angular + drone.mass * np.cross(state.position[0] + lever, speed) + about
        springs = np.array([hinge(plant, drone.inertia[axis]).stiffness for axis in (0, 1)])
        energy += 0.5 * drone.mass * speed @ speed + 0.5 * (own[number] @ rates[number]) @ about
        energy += 0.5 * springs @ state.mount_angle[0, number] ** 2
    return linear, angular, float(energy)


@pytest.mark.parametrize("plant", ["pair", "turned team"])
def test_momentum_and_energy(plant: str) -> None:
    """No gravity, rotors off, large swings. Momenta stay but for the scheme's error; so does the energy without
    damping, and with damping it falls. The team's drones are turned on their mounts, and no two are alike."""
    config = preset("paper")
    still = replace(LIGHT_BALL if plant == "pair" else team(4, 1, moving_fraction=0.5), gravity=1e-6)
    changes = []
    for steps, damping in ((10, 0.0), (20, 0.0), (20, 0.1)):
        timing = replace(config.timing, physics_steps=steps, control_period=0.01)
        free = mounted(replace(config, plant=still, timing=timing), 10.0, damping)
        state, load = at_rest(free)
        random = np.random.default_rng(2)
        state = state._replace(
            rates=np.array([[0.5, -0.4, 0.8]]),
            velocity=np.array([[0.2, 0.1, -0.3]]),
            mount_rate=random.normal(0.0, 3.0, state.mount_rate.shape),
        )
        before, *_, after = (momentum(free, one) for one in flown(free, state, load, 50))
        changes.append([float(np.abs(a - b).max()) for a, b in zip(before, after, strict=True)])
        if damping:
            assert after[2] < before[2]
    # Of order 1 N s, 0.1 N m s and 0.3 J. Half the step leaves half: first order, from forces that depend on velocity.
    for one, half in zip(*changes[:2], strict=True):
        assert half < 0.6 * one < 2e-4


def test_stiff_mounts_are_rigid_ones() -> None:
    """The pair flies to a goal with its CG moving: the difference to rigid mounts falls as 1 / f^2."""
    config = replace(paper_with(LIGHT_BALL), timing=Timing(control_period=0.02, physics_steps=20))
    scenario = Scenario(seconds=1.5, goal=(0.3, 0.2, 0.1), amplitude=0.05)
    rigid, soft, stiff = (
        simulate(one, copying(one), scenario, "mujoco")
        for one in (config, mounted(config, 30.0), mounted(config, 60.0))
    )
    far, near = (np.abs(one.euler - rigid.euler).max() for one in (soft, stiff))
    assert 1e-6 < near < 2e-3
    assert far / near == pytest.approx(4.0, rel=0.15)
    assert np.abs(stiff.contact_force - rigid.contact_force).max() < 0.3  # of 12 N


@rows("stand", ["pivot", "heave"])
def test_stands(stand: str) -> None:
    """Two drones swing against each other at f on a stand as well, where the stick is free to roll."""
    config = mounted(with_plant(PAIR, "stand") if stand == "heave" else PAIR, 10.0)
    config = replace(config, plant=replace(config.plant, stand=stand))
    state, load = at_rest(config)
    states = flown(config, state._replace(mount_rate=1e-3 * np.array([[[1.0, 0.0], [-1.0, 0.0]]])), load, 60)
    frequency, _ = oscillation(0.01 * np.arange(61), np.array([one.mount_angle[0, 0, 0] for one in states]))
    assert frequency == pytest.approx(10.0, rel=1e-4)
    assert not np.any(states[-1].rates[:, 1:])


def test_loops_act_on_the_drones_own_attitude() -> None:
    """A drone that is turned on its mount while the carrier is level asks for what a turned rigid pair asks for."""
    angle = np.array([[[0.05, -0.03], [0.0, 0.0]]])
    for config in (paper_with(LIGHT_BALL), PAIR):
        soft = mounted(config, 30.0)
        state, load = at_rest(soft)
        turned = state._replace(mount_angle=angle, mount_rate=4 * angle)
        euler, rates = own_motion(turned, np.zeros(2))
        whole = start_state(config, np.zeros((1, 3)), euler[:, 0], np.zeros((1, 3)), load.object_mass, np.zeros(1))
        whole = whole._replace(rates=rates[:, 0], loops=state.loops)
        command = np.array([[[0.0, 0.0, 0.0]] * 2])
        (_, found), (_, expected) = (
            make_autopilot(one)(each, command, load) for one, each in ((soft, turned), (config, whole))
        )
        np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=1e-12)
        assert np.abs(found[:, 1] - found[:, 0]).max() > 1e-3 * found.max()


def swinging(config: Config, count: int) -> tuple[PlantState, Load]:
    """States of a pair or team that turns, on mounts that are turned by up to 0.2 rad and swing."""
    state, load = at_rest(config, count)
    random = np.random.default_rng(5)
    return state._replace(
        position=random.normal(0.0, 0.5, (count, 3)),
        quaternion=rotations.quaternion_from_euler(random.normal(0.0, 0.2, (count, 3))),
        velocity=random.normal(0.0, 0.3, (count, 3)),
        rates=random.normal(0.0, 1.0, (count, 3)),
        rotor_force=random.uniform(1.0, 4.0, state.rotor_force.shape),
        mount_angle=random.normal(0.0, 0.1, state.mount_angle.shape),
        mount_rate=random.normal(0.0, 2.0, state.mount_rate.shape),
    ), load


@rows("plant", [LIGHT_BALL, team(4, 1, moving_fraction=0.5)])
def test_a_drone_observes_its_own_attitude(plant: Plant) -> None:
    """Attitude and rates are those of the drone's body in MuJoCo, and the object's error follows from them."""
    config = mounted(paper_with(plant), 10.0)
    state, load = swinging(config, 4)
    loop = ClosedLoop(config, passive_step(config), SensorModel(present=False))
    goal, zero = np.array([[0.3, -0.2, 0.4]] * 4), np.zeros(len(plant.directions))
    seen = loop.start(state, Goal(goal), load, Sample())[1]
    angles = layout.mount_angles(plant)
    seen = (seen if angles is None else rotations.turned_about_z(seen, angles)).reshape(4, -1, 18)
    world = mujoco.MujocoWorld(config.plant, config.attitude)
    for row in range(4):
        world.place(state.each(lambda leaf: leaf[row]), plant.object_mass, zero, zero)  # noqa: B023
        for number, drone in enumerate(plant.followers):
            body, found = world.model.body(drone_names(plant)[drone]).id, seen[row, number]
            turn = rotations.matrix_from_quaternion(
                rotations.quaternion_from_euler(np.array([0, 0, plant.drones[drone].yaw]))
            )
            own, velocity = world.data.xmat[body].reshape(3, 3) @ turn.T, np.zeros(6)
            mj.mj_objectVelocity(world.model, world.data, mj.mjtObj.mjOBJ_BODY, body, velocity, 0)
            np.testing.assert_allclose(found[0:3], world.data.xpos[body], atol=1e-12)
            np.testing.assert_allclose(found[3:6], rotations.euler_from_matrix(own), atol=1e-12)
            np.testing.assert_allclose(found[6:9], velocity[3:], atol=1e-12)
            np.testing.assert_allclose(found[9:12], own.T @ velocity[:3], atol=1e-12)
            arm = own @ plant.drones[drone].mount
            np.testing.assert_allclose(found[12:15], goal[row] - (world.data.xpos[body] - arm), atol=1e-12)
            np.testing.assert_allclose(found[15:18], np.cross(velocity[:3], arm) - velocity[3:], atol=1e-12)
        assert np.abs(seen[row, :, 12:15] - (goal - state.position)[row]).max() > 1e-3


def test_contact_forces_with_an_external_force() -> None:
    """F = T R e3 - m (g + a) of every drone, whose centre moves with the carrier; a from the engine, R its own."""
    config = mounted(paper_with(LIGHT_BALL), 10.0)
    plant, parameters = config.plant, plant_parameters(config.plant, config.attitude)
    state, load = swinging(config, 5)
    force = np.random.default_rng(1).normal(0.0, 2.0, (5, 3))
    pulled = load._replace(external_force=force)
    accelerate = make_accelerations(config, mujoco.make_engine(plant, config.attitude))
    wrench = acting_wrench(plant, parameters, state.rotor_force, state, pulled)
    linear, angular, *_ = accelerate(state, wrench, load)
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    own = rotations.matrix_from_quaternion(own_quaternion(state.quaternion, state.mount_angle, parameters.yaw))
    w, turning = state.rates[:, None], angular[:, None]
    lever = np.cross(turning, parameters.mounts) + np.cross(w, np.cross(w, parameters.mounts))
    moved = linear[:, None] + rotations.rotate(matrix[:, None], lever)
    weight = np.array([0.0, 0.0, plant.gravity])
    thrust = state.rotor_force.sum(axis=-1)[..., None] * own[..., 2]
    expected = rotations.rotate_back(matrix[:, None], thrust - parameters.drone_mass[:, None] * (weight + moved))
    record = state.each(lambda leaf: leaf[None])
    found = flown_contact_wrenches(config, record, pulled._replace(external_force=force[None]), "mujoco")[0][0]
    # 1e-9 of forces of order 10 N
    np.testing.assert_allclose(found, expected, atol=1e-8)
    without = flown_contact_wrenches(config, record, load, "mujoco")[0][0]
    assert np.abs(found - without).max() > 0.1


def test_a_gusty_flight_is_recorded() -> None:
    config = mounted(replace(paper_with(LIGHT_BALL), timing=Timing(control_period=0.02, physics_steps=20)), 30.0)
    scenario = Scenario(seconds=0.3, disturbance=Disturbance(gust=0.5, noise=1.0, seed=1))
    assert np.isfinite(simulate(config, copying(config), scenario, "mujoco").contact_force).all()
