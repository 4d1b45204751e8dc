"""Teams that lose a drone in flight."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjxball.baselines import make_baseline
from mjxball.config import Config, preset
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import CIRCLE, Scenario

ENGINE = "newton-euler"


def losing(config: Config) -> list[Scenario]:
    """Six drones with a load on a circle lose each follower in turn."""
    flight = Scenario(omega=1.0, amplitude=0.1, mass=0.6, path=CIRCLE, goal=(0.0, 0.0, 0.0), seconds=12.0)
    return [dataclasses.replace(flight, lost=((k, 3.0),)) for k in config.plant.followers]


def test_a_law_that_is_told_of_the_loss_makes_up_for_it() -> None:
    """At the larger limit of commands that the rotors left over ask for."""
    config = preset("lost")
    follower = make_baseline("oracle", config)
    flights = simulate_batch(config, [(follower, losing(config))], ENGINE)
    distance = np.linalg.norm(flights.error, axis=-1)
    assert distance.max() < 0.3
    assert distance[-50:].max() < 0.05
