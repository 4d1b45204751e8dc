"""Teams of any number of drones: the engines agree, momentum is conserved, contact wrenches hold the carrier."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics.test_engines import TOLERANCE, jitted, relative_difference
from plants import paper_with, random_motion, team
from tables import rows

from engines import random_states
from mjxball import config as configs
from mjxball.config import Attitude, Plant, preset
from mjxball.control import rotations
from mjxball.env import TransportEnv
from mjxball.physics import mjx, mujoco, newton_euler
from mjxball.physics.engine import Load, contact_wrenches, total_wrench
from mjxball.physics.step import make_plant_step, start_state
from mjxball.plant import plant_parameters

STATES = 100
LOADS = {
    "plane": {"cg_axis": "xy"},
    "light ball on a plate": {"cg_axis": "xy", "moving_fraction": 0.4},
    "line": {"cg_axis": "y", "moving_fraction": 0.7},
}
STANDS = ("free", "pivot", "heave")
TEAMS = [
    (count, load, stand)
    for (count, load), stand in zip(itertools.product((2, 3, 4, 6), LOADS), itertools.cycle(STANDS), strict=False)
]


def arguments_for(plant: Plant, function: str, count: int = STATES) -> tuple:
    """States, the wrenches of their rotors, object masses and what moves the load."""
    random = np.random.default_rng(7)
    state, parameters = random_states(plant, count, random), plant_parameters(plant, Attitude())
    wrench = total_wrench(plant, parameters, state.rotor_force)
    last = (
        random_motion(plant, count, random) if function == "prescribed" else random.normal(size=state.ball_rate.shape)
    )
    return state, wrench, random.uniform(0.1, 0.6, count), last


@rows("count, load, stand", TEAMS)
@rows("function", ["prescribed", "rolling"])
def test_closed_form_and_mujoco_agree_on_every_team(count: int, load: str, stand: str, function: str) -> None:
    plant = team(count, seed=count, stand=stand, **LOADS[load])
    arguments = arguments_for(plant, function)
    found, expected = (
        getattr(make(plant, Attitude()), function)(*arguments)
        for make in (newton_euler.make_engine, mujoco.make_engine)
    )
    assert relative_difference(found, expected) <= TOLERANCE
    assert np.abs(expected[1]).max() > 1  # [rad/s2]: something turns


MJX_TEAMS = [
    pytest.param(3, "plane", "free", marks=pytest.mark.slow),
    pytest.param(4, "light ball on a plate", "free", marks=pytest.mark.release),
    pytest.param(6, "light ball on a plate", "heave", marks=pytest.mark.release),
    pytest.param(2, "line", "pivot", marks=pytest.mark.release),
]


@pytest.mark.parametrize(("count", "load", "stand"), MJX_TEAMS)
def test_mjx_agrees_on_teams(count: int, load: str, stand: str) -> None:
    plant = team(count, seed=count, stand=stand, **LOADS[load])
    closed = newton_euler.make_engine(plant, Attitude())
    for function in ("prescribed", "rolling"):
        arguments = arguments_for(plant, function)
        fast = jitted(lambda: getattr(mjx.make_engine(plant, Attitude()), function))(*arguments)  # noqa: B023
        assert relative_difference(fast, getattr(closed, function)(*arguments)) <= TOLERANCE, function


@pytest.mark.parametrize("engine", ["newton-euler", pytest.param("mjx", marks=pytest.mark.slow)])
def test_every_world_may_have_another_rig(engine: str) -> None:
    """Traced numbers give what the same numbers give as constants."""
    make = {"newton-euler": newton_euler.make_engine, "mjx": mjx.make_engine}[engine]
    rigs = [team(3, seed=seed, moving_fraction=0.4) for seed in range(3)]
    numbers = [plant_parameters(rig, Attitude()) for rig in rigs]
    worlds = jax.tree.map(lambda *leaves: np.stack(leaves), *numbers)
    arguments = arguments_for(rigs[0], "rolling", len(rigs))

    def traced(parameters, *each):
        return make(rigs[0], Attitude(), parameters).rolling(*each)

    found = jitted(lambda: traced)(worlds, *arguments)
    for number, rig in enumerate(rigs):
        alone = jax.tree.map(lambda leaf: leaf[number : number + 1], arguments)  # noqa: B023
        expected = newton_euler.make_engine(rig, Attitude()).rolling(*alone)
        assert relative_difference([leaf[number : number + 1] for leaf in found], expected) <= TOLERANCE


def test_rotors_may_be_commanded_themselves() -> None:
    """A tenth more than hover: g / 10 upwards, less the rotors' lag T: v = g / 10 (t - T (1 - exp(-t / T)))."""
    config = preset("team")
    engine = newton_euler.make_engine(config.plant, config.attitude)
    step = make_plant_step(config, engine, autopilot=lambda state, forces, load: (state.loops, forces))
    zero, none, mass = np.zeros(3), np.zeros(0), np.float64(config.plant.object_mass)
    load = Load(mass, mass, *np.zeros(3), none, none)
    state = start_state(config, zero, zero, zero, mass, np.zeros(2))
    forces = 1.1 * state.rotor_force
    for _ in range(10):
        state = step(state, forces, load)
    time, lag = 10 * config.timing.control_period, config.plant.rotor_lag
    climb = 0.1 * config.plant.gravity * (time - lag * (1 - np.exp(-time / lag)))
    assert state.velocity == pytest.approx([0, 0, climb], abs=1e-9)
    assert state.rates == pytest.approx(zero, abs=1e-9)


