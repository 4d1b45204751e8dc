"""Fine-tuning a flown policy by gradients through the Crazyflies' cascade."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.control import crazyflie
from mjxball.fly.card import config_of
from mjxball.policy import Policy, load_file, shipped_policy
from mjxball.train.fine_tune import FineTuner, FlightState, KnownLoad, LoadedEnv, nominal_load, resting


def test_rounding_passes_a_gradient_and_rounds_all_the_same() -> None:
    law = crazyflie.STOCK
    draw = np.random.default_rng(0).normal(size=(400, 3)) * [0.1, 0.1, 2.0]

    def sent(command: Any) -> Any:
        mass = jnp.full(command.shape[:-1], 0.0377, jnp.float32)
        return crazyflie.setpoints(law, jnp.asarray(command, jnp.float32), mass, 9.81)

    thrust = np.asarray(jax.jit(sent)(draw))[:, 3]
    assert (thrust == np.round(thrust)).all()
    slope = jax.grad(lambda az: sent(jnp.stack([0.0, 0.0, az]))[3])(0.3)
    # The calibrated law's own slope: a step of 0.1 m/s2 moves the rounded thrust by as much, to a unit.
    step = float(sent(jnp.array([0.0, 0.0, 0.35]))[3] - sent(jnp.array([0.0, 0.0, 0.25]))[3])
    assert slope == pytest.approx(step / 0.1, abs=10.0)
    output = draw * 5000
    # In the same numbers JAX and NumPy mix the same, bit by bit.
    with jax.enable_x64(True):
        same = crazyflie.mix(jnp.full(400, 40000.0), jnp.asarray(output))
    np.testing.assert_array_equal(np.asarray(same), crazyflie.mix(np.full(400, 40000.0), output))


@pytest.fixture(scope="module")
def uncompiled() -> FineTuner:
    """Of the shipped policy."""
    contents = load_file(shipped_policy("flight"))
    return FineTuner(config_of(contents.card), contents)


@pytest.fixture(scope="module")
def tuner(uncompiled: FineTuner) -> FineTuner:
    """The same, compiled once; the rehearsal finds its programs in the cache."""
    said: list[str] = []
    uncompiled.compile(said.append)
    assert said == [f"{k} of 3 programs compiled" for k in (1, 2, 3)]
    return uncompiled


def test_worlds_begin_at_the_flight_with_the_known_load(uncompiled: FineTuner) -> None:
    config, tilted = uncompiled.config, np.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0], np.float32)
    load = KnownLoad(0.0215, -0.0112, 0.009, 0.7, 0.3, 3.84, 1.0)
    flight = resting(config)._replace(position=np.array([1.0, -2.0, 0.5], np.float32), quaternion=tilted)
    flight = flight._replace(goal=np.array([1.0, -2.0, 0.6], np.float32), history=resting(config).history + 0.25)
    reset = jax.jit(lambda load, flight, key: LoadedEnv(config, load, flight).reset(key).pipeline_state)
    world = reset(load, flight, jax.random.PRNGKey(3))
    # Five deviations of what training varies: 5 mm of the place, 1 % of the mass, 1 mm and 10 % of the CG's places.
    np.testing.assert_allclose(world.plant.position, flight.position, atol=0.025)
    np.testing.assert_array_equal(world.plant.quaternion, tilted)
    np.testing.assert_array_equal(world.goal, flight.goal)
    np.testing.assert_array_equal(world.history, flight.history)
    assert world.load.object_mass == pytest.approx(load.mass, rel=0.05)
    ends = np.asarray(world.load.cg_path)
    np.testing.assert_allclose(np.unique(ends), [-0.0202, -0.0022], atol=0.0095)
    assert (np.sign(np.diff(ends)) == [-1, 1] * 7 + [-1]).all()  # to and fro
    assert (world.load.battery, world.load.uncompensated) == (pytest.approx(3.84), 1)


def test_it_starts_from_the_flown_policy(uncompiled: FineTuner) -> None:
    flown = load_file(shipped_policy("flight"))
    again = uncompiled._contents(uncompiled._start)
    draw = np.random.default_rng(1).normal(size=(50, 18)) * 0.05
    old, new = (Policy(one, "one", np.float64) for one in (flown, again))
    np.testing.assert_allclose([new(row) for row in draw], [old(row) for row in draw], atol=1e-5)
    # What was found of the flown network says nothing of another one.
    assert again.card == {name: value for name, value in flown.card.items() if name != "flown"}


@pytest.mark.slow
def test_fine_tuneing_lowers_the_cost_and_ends_in_time(tuner: FineTuner) -> None:
    load, flight = KnownLoad(0.0235, -0.0153, 0.009, 0.7, 0.3, 3.84, 0.0), resting(tuner.config)
    tuned = tuner.fine_tune(load, flight, 60.0)
    assert tuned.steps > 1
    assert tuned.contents is not None
    assert tuned.after < 0.9 * tuned.before
    Policy(tuned.contents, "fine-tuned")
    nothing = tuner.fine_tune(load, flight, 0.0)  # no time: the old weights are as good as they are
    assert (nothing.steps, nothing.contents) == (0, None)


@pytest.mark.slow
def test_what_is_not_finite_or_no_better_is_kept_back(tuner: FineTuner) -> None:
    flight, load = resting(tuner.config), nominal_load(tuner.config)
    lost = FlightState(*(np.full_like(part, np.nan) for part in flight))
    tuned = tuner.fine_tune(load, lost, 5.0)
    assert tuned.contents is None
