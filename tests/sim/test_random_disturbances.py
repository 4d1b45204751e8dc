"""Disturbances that training draws in every world: measurements, gusts, rotors; inputs of privileged critics."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CompiledEnv, compile_env, with_settings

from mjxball.config import Config, preset, replace
from mjxball.env import TransportEnv
from mjxball.physics import motion, newton_euler
from mjxball.physics.step import jax_repeat, make_plant_step
from mjxball.sim.disturbances import GUST_TIME, RandomDisturbances
from mjxball.sim.sensors import NOISE

SEEN = jnp.arange(18.0)
STEPS = 4000


def rolled(config: Config, observations: Any, seed: int = 0) -> tuple[Any, Any]:
    """(every state of the disturbances, everything seen) where the truth is `observations` (T, 18)."""
    disturbances = RandomDisturbances(config)
    start, sample = disturbances.start(jax.random.key(seed))
    sensors, first = disturbances.sensors.start(observations[0], sample, start.settings)

    def step(carry: Any, truth: Any) -> tuple[Any, Any]:
        state, sample = disturbances.step(carry[0])
        sensors, seen = disturbances.sensors.step(carry[1], truth, sample)
        return (state, sensors), (state, seen)

    _, (states, seen) = jax.lax.scan(step, (start, sensors), observations[1:])
    return states, jnp.concatenate([first[None], seen])


def test_nothing_disturbed_carries_nothing(transport: Config) -> None:
    disturbances = RandomDisturbances(transport)
    assert not disturbances.present
    state, sample = disturbances.start(jax.random.key(0))
    assert state == ()
    assert not jax.tree.leaves((sample, disturbances.step(state)))
    sensors, seen = disturbances.sensors.start(SEEN, sample)
    assert not jax.tree.leaves(sensors)
    np.testing.assert_array_equal(seen, SEEN)
    np.testing.assert_array_equal(disturbances.sensors.step(sensors, 2 * SEEN, sample)[1], 2 * SEEN)


@pytest.mark.parametrize("probability", [0.0, 0.4, 1.0])
def test_a_calm_flight_has_a_delay_alone(probability: float, transport: Config) -> None:
    levels = {"noise": (0.5, 1.0), "gust": (0.1, 0.2), "estimator_drift": (0.5, 1.0), "delay": (0.02, 0.1)}
    config = with_settings(transport, scenario=levels)
    calm = with_settings(config, scenario={"calm_probability": probability})
    keys = jax.random.split(jax.random.key(0), 1000)
    usual, found = (jax.jit(jax.vmap(lambda key: RandomDisturbances(c).start(key)[0]))(keys) for c in (config, calm))  # noqa: B023
    still = np.asarray(found.noise) == 0
    for name in ("gust", "force", "drift", "drift_level"):
        quiet = np.asarray(getattr(found, name)).reshape(len(keys), -1) == 0
        np.testing.assert_array_equal(quiet, np.broadcast_to(still[:, None], quiet.shape))
        np.testing.assert_array_equal(getattr(found, name)[~still], getattr(usual, name)[~still])
    np.testing.assert_array_equal(found.settings.delay, usual.settings.delay)
    assert abs(still.mean() - probability) <= 5 * math.sqrt(probability * (1 - probability) / len(keys))


def test_noise_has_the_judges_deviations_and_is_white(transport: Config) -> None:
    config = with_settings(transport, scenario={"noise": (2.0, 2.0)})
    _, seen = rolled(config, jnp.broadcast_to(SEEN, (STEPS, 18)))
    noise = np.asarray(seen - SEEN)
    np.testing.assert_allclose(noise.std(axis=0), 2 * NOISE, rtol=5 / math.sqrt(2 * STEPS))  # five deviations
    following = np.array([np.corrcoef(column[:-1], column[1:])[0, 1] for column in noise.T])
    assert np.abs(following).max() < 5 / math.sqrt(STEPS)


@pytest.mark.parametrize(("seconds", "steps"), [(0.02, 1), (0.04, 2), (0.05, 2), (0.056, 3)])
def test_delay_is_whole_control_steps(transport: Config, seconds: float, steps: int) -> None:
    config = with_settings(transport, scenario={"delay": (seconds, seconds)})
    truth = jnp.arange(20.0)[:, None] * jnp.ones(18)
    _, seen = rolled(config, truth)
    np.testing.assert_array_equal(seen[:, 0], np.maximum(np.arange(20) - steps, 0))


def test_gusts_have_their_rms_and_correlation(transport: Config) -> None:
    config = with_settings(transport, scenario={"gust": (0.3, 0.3)})
    force = jax.jit(jax.vmap(lambda seed: rolled(config, jnp.zeros((60, 18)), seed)[0].force))(jnp.arange(2000))
    assert float(force[:, -1].std()) == pytest.approx(0.3, rel=0.05)
    last, before = np.asarray(force[:, -1]).ravel(), np.asarray(force[:, -26]).ravel()
    assert np.corrcoef(last, before)[0, 1] == pytest.approx(math.exp(-25 * 0.02 / GUST_TIME), abs=0.05)


def test_every_world_draws_its_own_within_the_ranges(transport: Config) -> None:
    config = with_settings(transport, scenario={"noise": (0.5, 1.5), "delay": (0.0, 0.04), "gust": (0.1, 0.3)})
    disturbances = RandomDisturbances(config)
    drawn = jax.jit(jax.vmap(lambda key: disturbances.start(key)[0]))(jax.random.split(jax.random.key(1), 500))
    for values, low, high in ((drawn.noise, 0.5, 1.5), (drawn.gust, 0.1, 0.3)):
        assert low <= float(values.min()) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < float(values.max()) <= high
    assert set(np.asarray(drawn.settings.delay)) == {0, 1, 2}


@pytest.mark.slow
def test_rotors_of_a_world_are_those_of_a_plant_with_such_rotors(transport: Config) -> None:
    pair = compile_env(transport, "newton-euler")
    world = pair.reset(jax.random.key(3)).pipeline_state
    commands = jnp.array([[0.1, -0.05, 1.0], [0.0, 0.1, -0.5]])
    other = replace(transport, "plant.rotor_lag", 2.0 * transport.plant.rotor_lag)

    def stepped(config: Config, load: Any) -> Any:
        step = make_plant_step(config, newton_euler.make_engine(config.plant, config.attitude), jax_repeat)
        return step(world.plant, commands, load)

    scaled = stepped(transport, world.load._replace(rotor_lag_scale=jnp.array(2.0)))
    pairs = zip(jax.tree.leaves(scaled), jax.tree.leaves(stepped(other, world.load)), strict=True)
    for mine, theirs in pairs:
        np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6)
    plain = stepped(transport, world.load)
    fast = world.load._replace(rotor_lag_scale=jnp.array(1e-3))
    weak = fast._replace(thrust_scale=jnp.array([1.0, 0.9]))
    # With rotors that follow at once, the follower's forces are 0.9 of what its loop asks for from the same state.
    one = replace(transport, "timing.physics_steps", 1)
    full, less = stepped(one, fast).rotor_force, stepped(one, weak).rotor_force
    np.testing.assert_allclose(less[0], full[0], rtol=1e-6)
    np.testing.assert_allclose(less[1], 0.9 * full[1], rtol=1e-6)
    assert not np.allclose(plain.rotor_force, scaled.rotor_force)


@pytest.fixture(scope="module")
def disturbed(transport: Config) -> CompiledEnv:
    scenario = {
        "noise": (1.0, 1.0),
        "delay": (0.04, 0.04),
        "gust": (0.2, 0.2),
        "rotor_lag_scale": (0.5, 2.0),
        "thrust_scale": (0.8, 1.2),
        "inertia_scale": (0.6, 1.4),
        "mass_known": False,
        "object_mass": (0.3, 0.4),
    }
    return compile_env(
        with_settings(transport, scenario=scenario, follower={"privileged_critic": True}), "newton-euler"
    )


def test_critics_are_told_the_truth_and_policies_are_not(disturbed: CompiledEnv) -> None:
    env = disturbed.env
    state = disturbed.reset(jax.random.key(5))
    for _ in range(3):
        state = disturbed.step(state, jnp.zeros(3))
    world = state.pipeline_state
    assert state.obs.shape == (env.observation_size,)
    command = np.asarray(state.obs[18:])
    offset, moment, mass, unknown = command[:4]
    load = world.load
    expected = float(load.cg_amplitude * jnp.sin(load.cg_speed * world.plant.time + load.cg_phase))
    assert offset == pytest.approx(expected, rel=1e-4)
    assert moment == pytest.approx(expected * float(load.object_mass), rel=1e-4)
    assert mass == pytest.approx(float(load.object_mass))
    assert unknown == pytest.approx(float(load.object_mass) - 0.2, rel=1e-4)
    np.testing.assert_allclose(command[4 + 9 : 4 + 12], world.goal - world.plant.position, rtol=1e-5)
    np.testing.assert_allclose(command[19:22], world.disturbances.force, rtol=1e-6)
    np.testing.assert_allclose(command[22:24], [1.0, 2.0])
    np.testing.assert_allclose(command[24:], [load.rotor_lag_scale, *load.thrust_scale, *load.added_inertia], rtol=1e-6)
    scale = 1 + load.added_inertia[0] / (2 * 2.3e-3 + float(load.object_mass) * (0.1**2 + 0.05**2) / 12)
    assert 0.6 < float(scale) < 1.4
    assert env.input_mask[18:] == [0.0] * len(command)
    assert env.critic_mask[18:] == [1.0] * len(command)
    # What it sees is late and noisy.
    assert not np.allclose(state.obs[12:15], command[13:16], atol=1e-4)


def test_a_gust_pushes(disturbed: CompiledEnv) -> None:
    state = disturbed.reset(jax.random.key(6))
    world = state.pipeline_state

    def pushed(force: jax.Array) -> jax.Array:
        moved = world._replace(disturbances=world.disturbances._replace(force=force))
        return disturbed.step(state.replace(pipeline_state=moved), jnp.zeros(3)).pipeline_state.plant.velocity

    moved, kept = pushed(jnp.array([5.0, 0.0, 0.0])), pushed(jnp.zeros(3))
    mass = 2.0 + float(world.load.object_mass)
    assert float(moved[0] - kept[0]) == pytest.approx(0.02 * 5.0 / mass, rel=0.05)


@pytest.mark.slow
def test_some_flights_visit_places_within_their_amplitude(transport: Config) -> None:
    config = with_settings(transport, scenario={"cg_waypoint_probability": 0.5, "cg_amplitude": (0.05, 0.1)})
    env = TransportEnv(config, "newton-euler")
    load = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 400)).pipeline_state.load
    assert 160 < int(load.follows_path.sum()) < 240
    assert load.cg_path.shape == (400, 16)
    assert float(jnp.abs(load.cg_path).max()) <= 1.0
    times = jnp.linspace(0.0, 60.0, 400)
    offsets = jax.jit(jax.vmap(lambda time: motion.sine_or_waypoints(jnp.full(400, time), load).offset))(times)
    assert bool((jnp.abs(offsets).max(axis=0) <= load.cg_amplitude * (1 + 1e-5)).all())


def test_no_world_is_drawn_whose_thrust_nobody_could_trim() -> None:
    load = {"object_mass": (0.1, 0.32), "mass_change": (-0.05, 0.06), "cg_amplitude": (0.0, 0.17)}
    varied = {**load, "mass_known": False, "thrust_scale": (0.8, 1.2)}
    config = with_settings(preset("transport"), scenario=varied)
    env = TransportEnv(config, "newton-euler")
    load = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 2000)).pipeline_state.load
    assert float(jax.jit(jax.vmap(env._resets.trimmed))(load).min()) > -1e-3
    # The follower's own rotors keep most of their range; a leader that lifts too much or too little does not.
    leader, follower = load.thrust_scale.T
    assert float(follower.min()) < 0.83
    assert float(follower.max()) > 1.17
    assert float(leader[load.object_mass > 0.3].min()) > 0.83