def test_a_control_step_of_every_world_may_have_another_rig() -> None:
    """Rotor geometry, lags, limits, gains and shares too: half a second of flight with traced numbers and constants."""
    rigs = [team(3, seed=seed, moving_fraction=0.4, leader=1) for seed in range(3)]
    configs = [paper_with(rig) for rig in rigs]
    random, commands = np.random.default_rng(5), np.random.default_rng(6).normal(0, 0.1, (3, 3, 3))
    none, mass = np.zeros((3, 0)), random.uniform(0.2, 0.4, 3)
    load = Load(mass, mass, *random.uniform(0.02, 0.08, (3, 3)), none, none)
    zero = np.zeros((3, 3))
    vectors = (zero, 0.1 * random.normal(size=(3, 3)), zero, mass, np.zeros((3, 2)))

    def flown(config, parameters, commands, load, *start, repeat=jax.lax.fori_loop):
        engine = newton_euler.make_engine(config.plant, config.attitude, parameters)
        step = make_plant_step(config, engine, parameters=parameters)
        return repeat(0, 5, lambda _, state: step(state, commands, load), start_state(config, *start, parameters))

    def in_numpy(first, last, step, state):
        for number in range(first, last):
            state = step(number, state)
        return state

    numbers = [plant_parameters(rig, Attitude()) for rig in rigs]
    worlds = jax.tree.map(lambda *leaves: np.stack(leaves), *numbers)
    together = jitted(lambda: lambda *each: flown(configs[0], *each))(worlds, commands, load, *vectors)
    for number, config in enumerate(configs):
        given = jax.tree.map(lambda leaf: leaf[number], (commands, load, *vectors))  # noqa: B023
        alone = flown(config, None, *given, repeat=in_numpy)
        for found, expected in zip(together.each(lambda leaf: leaf[number]), alone, strict=True):  # noqa: B023
            if expected is not None:
                # 1e-10: rounding, which the attitude loops' feedback does not let grow
                np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def test_contact_wrenches_are_those_of_mujoco() -> None:
    plant = team(4, seed=11, moving_fraction=0.4)
    state, wrench, mass, motion = arguments_for(plant, "prescribed", 20)
    linear, angular = newton_euler.make_engine(plant, Attitude()).prescribed(state, wrench, mass, motion)
    force, torque = contact_wrenches(plant, plant_parameters(plant, Attitude()), state, linear, angular)
    world, share = mujoco.MujocoWorld(plant, Attitude()), plant.moving_fraction
    for row in range(20):
        one = state.each(lambda leaf: leaf[row])  # noqa: B023
        world.place(one, mass[row], motion.offset[row] / share, motion.rate[row] / share)
        world.load_drones(one.rotor_force)
        world.drive(motion.acceleration[row] / share)
        expected = world.contact_wrenches(one)
        # 1e-9 of newtons and newton metres of order 10: MuJoCo moves torques between points
        np.testing.assert_allclose(force[row], expected[0], atol=1e-8)
        np.testing.assert_allclose(torque[row], expected[1], atol=1e-8)


