"""The search of tunings: its flights and what it makes small."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import tuning
from mjxball.baselines.oracle import Oracle
from mjxball.config import preset


@pytest.fixture(scope="module")
def part() -> tuning.Part:
    """Two flights of the pair in each condition."""
    with ThreadPoolExecutor(1) as pool:
        (found,) = tuning.flights_of(["pair"], "both", 2, None, pool)
    return found


@pytest.mark.slow
def test_the_compiled_program_of_oracle_arrives_when_the_benchmark_says_so(part) -> None:
    """To a control step: the program is in float32."""
    assert part.conditions.tolist() == ["calm"] * 2 + ["disturbed"] * 2
    arrays = tuning.TUNED["oracle"].arrays(part.config, Oracle.tuning)
    flown = tuning.Flown("oracle", part.of_oracle(1.0))(jax.tree.map(lambda leaf: np.asarray(leaf)[None], arrays))
    np.testing.assert_allclose(flown.time[0], part.known, atol=1.01 * part.config.timing.control_period)
    numbers = tuning.numbers_of(flown, part, absolute=False)
    np.testing.assert_allclose(numbers["cost"] - 1.0 + numbers["succeeded"], 1.0, atol=0.02)  # of its own time


@pytest.mark.slow
def test_sets_that_fly_together_do_what_they_do_alone(part) -> None:
    """In the calm flights; a disturbed one whose rotors are at their limits doubles the last digit's rounding."""
    start = tuning.TUNED["mpc"].start
    tunings = [start, start._replace(position=2.0 * start.position), start._replace(delay=0.0)]
    with ThreadPoolExecutor(1) as pool:
        together, alone = (tuning.fly_all("mpc", part, tunings, None, pool, cores) for cores in (1, 3))
    for mine, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(mine[:, :2], other[:, :2], rtol=1e-6)
    assert len(np.unique(together.peak[:, 0])) == 3


def test_the_cost_of_a_flight_is_its_time_over_the_oracles_and_one_without_success() -> None:
    known, deadlines = np.array([2.0, 2.0, 2.0, 2.0]), np.array([2.5] * 4)
    part = tuning.Part(preset("paper"), [], np.ones(4), np.array(["calm"] * 4), known, deadlines)
    measured = tuning.Measured(
        np.array([[2.2, 2.2, 3.0, math.inf]]), np.array([[0.0, 0.1, 0.0, 0.0]]), np.zeros((1, 4))
    )
    found = tuning.numbers_of(measured, part, absolute=False)
    np.testing.assert_allclose(found["cost"], [[1.1, 2.1, 2.5, 5.0]])
    np.testing.assert_array_equal(found["succeeded"], [[1.0, 0.0, 0.0, 0.0]])
