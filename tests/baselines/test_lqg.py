"""The LQG of plants with ideal loops: its filter, prediction and feedback on its own model, and flights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tables import rows

from mjxball.baselines import make_baseline, make_controller
from mjxball.baselines.crazyflie_lqg import CalmCrazyflieLqg, CrazyflieLqg, DisturbedCrazyflieLqg
from mjxball.baselines.hover_model import ERRORS, LIFT_ERROR, LOAD, MEASURED, RATES, STATES, WIND
from mjxball.baselines.lqg import MEMORY, CalmLqg, DisturbedLqg, Lqg, apart, noises
from mjxball.baselines.lqg_tuning import LONGEST_DELAY, Tuning
from mjxball.config import Config, preset, with_plant
from mjxball.control.followers import PrivilegedInfo
from mjxball.plant.teams import ring_config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import simulate, simulate_batch
from mjxball.sim.scenario import Scenario

PAPER = preset("paper")
RING = ring_config(with_plant(PAPER, "team6"), 4)
KEEPS = {"load_time": np.inf, "wind_time": np.inf, "lift_time": np.inf}  # estimates that are not forgotten


class OwnPlant:
    """The controller's model in place of a plant, driven by what it asks for; measurements are `delay` steps late."""

    def __init__(self, config: Config, tuning: Tuning, x: np.ndarray, delay: int):
        self.controller = Lqg(config, tuning)
        zero = np.zeros(())
        self.known = PrivilegedInfo(np.array(config.plant.object_mass), zero, zero, zero)
        self.x, self.past, self.delay = x, [x] * (delay + 1), delay
        self.memory = self.controller.start(self.observation())

    def observation(self, error: np.ndarray | None = None) -> np.ndarray:
        """(18,) at the time that is measured now."""
        seen, measured = np.zeros(18), self.controller.design.measured @ self.past[-1 - self.delay]
        seen[list(MEASURED)] = measured if error is None else measured + error
        return seen

    def step(self, observation: np.ndarray, push: np.ndarray | float = 0.0) -> None:
        """One control period, with `push` (22,) added to the state."""
        own = self.controller.design
        self.memory, _ = self.controller.step(self.memory, observation, self.known)
        self.x = own.transition @ self.x + own.drive @ self.memory.given[:3] + push
        self.past.append(self.x)


def started(random: np.random.Generator) -> np.ndarray:
    """A state near hover, without disturbances."""
    x = np.zeros(STATES)
    x[ERRORS], x[RATES] = 0.01 * random.standard_normal(3), 0.0
    return x


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_prediction_is_exact_on_the_model(delay: int) -> None:
    """What it expects of the next measurement is the state of that time, to rounding, while commands keep changing."""
    plant = OwnPlant(PAPER, Tuning()._replace(delay=float(delay)), started(np.random.default_rng(0)), delay)
    for _ in range(40):
        plant.step(plant.observation())
        np.testing.assert_allclose(plant.memory.expected, plant.past[-1 - delay], atol=1e-12)
    assert np.abs(plant.x).max() > 1e-3


def test_innovations_are_white_and_of_the_expected_size() -> None:
    """On its own model with its own noises: 10 numbers of chi-square mean 1, uncorrelated from step to step.

    4000 steps: the mean is good to sqrt(2 / 40 000) = 0.7 %, and a correlation to 1 / sqrt(4000) = 1.6 %.
    """
    random, tuning = np.random.default_rng(1), Tuning()._replace(delay=0.0)
    plant = OwnPlant(PAPER, tuning, np.zeros(STATES), 0)
    own, (process, noise) = plant.controller.design, noises(tuning, PAPER.timing.control_period)
    # K = P C' S^-1, so C K = 1 - N S^-1.
    spread = noise @ np.linalg.inv(np.eye(10) - own.measured @ own.gain).T
    whitening, found = np.linalg.inv(np.linalg.cholesky(0.5 * (spread + spread.T))), []
    for _ in range(4500):
        seen = plant.observation(np.sqrt(np.diag(noise)) * random.standard_normal(10))
        found.append(whitening @ (seen[list(MEASURED)] - own.measured @ plant.memory.expected))
        plant.step(seen, np.sqrt(np.diag(process)) * random.standard_normal(STATES))
    white = np.array(found[500:])
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.05)
    assert np.abs(np.mean(white[1:] * white[:-1], axis=0)).max() < 0.07


@pytest.mark.parametrize("state", [LOAD.start, LOAD.start + 1, WIND.start, WIND.start + 1, LIFT_ERROR.start])
def test_no_constant_disturbance_leaves_an_error(state: int) -> None:
    """Torque, wind, lift: the error of O goes to 0 where nothing is forgotten, and the estimate to the truth."""
    x = np.zeros(STATES)
    x[state] = 0.3
    plant = OwnPlant(PAPER, Tuning()._replace(**KEEPS, delay=1.0), x, 1)
    for _ in range(6000):
        plant.step(plant.observation())
    own = plant.controller.design
    assert np.abs(own.measured[:3] @ plant.x).max() < 1e-6
    np.testing.assert_allclose(plant.memory.expected[state], 0.3, rtol=1e-4)


