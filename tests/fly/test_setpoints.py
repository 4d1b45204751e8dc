"""The command map: the paper's thrust law, the calibrated one, and bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tables import rows

from mjxfly import setpoints
from mjxfly.limits import Times
from mjxfly.packets import THRUST_CEILING, THRUST_FLOOR, PacketError
from mjxfly.setpoints import LINEAR, OLDER, CommandMap, ForceCurve

PAPER = CommandMap(thrust_model="paper")
CALIBRATED = CommandMap()


@pytest.mark.parametrize("vertical", [-2.0, 0.0, 1.0, 6.0])
def test_the_papers_law(vertical: float) -> None:
    assert setpoints.raw_thrust((0.1, 0.2, vertical), PAPER) == 46000 + 1000 * vertical


@given(st.floats(0.01, 0.45))
def test_force_curves_invert(force: float) -> None:
    for curve in (LINEAR, OLDER):
        assert curve.force(curve.thrust(force)) == pytest.approx(force, rel=1e-9)


def test_force_curves_are_the_documented_ones() -> None:
    assert OLDER.force(65535) == pytest.approx(4 * 0.159, rel=2e-3)  # crazyflie.md: max 0.159 N a motor
    assert LINEAR.force(65535) == pytest.approx(4 * 0.12)


@given(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.floats(-3, 3))
def test_the_calibrated_law_lifts_what_was_asked(roll: float, pitch: float, vertical: float) -> None:
    force = CALIBRATED.curve.force(setpoints.raw_thrust((roll, pitch, vertical), CALIBRATED))
    lift = force * math.cos(roll) * math.cos(pitch) / CALIBRATED.carried_mass - CALIBRATED.gravity
    assert lift == pytest.approx(vertical, abs=1e-9)


@given(
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    st.sampled_from([PAPER, CALIBRATED]),
)
def test_every_setpoint_is_within_bounds(command: tuple[float, ...], constants: CommandMap) -> None:
    sent = setpoints.to_setpoint(np.array(command), constants).setpoint
    assert THRUST_FLOOR <= sent.thrust <= THRUST_CEILING
    assert abs(sent.roll) <= 15 + 1e-9
    assert abs(sent.pitch) <= 15 + 1e-9


@pytest.mark.parametrize("slot", range(3))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused(slot: int, value: float) -> None:
    command = np.zeros(3)
    command[slot] = value
    with pytest.raises(PacketError):
        setpoints.to_setpoint(command, CALIBRATED)


def test_saturation_is_told() -> None:
    assert setpoints.to_setpoint(np.array([0.0, 0.0, 30.0]), PAPER).saturated
    assert not setpoints.to_setpoint(np.array([0.0, 0.0, 1.0]), PAPER).saturated


def test_signs_on_the_wire() -> None:
    sent = setpoints.to_setpoint(np.array([0.1, 0.2, 0.0]), PAPER).setpoint
    # Nose down (pitch > 0) goes out negative; the firmware keeps the heading.
    assert sent.roll == pytest.approx(math.degrees(0.1))
    assert sent.pitch == pytest.approx(-math.degrees(0.2))
    assert sent.yaw_rate == 0


def test_a_descent_holds_its_speed() -> None:
    """Of the thrust that hovers: all at the speed asked for, more if it falls faster, less if slower; 70 to 110 %."""
    times = Times(descend_speed=0.4)
    shares = [setpoints.sinking_share(climb, times) for climb in (1.0, 0.0, -0.3, -0.4, -0.5, -2.0)]
    assert shares == sorted(shares)
    assert shares[2] < 1 < shares[4]
    assert (shares[0], shares[3], shares[5]) == pytest.approx((0.7, 1.0, 1.1))


def test_the_trim_follows_the_thrust_within_bounds() -> None:
    """A running average over a second, never beyond 15 % of the thrust that should hover, however it is driven."""
    hover, period = 50000.0, 0.01
    for thrust, bound in ((60000.0, 57500.0), (10001.0, 42500.0), (51000.0, 51000.0)):
        trim, path = hover, []
        for _ in range(2000):
            trim = setpoints.smoothed(trim, thrust, period, hover)
            path.append(trim)
        assert trim == pytest.approx(bound, rel=1e-6)
        assert (min(path), max(path)) == (pytest.approx(min(path[0], bound)), pytest.approx(max(path[0], bound)))
        # Before a bound is met: 1 - exp(-t) of the way.
        early = hover + (thrust - hover) * (1 - math.exp(-20 * period))
        assert path[19] == pytest.approx(min(max(early, 42500.0), 57500.0), rel=1e-9)
    # A trim that is out of bounds already comes back at once.
    assert setpoints.smoothed(80000.0, hover, period, hover) == pytest.approx(57500.0)
    assert setpoints.smoothed(0.0, hover, period, hover) == pytest.approx(42500.0)


@rows("height, climb, left", [(0.4, 0.0, 1.75), (0.4, -0.3, 1.0), (0.8, 0.0, 1.75), (0.1, 0.0, 0.7), (0.0, 0.0, 1.0)])
def test_a_timed_descent_stands_in_time(height: float, climb: float, left: float) -> None:
    """Although one of two drones keeps its thrust, where physics lets it: 0.75 m/s2 of what is measured at most."""
    period, touched, within = 0.01, math.inf, 0.0
    for number in range(round(left / period)):
        share = setpoints.timed_share(height, climb, left - number * period)
        assert abs(share - 1) <= setpoints.UNEVEN / setpoints.GRAVITY + 1e-9
        climb += 0.5 * (share - 1) * setpoints.GRAVITY * period
        height += climb * period
        if height <= 0 and math.isinf(touched):
            touched, within = number * period, -climb
            break
    assert touched < left
    assert within < 1.2


def test_nothing_lifts_without_force() -> None:
    assert ForceCurve().thrust(-1.0) == 0.0
