"""The paper's test stand: the leader's wiring, the follower shipped for it, and what its figure's caption says."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from plants import BEAM

from mjxball import config as configs
from mjxball.config import Config, Leader, ball_reach
from mjxball.control.constants import plant_constants
from mjxball.control.followers import make_baseline
from mjxball.evaluate.paper import experiment
from mjxball.evaluate.paper.stand import LEVEL, SCENARIO, SETTINGS, StandFlight, fly_stand, stand_config
from mjxball.policy import Policy
from mjxball.policy.shipped import shipped_policy


def pivoted() -> Config:
    """The reference pair laid across a pivot at O, its attitude loops ideal, its CG prescribed."""
    gains = Leader(kp=(1.0, 1.0, 0.1), kd=(2.0, 2.0, 5.0), error="own")
    return configs.validate(dataclasses.replace(configs.preset("paper"), plant=BEAM, leader=gains))


def test_still_cg_tilts_a_copying_pair_as_far_as_its_attitude_loops_give_way() -> None:
    """m_o g c cos(phi) = 2 Kp phi on the pivot: equal vertical commands exert no torque about O."""
    setup = pivoted()
    still = dataclasses.replace(
        SCENARIO, mass=0.2, amplitude=0.05, omega=0.0, phase=math.pi / 2, ball_start=0.0, seconds=6.0
    )
    flight = fly_stand(setup, make_baseline("copy", setup), True, "newton-euler", still)
    kp = plant_constants(setup.plant, setup.attitude).gains.kp[0]
    lean = -0.2 * 9.81 * 0.05 / (2 * kp)  # the CG lies on the leader's side, which goes down
    assert flight.ball[-1] == pytest.approx(0.05)
    # What is left after 6 s at 10 rad/s is rounding; cos(phi) is 1e-4 from 1.
    assert flight.roll[-1] == pytest.approx(lean, rel=3e-4)
    assert flight.height[-1] == pytest.approx(LEVEL + 0.17 * math.sin(flight.roll[-1]), abs=1e-9)


def test_leader_on_the_stand_flies_on_its_own_position() -> None:
    """Roll alone lifts the leader off its place: the error that copying is shown commands it down, O's does not."""
    setup = stand_config()
    start = dataclasses.replace(SCENARIO, start_position=(0.0, 0.0, 0.0), seconds=0.02)
    own, objects = (fly_stand(setup, make_baseline("copy", setup), shown, "newton-euler", start) for shown in (1, 0))
    rise = 0.15 * math.sin(SCENARIO.start_tilt[0])
    assert own.height[0] == pytest.approx(LEVEL + rise)
    assert own.vertical[0] == pytest.approx(-0.1 * rise, rel=1e-3)  # kp_z of the paper's experiment
    assert objects.vertical[0] == pytest.approx(0.0, abs=1e-12)


@pytest.fixture(scope="module")
def flown() -> dict[str, dict[str, StandFlight]]:
    """30 s of copying and of the shipped follower, with the paper's settings and with better ones."""
    scenario, mine = dataclasses.replace(SCENARIO, seconds=30.0), Policy.load(shipped_policy("stand"))
    setups = {settings: stand_config(settings) for settings in SETTINGS}
    return {
        settings: {
            "copy": fly_stand(setup, make_baseline("copy", setup), True, "newton-euler", scenario),
            "mine": fly_stand(setup, mine, False, "newton-euler", scenario),
        }
        for settings, setup in setups.items()
    }


@pytest.mark.parametrize("settings", SETTINGS)
def test_shipped_follower_keeps_the_ball_that_copying_loses(settings: str, flown: dict) -> None:
    mine, copied = flown[settings]["mine"], flown[settings]["copy"]
    reach = ball_reach(stand_config().plant)
    assert np.abs(mine.ball).max() < 0.9 * reach
    assert np.abs(copied.ball).max() > reach - experiment.AT_STOP
    assert experiment.roll_rms(mine) < 0.1
    assert experiment.height_peak(mine) < 0.5 * experiment.height_peak(copied)


def test_better_settings_do_not_let_the_height_drift(flown: dict) -> None:
    """The paper's leader has kp_z = 0.1: what a copying pair loses in height while the ball rolls stays lost."""
    assert experiment.height_peak(flown["better"]["copy"]) < 0.2 * experiment.height_peak(flown["paper"]["copy"])


def stand_flight(roll_degrees: float, height: float, ball: float) -> StandFlight:
    """40 s of a still roll, height and ball, from 3 degrees and 3 cm off."""
    time = np.arange(0, 40.001, 0.02)
    roll = np.full_like(time, np.radians(roll_degrees))
    roll[0] = np.radians(3)
    heights = np.full_like(time, LEVEL + height)
    heights[0] = LEVEL - 0.03
    return StandFlight(time, heights, roll, np.zeros_like(time), np.linspace(0, ball, time.size))


def test_stand_caption_says_what_is_left_of_roll_height_and_ball() -> None:
    flights = {"copy": stand_flight(0.5, 0.02, 0.08), "mine": stand_flight(0.25, 0.001, -0.04)}
    assert experiment.ball_range(flights["mine"]) == pytest.approx(0.02)
    agrees, differs = experiment.judged({"paper": flights, "better": {"copy": stand_flight(4.0, 0.0, 0.0)}}, 0.08)
    start = "the roll of 3.00 deg at the start"
    assert agrees == (
        f'With the paper\'s gains {start} is smaller after 20 s with copy (0.50 deg rms) and "mine" (0.25 deg rms).',
    )
    assert differs == (
        "With the paper's gains the ball runs into a stop with copy.",
        "With the paper's gains the leader is still off its height after 20 s with copy (20.0 mm).",
        f"With better settings {start} is not reduced by copy (4.00 deg rms).",
    )
