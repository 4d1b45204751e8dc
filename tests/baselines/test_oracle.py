"""The oracle holds every kind of plant within 2 mm, whatever disturbs it, and its rotors off their limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mjxball.baselines import make_baseline, make_controller
from mjxball.config import Config, preset, replace, with_plant
from mjxball.control.followers import Baseline, PrivilegedInfo
from mjxball.errors import InputError
from mjxball.plant.teams import ring_config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rigs import rig_config, sample_rigs, unpadded
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import CgPath, Scenario

PAPER, UNIVERSAL, FLIGHT = preset("paper"), preset("universal"), preset("flight")
ELLIPSE = CgPath(direction=0.5, width=0.5, lead=math.pi / 2)
SECONDS, SETTLED = 10.0, 5.0


def rig(size: int) -> tuple[Config, list[Scenario]]:
    """A random rig, its true mass and thrusts unknown to its drones."""
    rigs = unpadded(sample_rigs(UNIVERSAL, size, 1, 77).rigs, size)
    load = {"mass": float(rigs.object_mass[0]), "believed_mass": float(rigs.believed_mass[0])}
    amplitude, thrust = 0.7 * float(rigs.reach[0]), tuple(map(float, rigs.thrust[0]))
    scenario = Scenario(**load, amplitude=amplitude, omega=2.0, path=ELLIPSE, thrust=thrust, seconds=SECONDS)
    return rig_config(UNIVERSAL, rigs, 0), [scenario]


def flights() -> dict[str, tuple[Config, list[Scenario]]]:
    """Plants of every kind with loads that move as fast and far as they may."""
    pair = [
        Scenario(mass=0.3, believed_mass=0.2, amplitude=0.1, omega=3.1, seconds=SECONDS),
        Scenario(mass=0.2, amplitude=0.15, omega=1.0, goal=(-0.9, 0.8, 1.0), seconds=SECONDS),
    ]
    ring = ring_config(with_plant(PAPER, "team6"), 3)
    team = [Scenario(mass=0.4, path=ELLIPSE, omega=3.1, amplitude=0.05, seconds=SECONDS)]
    return {"pair": (PAPER, pair), "ring": (ring, team), "rig of 2": rig(2), "rig of 4": rig(4)}


def limited(config: Config, flown: Any) -> np.ndarray:
    """(n,) share of time in which any rotor is within 1 % of a limit."""
    most = np.array(config.plant.of_drones("rotor_force_max"))[:, None]
    return ((flown.rotor_force < 0.01 * most) | (flown.rotor_force > 0.99 * most)).any(axis=(-2, -1)).mean(axis=0)


@pytest.mark.parametrize("name", flights())
def test_it_holds_the_object_within_two_millimetres(name: str) -> None:
    config, scenarios = flights()[name]
    flown = simulate_batch(config, [(make_baseline("oracle", config), scenarios)], "newton-euler")
    assert np.linalg.norm(flown.error[flown.time > SETTLED], axis=-1).max() < 2e-3
    assert (limited(config, flown) < 0.05).all()


def test_it_holds_crazyflies_within_four_millimetres() -> None:
    """Their firmware counts in whole steps, and their loops are known by a linear model."""
    ranges = FLIGHT.scenario
    load = {"mass": FLIGHT.plant.object_mass, "amplitude": 0.5 * ranges.cg_amplitude[1], "omega": ranges.cg_speed[1]}
    scenarios = [
        Scenario(**load, believed_mass=FLIGHT.plant.object_mass, thrust=(0.985, 1.015), seconds=15.0),
        Scenario(mass=FLIGHT.plant.object_mass, amplitude=0.02, omega=0.5, seconds=15.0),
    ]
    flown = simulate_batch(FLIGHT, [(make_baseline("oracle", FLIGHT), scenarios)], "newton-euler")
    assert np.linalg.norm(flown.error[flown.time > 10], axis=-1).max() < 4e-3


@pytest.mark.parametrize("plant", ["plate4", "stand"])
def test_it_holds_a_ball_that_rolls_freely(plant: str) -> None:
    """On a plate O stays at its goal, wherever the ball lies; on the stand the ball comes to rest in the middle."""
    config = preset("stand") if plant == "stand" else with_plant(PAPER, plant)
    if plant == "stand":
        still = {"amplitude": 0.0, "goal": (0.0, 0.0, 0.0), "start_tilt": (0.03, 0.0)}
        scenario = Scenario(mass=config.plant.object_mass, ball_start=0.03, seconds=25.0, **still)
    else:
        config = replace(config, "motion.kind", "rolling")
        scenario = Scenario(mass=config.plant.object_mass, ball_start=0.05, amplitude=0.0, seconds=SECONDS)
    flown = simulate_batch(config, [(make_baseline("oracle", config), [scenario])], "newton-euler")
    late = flown.time > (15.0 if plant == "stand" else SETTLED)
    assert np.abs(flown.error[late]).max() < 2e-3
    if plant == "stand":
        assert np.abs(flown.cg_offset[late]).max() / config.plant.moving_fraction < 0.01


@pytest.mark.parametrize("scale", [0.7, 2.0, 3.0])
def test_it_is_told_of_other_attitude_loops(scale: float) -> None:
    """Loops of 7 to 30 rad/s where it was made for 10. The stiffest leader holds everybody to its own pace."""

    class Told:
        name, needs_privileged = "told", True

        def __init__(self) -> None:
            self.oracle = make_controller("oracle", PAPER)

        def start(self, observation: np.ndarray) -> Any:
            return self.oracle.start(observation)

        def step(self, state: Any, observation: np.ndarray, known: PrivilegedInfo) -> Any:
            factor = scale * np.ones(observation.shape[:-1])
            return self.oracle.step(state, observation, known._replace(loop_scale=factor))

    frequency = tuple(scale * each for each in PAPER.attitude.natural_frequency)
    config = replace(PAPER, "attitude.natural_frequency", frequency)
    scenario = Scenario(mass=0.3, amplitude=0.08, omega=3.1, seconds=15.0)
    flown = simulate_batch(config, [(Baseline(Told(), config), [scenario])], "newton-euler")
    assert np.linalg.norm(flown.error[flown.time > 11], axis=-1).max() < 2e-3


def test_it_is_told_of_gusts() -> None:
    """Of 0.2 N, correlated over a second: what one does before it is answered moves 2.2 kg by a few millimetres."""
    scenario = Scenario(seconds=SECONDS, disturbance=Disturbance(gust=0.2))
    names = ("oracle", "lqg")
    flown = simulate_batch(PAPER, [(make_baseline(name, PAPER), [scenario]) for name in names], "newton-euler")
    largest = np.linalg.norm(flown.error[flown.time > SETTLED], axis=-1).max(axis=0)
    assert largest[0] < 5e-3 < largest[1]


def test_it_refuses_to_fly_without_being_told() -> None:
    follower = make_baseline("oracle", PAPER)
    with pytest.raises(InputError, match="simulation only"):
        follower(np.zeros(18))