@pytest.mark.parametrize("size", [3, 6])
def test_what_followers_estimate_apart_dies_out(size: int) -> None:
    """Where no measurement changes, the controller's own step shrinks any difference of two followers.

    `apart` is that step: checked against the controller itself, which is linear where no limit is reached.
    """
    config = ring_config(with_plant(PAPER, "team6"), size)
    controller, followers = Lqg(config), size - 1
    own, random = controller.design, np.random.default_rng(0)
    assert np.abs(np.linalg.eigvals(apart(own))).max() < np.exp(-config.timing.control_period / MEMORY)
    still = np.zeros((followers, 18))
    known = PrivilegedInfo(np.full(followers, config.plant.object_mass), *[np.zeros((followers, 2))] * 3)
    memory = controller.start(still)
    memory = memory._replace(expected=1e-5 * random.standard_normal((followers, STATES)), steps=memory.steps + 10)
    before = np.concatenate([memory.expected, memory.given], axis=-1)
    after, _ = controller.step(memory, still, known)
    found = np.concatenate([after.expected, after.given], axis=-1)
    np.testing.assert_allclose(found, before @ apart(own).T, atol=1e-9)


def test_followers_whose_sensors_disagree_keep_off_the_rotors_limits() -> None:
    """Under noise level 1 and 40 ms of delay for 20 s."""
    scenario = Scenario(mass=RING.plant.object_mass, seconds=20.0, disturbance=Disturbance(noise=1.0, delay=0.04))
    flown = simulate(RING, make_baseline("lqg", RING), scenario, "newton-euler")
    assert np.linalg.norm(flown.error[flown.time > 10], axis=-1).max() < 0.03
    most = np.array(RING.plant.of_drones("rotor_force_max"))[:, None]
    limited = ((flown.rotor_force < 0.01 * most) | (flown.rotor_force > 0.99 * most)).any(axis=(-2, -1))
    assert limited.mean() < 0.05


def test_unknown_masses_and_heavy_loads_settle() -> None:
    """A pair, calm and with noise and delay, within 4 s to 10 and 20 mm; 0.5 kg at 8 cm and 3.1 rad/s to 15 mm."""
    loads = [{"mass": 0.3, "believed_mass": 0.2, "amplitude": 0.08}, {"mass": 0.5, "amplitude": 0.08, "omega": 3.1}]
    rough = Disturbance(noise=1.0, delay=0.04)
    scenarios = [Scenario(seconds=12.0, **load, disturbance=how) for how in (Disturbance(), rough) for load in loads]
    flown = simulate_batch(PAPER, [(make_baseline("lqg", PAPER), scenarios)], "newton-euler")
    late = np.linalg.norm(flown.error[flown.time > 4], axis=-1).max(axis=0)
    assert (late < [0.01, 0.015, 0.02, 0.02]).all(), late


def test_it_knows_no_more_than_the_believed_mass() -> None:
    """Other privileged information may be anything."""
    controller, observation = make_controller("lqg", PAPER), 0.1 * np.random.default_rng(0).standard_normal(18)
    nothing = PrivilegedInfo(np.array(0.2), None, None, None)
    state, command = controller.step(controller.start(observation), observation, nothing)
    assert np.isfinite(command).all()
    assert state.given.shape == (3 * LONGEST_DELAY,)
    assert not controller.needs_privileged


@rows(
    "kind, plant, attribute",
    [
        (CalmLqg, PAPER, "tuning"),
        (DisturbedLqg, preset("team"), "team_tuning"),
        (DisturbedLqg, preset("universal"), "team_tuning"),
        (CalmCrazyflieLqg, preset("flight"), "tuning"),
        (DisturbedCrazyflieLqg, preset("flight"), "tuning"),
    ],
)
def test_a_variant_has_the_tuning_for_its_condition(kind, plant, attribute, monkeypatch) -> None:
    monkeypatch.setattr(kind, attribute, getattr(kind, attribute)._replace(delay=4.0))
    delay, own = (float(make_controller(name, plant).design.delay) for name in ("lqg", kind.name))
    assert own == 4.0 != delay


@pytest.mark.parametrize("kind", [Lqg, CrazyflieLqg])
def test_a_measurement_that_repeats_the_last_is_left_out(kind: Any) -> None:
    """Of two flights that measure the same, one knows that it is new; at rest, and where a bit differs, both do."""
    config = PAPER if kind is Lqg else preset("flight")
    controller, seen = kind(config), np.full((2, 18), 0.1)
    known = PrivilegedInfo.of_believed(np.full(2, config.plant.object_mass))
    memory, _ = controller.step(controller.start(seen), seen, known)
    unexpected = memory._replace(expected=memory.expected + 0.01, steps=memory.steps + 10)

    def after(last: Any, now: Any) -> Any:
        return controller.step(unexpected._replace(last=last[:, :12]), now, known)[0].expected

    other, still = seen.copy(), seen.copy()
    other[1, 3] = np.nextafter(0.1, 1.0)
    still[:, 6:12] = 0.0
    gap, fresh = after(np.stack([seen[0], other[1]]), seen)
    assert np.abs(gap - fresh).max() > 1e-5
    np.testing.assert_array_equal(fresh, after(other + 1.0, seen)[1])
    np.testing.assert_array_equal(*after(np.stack([still[0], other[1]]), still))
    blind = after(seen, np.full((2, 18), 0.1))
    np.testing.assert_array_equal(gap, blind[0])
