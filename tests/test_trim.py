"""How far the CG may be from O for the follower to trim it: against the rotors' own balance."""

from __future__ import annotations

import numpy as np
import pytest

from mjxball.config import Config, preset
from mjxball.control.constants import trim_reach


@pytest.fixture(scope="module")
def paper() -> Config:
    return preset("paper")


def test_reach_of_a_known_mass_by_hand(paper: Config) -> None:
    """0.2 kg: 10.791 N a drone, 2.698 N a rotor, 2 (5.5 - 2.698) 0.12 = 0.6725 N m, 85 % of it over 1.962 N."""
    assert trim_reach(paper.plant, 0.2, 0.15) == pytest.approx(0.85 * 0.67254 / 1.962, rel=1e-4)


@pytest.mark.parametrize(("mass", "believed"), [(0.2, 0.2), (0.5, 0.5), (0.3, 0.2), (0.1, 0.2)])
def test_at_the_reach_the_rotor_forces_balance_and_one_is_at_its_limit(
    paper: Config, mass: float, believed: float
) -> None:
    """Vertical force and pitch moment about O of eight rotors, the leader's four alike, vanish with one at F_max."""
    plant, gravity = paper.plant, paper.plant.gravity
    offset = trim_reach(plant, mass, 0.0, believed)
    leader = (plant.leader_mass + believed / 2) * gravity
    follower = (plant.leader_mass + plant.follower_mass + mass) * gravity - leader
    # The CG is on the side that loads the follower's pitch torque, on top of what the uneven lift does.
    lever = abs(plant.leader_mount[0])
    needed = mass * gravity * offset + lever * abs(follower - leader)
    fore_and_aft = follower / 4 + np.array([-1, 1]) * needed / (2 * plant.arm)
    assert fore_and_aft.max() == pytest.approx(plant.rotor_force_max)
    assert needed == pytest.approx(plant.arm * (fore_and_aft[1] - fore_and_aft[0]))


def test_a_mass_that_is_heavier_than_believed_leaves_less(paper: Config) -> None:
    assert trim_reach(paper.plant, 0.3, 0.15, 0.2) < trim_reach(paper.plant, 0.3, 0.15)
    assert trim_reach(paper.plant, 0.6, 0.15, 0.2) < 0
