"""Offset-free LQG of a pair: its estimates against what the load does."""

from __future__ import annotations

import numpy as np
import pytest

from mjxball.baselines import make_baseline, make_controller
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario


def estimates(mass: float, believed: float, offset: float) -> tuple[float, float]:
    """Torque of the load [N m] and error of the lift [m/s2] after 12 s with a load at rest at `offset` [m]."""
    follower = make_baseline("lqg-offset-free", preset("paper"))
    scenario = Scenario(
        omega=0.0,
        phase=np.copysign(np.pi / 2, offset),
        amplitude=abs(offset),
        mass=mass,
        believed_mass=believed,
        seconds=12,
    )
    flown = simulate(preset("paper"), follower, scenario, "newton-euler")
    assert np.abs(flown.error[-1]).max() < 2e-4
    _, torque, lift = follower.controller.estimate(follower._state, flown.observation[-1])
    return torque.item(), lift.item()


@pytest.mark.parametrize(("mass", "offset"), [(0.2, 0.05), (0.4, -0.1)])
def test_it_finds_the_loads_torque(mass: float, offset: float):
    """d = m g c at rest, less by what the filter takes the thrusts for: they carry the nominal 0.2 kg."""
    torque, lift = estimates(mass, mass, offset)
    assert torque == pytest.approx(mass * 9.81 * offset, rel=2e-3)
    assert abs(lift) < 1e-3


def test_it_finds_what_a_mass_that_nobody_knows_pulls():
    """The follower lifts it alone, commanding (m - m^) g over the 1.1 kg it believes to lift; half is both's mean."""
    _, lift = estimates(0.3, 0.2, 0.0)
    assert lift == pytest.approx(-0.5 * 0.1 * 9.81 / 1.1, rel=1e-3)


def test_other_plants_are_refused():
    with pytest.raises(InputError, match="free pair along x"):
        make_controller("lqg-offset-free", preset("flight"))