def test_carriers_own_equations_hold_with_the_contact_wrenches() -> None:
    """Newton and Euler about O for what the drones carry: carrier, shell and ball, with the drones' wrenches on it."""
    plant, gravity = team(5, seed=3, moving_fraction=0.4), 9.81
    state, wrench, mass, motion = arguments_for(plant, "prescribed")
    parameters, share = plant_parameters(plant, Attitude()), plant.moving_fraction
    linear, angular = newton_euler.make_engine(plant, Attitude()).prescribed(state, wrench, mass, motion)
    force, torque = contact_wrenches(plant, parameters, state, linear, angular)
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    body, down, w = rotations.rotate_back(matrix, linear), matrix[:, 2, :], state.rates
    place, speed, moved = (np.pad(value / share, ((0, 0), (0, 1))) for value in motion)
    fixed, ball = (plant.carrier_mass + (1 - share) * mass)[:, None], (share * mass)[:, None]
    swept = np.cross(angular, place) + np.cross(w, np.cross(w, place)) + 2 * np.cross(w, speed) + moved
    pull = ball * (body + swept + gravity * down)
    newton = fixed * (body + gravity * down) + pull - force.sum(axis=1)
    inertia = plant.carrier_inertia + mass[:, None] * parameters.object_inertia_per_mass
    spin = inertia * angular + np.cross(w, inertia * w) + np.cross(place, pull)
    euler = spin - (torque + np.cross(parameters.mounts, force)).sum(axis=1)
    # 1e-9 of the largest force and torque
    assert np.abs(newton).max() <= 1e-9 * np.abs(force).max()
    assert np.abs(euler).max() <= 1e-9 * np.abs(torque).max()


FACTORS = ("drone_mass", "drone_inertia", "mount", "arm", "yaw_per_thrust", "rotor_force", "carrier", "attitude_gain")


@pytest.fixture(scope="module")
def moved():
    """State after a few steps of strong commands, for a range of one number of the rig at 1.3 and none."""
    strong = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (2, 3)), jnp.float32) * jnp.array([0.6, 0.6, 40.0])

    steps: list = []  # of the first one's program, to which a rig is data

    def fly(name: str = "") -> np.ndarray:
        changes = {
            "follower.privileged_critic": False,
            "command.vertical_limit": 40.0,
            "scenario.start_tilt": 0.3,
            **{f"scenario.{one}_scale": (1.0, 1.0) for one in (*FACTORS, "rotor_lag", "thrust", "inertia")},
            "scenario.team_sizes": (3,),
        }
        if name:
            changes[f"scenario.{name}_scale"] = (1.3, 1.3)
        base = configs.apply_overrides(preset("team"), changes)
        env = TransportEnv(base, "newton-euler")
        state = env.reset(jax.random.key(3), 0)
        if not steps:
            steps.append(jax.jit(env.step_with_command))
        for _ in range(3):
            state = steps[0](state, jnp.concatenate([strong, jnp.zeros((3, 3))]))
        plant = state.pipeline_state.plant
        return np.concatenate([np.ravel(leaf) for leaf in (plant.velocity, plant.rates)])

    return fly


def test_every_range_of_a_rig_acts(moved) -> None:
    base = moved()
    for name in (*FACTORS, "rotor_lag", "thrust", "inertia"):
        assert np.abs(moved(name) - base).max() > 1e-5, name
