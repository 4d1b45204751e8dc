"""Closed form, MJX and C MuJoCo give the same accelerations, for every plant and every motion of the CG."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from plants import PLANTS, ROLLING, SAMPLES, paper_with, random_motion, random_wrench
from tables import rows, weekly

from engines import random_states
from mjxball.config import Attitude, Motion, replace
from mjxball.physics import mjx, mujoco, newton_euler
from mjxball.physics.engine import Load, total_wrench
from mjxball.physics.step import make_accelerations
from mjxball.plant import plant_parameters

STATES = 10_000
FEWER = 300  # for plants beside the reference: one world of C MuJoCo takes 50 us
TOLERANCE = 1e-9  # float64 leaves about 1e-14
FUNCTIONS = ("prescribed", "rolling")
MOTIONS = [(Motion(), 0), (SAMPLES, 0), (ROLLING, 0), (Motion(), 2)]
SECOND = mujoco.make_engine
# MJX takes seconds to compile for a plant.
ONE_OR_ALL = ["varied", *weekly(*(name for name in PLANTS if name != "varied"))]


def relative_difference(found: tuple, expected: tuple) -> float:
    """Largest difference of any state's accelerations, relative to that state's own."""
    worst = 0.0
    for pair in zip(found, expected, strict=True):
        a, b = (np.asarray(value).reshape(len(value), -1) for value in pair)
        scale = np.maximum(np.linalg.norm(b, axis=-1), 1e-3)  # locked directions are exactly 0 on both sides
        worst = max(worst, float((np.linalg.norm(a - b, axis=-1) / scale).max()))
    return worst


def jitted(make):
    """The function of MJX that `make()` gives, on batches of NumPy arrays, in float64."""
    with jax.enable_x64(True):
        batched = jax.jit(jax.vmap(make()))

    def called(*arguments):
        with jax.enable_x64(True):
            return batched(*arguments)

    return called


def arguments_for(plant, function: str, seed: int) -> tuple:
    """States, wrenches, object masses and what moves the CG for `function` of an engine."""
    random = np.random.default_rng(seed)
    mass = random.uniform(0.1, 0.6, FEWER)
    last = random_motion(plant, FEWER, random) if function == "prescribed" else random.normal(size=FEWER)
    return random_states(plant, FEWER, random), random_wrench(FEWER, random), mass, last


@rows("name", PLANTS)
@rows("function", FUNCTIONS)
def test_engines_agree_on_every_plant(name: str, function: str) -> None:
    plant = PLANTS[name]
    arguments = arguments_for(plant, function, 1)
    closed, second = (getattr(make(plant, Attitude()), function) for make in (newton_euler.make_engine, SECOND))
    assert relative_difference(closed(*arguments), second(*arguments)) <= TOLERANCE


@pytest.mark.parametrize("name", ONE_OR_ALL)
def test_mjx_agrees_on_every_plant(name: str) -> None:
    plant = PLANTS[name]
    closed = newton_euler.make_engine(plant, Attitude())
    for function in FUNCTIONS:
        arguments = arguments_for(plant, function, 1)
        fast = jitted(lambda: getattr(mjx.make_engine(plant, Attitude()), function))(*arguments)  # noqa: B023
        assert relative_difference(fast, getattr(closed, function)(*arguments)) <= TOLERANCE, function


def violent(motion: Motion, changes: int) -> tuple:
    """(config, states, wrenches, loads) of 10 000 worlds."""
    random, config = np.random.default_rng(2), paper_with(motion=motion)
    state = random_states(config.plant, STATES, random)
    load = Load(
        object_mass=random.uniform(0.2, 0.6, STATES),
        believed_mass=np.full(STATES, 0.2),
        cg_amplitude=random.uniform(0, 0.17, STATES),
        cg_speed=random.uniform(0.3, 3.1, STATES),
        cg_phase=random.uniform(0, 6.28, STATES),
        mass_change=random.uniform(-0.05, 0.2, (STATES, changes)),
        mass_change_time=random.uniform(0, 20, (STATES, changes)),
    )
    constants = plant_parameters(config.plant, config.attitude)
    wrench = total_wrench(config.plant, constants, state.rotor_force)
    return config, state, wrench, load


@rows("motion, changes", MOTIONS)
def test_engines_agree_on_10_000_states_for_every_motion(motion: Motion, changes: int) -> None:
    config, *arguments = violent(motion, changes)
    closed, expected = (
        make_accelerations(config, make(config.plant, config.attitude))(*arguments)
        for make in (newton_euler.make_engine, SECOND)
    )
    assert relative_difference(closed, expected) <= TOLERANCE
    assert np.abs(expected[1]).max() > 10  # the states are violent enough to mean something [rad/s2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "changes"),
    [pytest.param(*row, marks=() if row[0] is ROLLING else pytest.mark.release) for row in MOTIONS[1:]],
    ids=lambda value: str(value)[:24],
)
def test_mjx_agrees_on_10_000_states_for_every_motion(motion: Motion, changes: int) -> None:
    config, *arguments = violent(motion, changes)
    closed = make_accelerations(config, newton_euler.make_engine(config.plant, config.attitude))
    fast = jitted(lambda: make_accelerations(config, mjx.make_engine(config.plant, config.attitude)))
    assert relative_difference(fast(*arguments), closed(*arguments)) <= TOLERANCE


def with_more_inertia(name: str, function: str) -> tuple:
    """(plant, its arguments, more inertia (FEWER, 3), accelerations of a plant whose leader has it)."""
    plant = PLANTS[name]
    added = np.random.default_rng(5).uniform(-1e-3, 4e-3, 3)
    heavier = replace(plant, "drones.0.inertia", tuple(np.add(plant.drones[0].inertia, added)))
    arguments = arguments_for(plant, function, 6)
    expected = getattr(SECOND(heavier, Attitude()), function)(*arguments)
    return plant, arguments, np.broadcast_to(added, (FEWER, 3)), expected


@rows("name", ["reference", "pivot", "heave"])
@rows("function", FUNCTIONS)
def test_added_inertia_is_that_of_drones_which_have_it(name: str, function: str) -> None:
    plant, arguments, more, expected = with_more_inertia(name, function)
    closed, second = (getattr(make(plant, Attitude()), function) for make in (newton_euler.make_engine, SECOND))
    assert relative_difference(closed(*arguments, more), expected) <= TOLERANCE
    with pytest.raises(NotImplementedError, match="without mass"):
        second(*arguments, more)
    for without, zero in zip(second(*arguments), second(*arguments, 0.0 * more), strict=True):
        np.testing.assert_array_equal(without, zero)  # worlds that vary in other ways carry a zero


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "function"), [("heave", "rolling"), pytest.param("reference", "prescribed", marks=pytest.mark.release)]
)
def test_mjx_takes_added_inertia(name: str, function: str) -> None:
    plant, arguments, more, expected = with_more_inertia(name, function)
    fast = jitted(lambda: getattr(mjx.make_engine(plant, Attitude()), function))
    assert relative_difference(fast(*arguments, more), expected) <= TOLERANCE


def test_closed_form_matches_the_hand_solution_of_design_section_4() -> None:
    plant, random = PLANTS["reference"], np.random.default_rng(3)
    state, wrench, cg = random_states(plant, 50, random), random_wrench(50, random), random_motion(plant, 50, random)
    state = state._replace(quaternion=np.tile([1.0, 0, 0, 0], (50, 1)), rates=np.zeros((50, 3)))
    mass = random.uniform(0.1, 0.6, 50)
    linear, angular = newton_euler.make_engine(plant, Attitude()).prescribed(state, wrench, mass, cg)
    constants = plant_parameters(plant, Attitude())
    jx, jy, jz = np.diag(constants.drone_inertia)[:, None] + mass * (
        constants.object_inertia_per_mass[:, None] + np.array([0, 1, 1])[:, None] * cg.offset**2
    )
    total, s, g = 2 + mass, mass * cg.offset, plant.gravity
    fx, fy, fz = -mass * cg.acceleration, np.zeros(50), wrench.force[:, 2] - total * g
    nx, ny, nz = wrench.torque.T + np.array([np.zeros(50), s * g, np.zeros(50)])
    expected = [
        fx / total,
        (jz * fy - s * nz) / (total * jz - s * s),
        (jy * fz + s * ny) / (total * jy - s * s),
        nx / jx,
        (total * ny + s * fz) / (total * jy - s * s),
        (total * nz - s * fy) / (total * jz - s * s),
    ]
    # 1e-12: products of a few rounded terms
    np.testing.assert_allclose(np.hstack([linear, angular]).T, expected, rtol=1e-12, atol=1e-12)


def test_a_locked_direction_does_not_accelerate() -> None:
    for name, free in (("pivot", []), ("heave", [2])):
        plant, random = PLANTS[name], np.random.default_rng(4)
        state = random_states(plant, 20, random)
        motion = random_motion(plant, 20, random)
        engine = newton_euler.make_engine(plant, Attitude())
        linear, angular = engine.prescribed(state, random_wrench(20, random), np.full(20, 0.3), motion)
        locked = [axis for axis in range(3) if axis not in free]
        # A heave stand's world axes come from a rotation about x, exact to rounding.
        np.testing.assert_allclose(linear[:, locked], 0, atol=1e-12)
        np.testing.assert_array_equal(angular[:, 1:], 0)
        assert (np.abs(angular[:, 0]) > 0).all()


def test_plant_is_parameters() -> None:
    """Scaling every mass, inertia, force and torque leaves the accelerations as they are."""
    plant, random = PLANTS["varied"], np.random.default_rng(5)
    state, wrench, cg = random_states(plant, 30, random), random_wrench(30, random), random_motion(plant, 30, random)
    mass = np.full(30, 0.4)
    heavy = dataclasses.replace(
        plant,
        drones=tuple(
            dataclasses.replace(drone, mass=3 * drone.mass, inertia=tuple(3 * value for value in drone.inertia))
            for drone in plant.drones
        ),
    )
    light_result = newton_euler.make_engine(plant, Attitude()).prescribed(state, wrench, mass, cg)
    tripled = wrench._replace(force=3 * wrench.force, torque=3 * wrench.torque)
    heavy_result = newton_euler.make_engine(heavy, Attitude()).prescribed(state, tripled, 3 * mass, cg)
    # 1e-11: the two differ in rounding only
    np.testing.assert_allclose(heavy_result, light_result, rtol=1e-11, atol=1e-11)
