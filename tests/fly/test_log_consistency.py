"""By how much signals of known lags are found to be late, and what motion says of axes and units."""

from __future__ import annotations

import numpy as np
import pytest
from tables import rows

from mjxball.control.rotations import integrate_quaternion
from mjxfly import log_consistency
from mjxfly.log_consistency import TURNING, faults, known, lag, turn, way
from mjxfly.log_sources import Samples

STEP = 0.01  # [s]


def rates(time: np.ndarray, noise: float = 0.0) -> Samples:
    """Body rates of a stick at `time` [s], of waves up to 3 Hz."""
    random = np.random.default_rng(3)
    waves = random.uniform(0.2, 3.0, (12, 3)), random.uniform(0, 6.0, (12, 3)), random.normal(size=(12, 3))
    clean = sum(0.05 * c * np.sin(2 * np.pi * f * time[:, None] + p) for f, p, c in zip(*waves, strict=True))
    return time, np.asarray(clean) + noise * random.normal(size=(len(time), 3))


@rows(
    ("late", "faster", "noise", "within"),
    [
        (0.0, 1.0, 0.0, 1e-3),
        (0.0234, 1.0, 0.0, 1e-3),
        (-0.15, 1.0, 0.05, 3e-3),
        (300.0, 1.0, 0.05, 3e-3),
        (-0.05, 1.002, 0.05, 5e-3),
        (0.1, 1.01, 0.0, 1e-2),
    ],
)
def test_the_lag_of_one_signal_against_another_is_found(
    late: float, faster: float, noise: float, within: float
) -> None:
    """The second clock shows `late` + `faster` t; what it shows is brought back to the first one's."""
    time = np.arange(0, 20, STEP)
    when, values = rates(time, noise)
    found = lag(rates(time), (late + faster * when, values), TURNING)
    assert found.clear
    assert found.at_begin == pytest.approx(late + (faster - 1) * found.begin, abs=within)
    assert found.at_end == pytest.approx(late + (faster - 1) * found.end, abs=within)
    np.testing.assert_allclose(found.on_first_clock(late + faster * time), time, atol=within)


def test_signals_that_have_nothing_in_common_are_not_clear() -> None:
    time, random = np.arange(0, 20, STEP), np.random.default_rng(4)
    found = lag(rates(time), (time, 0.2 * random.normal(size=(len(time), 3))), TURNING)
    assert not found.clear
    assert found.alike < log_consistency.ALIKE
    still = lag(rates(time), (time, np.zeros((len(time), 3))), TURNING)
    assert (still.clear, still.alike) == (False, 0.0)


@rows("faster", [0.5, 1.0, 1.3])
def test_motion_tells_the_speed_of_its_clock(faster: float) -> None:
    time = np.arange(0, 10, STEP)
    velocity = rates(time)[1]
    position = np.cumsum(velocity, axis=0) * STEP
    attitudes = [np.array([1.0, 0.0, 0.0, 0.0])]
    for one in velocity[:-1]:
        attitudes.append(integrate_quaternion(attitudes[-1], one * STEP))
    moved, turned = way(faster * time, position, velocity), turn(faster * time, np.array(attitudes), velocity)
    for found in (moved, turned):
        assert found.ratio == pytest.approx(1 / faster, abs=0.01)
        assert found.error == pytest.approx(abs(1 / faster - 1) * found.size * faster, abs=0.1 * found.size)


@rows(
    ("moves", "turns", "wrong"),
    [
        (1.0, 1.0, False),
        (1.2, 1.0, False),  # a Kalman filter's velocities, in public flights
        (1.0, 0.85, False),
        (1.2, 0.85, False),
        (1.3, 1.3, True),
        (0.77, 0.77, True),
        (0.5, 1.0, True),
        (1.0, 57.3, True),
    ],
)
def test_a_clock_is_wrong_where_positions_and_attitudes_agree_that_it_is(
    moves: float, turns: float, wrong: bool
) -> None:
    """They change by these factors of velocities and rates; one of both must be far off to count by itself."""
    time = np.arange(0, 10, STEP)
    velocity = rates(time)[1]
    attitudes = [np.array([1.0, 0.0, 0.0, 0.0])]
    for one in velocity[:-1]:
        attitudes.append(integrate_quaternion(attitudes[-1], one * STEP))
    places = np.cumsum(velocity, axis=0) * STEP
    states = time, np.concatenate([places, velocity / moves, np.array(attitudes), velocity / turns], axis=1)
    sent = np.zeros((len(time), 2, 4)) + 30000.0
    assert len(faults((time, sent), [states, states])) == (2 if wrong else 0)


def test_nothing_is_known_within_a_hole() -> None:
    at = np.concatenate([np.arange(0, 1, STEP), np.arange(1.4, 2, STEP)])
    time = np.array([-0.2, -0.05, 0.0, 0.5003, 0.99, 1.1, 1.3999, 1.4, 1.9, 2.05, 2.2])
    assert known(time, at).tolist() == [False, True, True, True, True, False, False, True, True, True, False]
    slow = np.arange(0, 2, 0.2)
    assert known(np.array([0.3, 1.7]), slow).all()
