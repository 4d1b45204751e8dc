"""The shipped followers of teams that lose a drone in flight."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjxball.config import Config, preset
from mjxball.evaluate.policies import load_policy
from mjxball.policy.file import shipped_policy
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import CIRCLE, Scenario

ENGINE = "newton-euler"


def losing(config: Config) -> list[Scenario]:
    """Six drones with a load on a circle lose each follower in turn."""
    flight = Scenario(omega=1.0, amplitude=0.1, mass=0.6, path=CIRCLE, goal=(0.0, 0.0, 0.0), seconds=12.0)
    return [dataclasses.replace(flight, lost=((k, 3.0),)) for k in config.plant.followers]


@pytest.mark.slow
def test_the_shipped_policy_makes_up_for_it() -> None:
    config = preset("lost")
    flights = simulate_batch(config, [(load_policy(shipped_policy("lost"), config), losing(config))], ENGINE)
    distance = np.linalg.norm(flights.error, axis=-1)
    assert distance.max() < 0.3
    assert distance[-50:].max() < 0.05


@pytest.mark.slow
def test_four_drones_come_down_slowly_and_upright_without_a_neighbour_of_the_leader() -> None:
    """From the goal, for 12 s after the loss, the load resting in the middle."""
    config = preset("descent")
    lost = [Scenario(amplitude=0.0, mass=0.4, seconds=20.0, lost=((number, 8.0),)) for number in (1, 3)]
    flights = simulate_batch(config, [(load_policy(shipped_policy("descent"), config), lost)], ENGINE)
    after = flights.time > 8.0
    assert np.linalg.norm(flights.error[~after][-50:], axis=-1).max() < 0.02
    assert flights.velocity[after][..., 2].min() > -1.0
    tilts = np.arccos(np.cos(flights.euler[after][..., 0]) * np.cos(flights.euler[after][..., 1]))
    assert tilts.max() < np.radians(30)
