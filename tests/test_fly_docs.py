"""docs/flying.md against the code: the supervisor's table, its states, and the numbers it quotes."""

from __future__ import annotations

import math

import pytest
from command_line import REPOSITORY

from mjxball.fly import limits, maneuver, supervisor
from mjxball.fly.command import CommandMap
from mjxball.fly.limits import Limits
from mjxball.fly.main import make_parser
from mjxball.fly.maneuver import Times
from mjxball.fly.packets import THRUST_CEILING, THRUST_FLOOR
from mjxball.fly.supervisor import State

TEXT = (REPOSITORY / "docs" / "flying.md").read_text(encoding="utf-8")
FLAT = " ".join(TEXT.split())
BOUNDS, TIMES, MAP = Limits(), Times(), CommandMap()


def test_the_table_is_the_codes() -> None:
    assert supervisor.markdown() in TEXT


def test_every_state_is_explained() -> None:
    for state in State:
        assert f"| {state.value} | " in TEXT


def test_every_flag_is_named() -> None:
    for action in make_parser()._actions:
        if action.option_strings and action.dest not in ("help", "version"):
            assert action.option_strings[-1] in TEXT


@pytest.mark.parametrize(
    "phrase",
    [
        f"state {1000 * BOUNDS.state_age:.0f} ms old",
        f"fence ±{BOUNDS.fence_high[0]:g} m and {BOUNDS.fence_low[2]:g} .. {BOUNDS.fence_high[2]:g} m",
        f"tilt {math.degrees(BOUNDS.tilt):.0f} degrees; stick {math.degrees(BOUNDS.stick_tilt):.0f} degrees",
        f"{100 * BOUNDS.stick_error:.0f} cm too long",
        f"in *hold* {math.degrees(BOUNDS.hold_tilt):.0f} degrees of the drone that is heard",
        f"battery below {BOUNDS.battery:g} V for {BOUNDS.battery_time:g} s",
        f"at a bound for {BOUNDS.saturation_time:g} s",
        f"more than {BOUNDS.missed_deadlines} deadlines missed in a second or {1000 * BOUNDS.longest_gap:.0f} ms",
        f"rising to hover in {TIMES.ramp:g} s",
        f"sinks at {TIMES.land_speed:g} m/s",
        f"holds {TIMES.descend_speed:g} m/s downward by the measured speed; {TIMES.descend_limit:g} s at most",
        f"up to {100 * maneuver.GENTLE / maneuver.GRAVITY:.0f} % below",
        f"until {TIMES.drone_watchdog:g} s after",
        f"±{math.degrees(MAP.tilt_limit):.0f} degrees and {THRUST_FLOOR} to {THRUST_CEILING} units",
        f"{math.degrees(MAP.tilt_slew):.0f} degrees/s, {MAP.thrust_slew:.0f} units/s",
    ],
)
def test_numbers_are_the_codes(phrase: str) -> None:
    assert phrase in FLAT


def test_it_says_what_was_never_done() -> None:
    assert "No real radio was ever used, and no real drone ever flown" in FLAT
    assert limits.NAMES == ("leader", "follower")
