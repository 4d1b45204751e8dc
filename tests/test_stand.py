"""The paper's test stand: the leader's wiring, the followers shipped for it, and what its figure's caption says."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from mjxball import config as configs
from mjxball.control.constants import plant_constants
from mjxball.control.followers import make_baseline
from mjxball.evaluate.paper import experiment
from mjxball.evaluate.paper.stand import LEVEL, SCENARIO, StandFlight, fly_stand, stand_config
from mjxball.policy import Policy
from mjxball.policy.shipped import stand_policies


def test_still_cg_tilts_a_copying_pair_as_far_as_its_attitude_loops_give_way() -> None:
    """m_o g c cos(phi) = 2 Kp phi on the pivot: equal vertical commands exert no torque about O."""
    setup = configs.replace(stand_config("pivot"), "leader.ki", (0.0, 0.0, 0.0))
    still = dataclasses.replace(SCENARIO, omega=0.0, phase=math.pi / 2, seconds=6.0)
    flight = fly_stand(setup, make_baseline("copy", setup), True, "newton-euler", still)
    kp = plant_constants(setup.plant, setup.attitude).gains.kp[0]
    lean = -0.2 * 9.81 * 0.05 / (2 * kp)  # the CG lies on the leader's side, which goes down
    assert flight.cg_offset[-1] == pytest.approx(0.05)
    # What is left after 6 s at 10 rad/s is rounding; cos(phi) is 1e-4 from 1.
    assert flight.roll[-1] == pytest.approx(lean, rel=3e-4)
    assert flight.height[-1] == pytest.approx(LEVEL + 0.17 * math.sin(flight.roll[-1]), abs=1e-9)


def test_leader_on_the_stand_flies_on_its_own_position() -> None:
    """Roll alone lifts the leader off its place: the error that copying is shown commands it down, O's does not."""
    setup = stand_config("pivot")
    start = dataclasses.replace(SCENARIO, seconds=0.02)
    own, objects = (fly_stand(setup, make_baseline("copy", setup), shown, "newton-euler", start) for shown in (1, 0))
    rise = 0.17 * math.sin(SCENARIO.start_tilt[0])
    assert own.height[0] == pytest.approx(LEVEL + rise)
    assert own.vertical[0] == pytest.approx(-0.1 * rise)  # kp_z of the paper's experiment
    assert objects.vertical[0] == 0.0


@pytest.mark.parametrize("stand", ["heave", "pivot"])
def test_shipped_stand_follower_balances_where_copying_only_holds(stand: str) -> None:
    (path,) = [path for path in stand_policies() if path.stem == f"stand-{stand}"]
    setup = stand_config(stand)
    mine = fly_stand(setup, Policy.load(path), False, "newton-euler")
    copied = fly_stand(setup, make_baseline("copy", setup), True, "newton-euler")
    assert experiment.roll_peak(mine) < 0.25 * experiment.roll_peak(copied)


def stand_flight(roll_degrees: float, height: float, follows: bool) -> StandFlight:
    """Two CG cycles of 20 s whose roll is in phase with the CG, or a quarter off."""
    time = np.arange(0, 40.001, 0.02)
    cg = np.sin(np.pi * time / 10)
    roll = np.radians(roll_degrees) * (-cg if follows else np.cos(np.pi * time / 10))
    roll[0] = np.radians(3)
    heights = np.full_like(time, LEVEL + height)
    heights[0] = LEVEL - 0.03
    return StandFlight(time, heights, roll, np.zeros_like(time), 0.05 * cg)


def test_stand_caption_says_what_is_left_of_roll_and_height() -> None:
    flights = {"copy": stand_flight(0.5, 0.02, True), "mine": stand_flight(0.25, 0.001, False)}
    agrees, differs = experiment.judged({"heave": flights, "pivot": {"copy": stand_flight(4.0, 0.0, False)}})
    start = "the roll of 3.00 deg at the start"
    assert agrees == (
        f'With roll and height free {start} is smaller after 20 s with copy (0.50 deg) and "mine" (0.25 deg).',
    )
    assert differs == (
        "With roll and height free what is left of the roll still follows the CG, by its correlation: copy (-1.00).",
        "With roll and height free the leader is still off its height after 20 s with copy (20.0 mm).",
        f"On the pivot {start} is not reduced by copy (4.00 deg).",
    )
