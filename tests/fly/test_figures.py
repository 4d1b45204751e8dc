"""Figures of a flight under both controllers."""

from __future__ import annotations

import numpy as np
import pytest

from mjxfly.figures import LEAST, SETTLING, Flown


def test_figures_are_of_two_seconds_at_least_and_show_the_motors() -> None:
    """Motors that give 8 % more and 8 % less are sent 7 % less and 9 % more; what is settling counts for nothing."""
    monitor = Flown()
    for tick in range(round(100 * (SETTLING + LEAST)) + 10):
        settled = tick >= 100 * SETTLING
        shares = (1 / 1.08, 1 / 0.92) if settled else (0.5, 0.5)
        monitor.update(10 + tick / 100, tick / 100, 0.02 if settled else 1.0, 0.01, shares)
        if tick < 100 * (SETTLING + LEAST) - 1:
            assert monitor.figures is None
    figures = monitor.figures
    assert figures is not None
    assert figures.error_rms == pytest.approx(0.02)
    np.testing.assert_allclose(figures.thrust, shares)
    assert "thrust -7 / +9 %" in str(figures)
