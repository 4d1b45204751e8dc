"""How far the CG may be from O for the follower to trim it: against the rotors' own balance."""

from __future__ import annotations

import dataclasses

import pytest

from mjxball.config import Config, preset
from mjxball.control.constants import trim_limit


@pytest.fixture(scope="module")
def paper() -> Config:
    return preset("paper")


def test_reach_of_a_known_mass_by_hand(paper: Config) -> None:
    """0.2 kg: 10.791 N a drone, 2.698 N a rotor, 2 (5.5 - 2.698) 0.12 = 0.6725 N m, 85 % of it over 1.962 N."""
    assert trim_limit(paper.plant, 0.2, 0.15) == pytest.approx(0.85 * 0.67254 / 1.962, rel=1e-4)


@pytest.mark.parametrize(("mass", "believed"), [(0.2, 0.2), (0.5, 0.5), (0.3, 0.2), (0.1, 0.2)])
@pytest.mark.parametrize("drones", [(1.0, 1.0), (1.2, 0.9)])
@pytest.mark.parametrize("thrust", [(1.0, 1.0), (0.93, 0.8), (1.05, 1.2)])
def test_at_the_reach_everything_balances_and_one_rotor_is_at_its_limit(
    paper: Config, mass: float, believed: float, drones: tuple[float, float], thrust: tuple[float, float]
) -> None:
    """Force and moment about O of four weights' and eight rotors' forces, the leader's four alike."""
    pair = zip(paper.plant.drones, drones, strict=True)
    plant = dataclasses.replace(paper.plant, drones=tuple(dataclasses.replace(one, mass=own) for one, own in pair))
    gravity, half, arm = plant.gravity, plant.pair[0].mount[0], plant.arm
    offset = trim_limit(plant, mass, 0.0, believed, thrust)
    leader = thrust[0] * (drones[0] + believed / 2) * gravity
    follower = (sum(drones) + mass) * gravity - leader
    # On which side the CG is harder to hold depends on who lifts too little.
    side = 1.0 if leader - drones[0] * gravity >= mass * gravity / 2 else -1.0
    weights = [(half, drones[0]), (-half, drones[1]), (side * -offset, mass)]
    moment = half * leader - half * follower - gravity * sum(x * m for x, m in weights)
    # What is left must come from a difference between the follower's fore and aft rotors.
    fore, aft = follower / 4 - moment / (2 * arm), follower / 4 + moment / (2 * arm)
    assert max(fore, aft) == pytest.approx(thrust[1] * plant.rotor_force_max)


def test_a_mass_that_is_heavier_than_believed_leaves_less(paper: Config) -> None:
    assert trim_limit(paper.plant, 0.3, 0.15, 0.2) < trim_limit(paper.plant, 0.3, 0.15)
    assert trim_limit(paper.plant, 0.6, 0.15, 0.2) < 0
