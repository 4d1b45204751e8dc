"""When a flight succeeds, why it does not, and what a track's results say."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from tables import rows

from mjxball.bench.success import REASONS, deadline, interval, reasons, summary
from mjxball.evaluate.metrics import Metrics

GOOD = Metrics(
    **{
        **dict.fromkeys((one.name for one in dataclasses.fields(Metrics)), 0.0),
        **{"failed": False, "reached": 3.8, "arrival": 4.9, "late_error": 0.004, "rotor_limit_share": 0.05},
        **{"rotor_power": 1.1, "smoothness": 0.01},
    }
)
LATEST = deadline(4.0, moving=False)  # 5 s


def but(**changed: float | bool | None) -> Metrics:
    """A good flight with other values."""
    return dataclasses.replace(GOOD, **changed)


def test_the_deadline_is_a_quarter_later_than_the_oracle_and_3_s_for_moving_goals() -> None:
    assert pytest.approx(5.0) == LATEST
    assert deadline(4.0, moving=True) == 3.0
    # Times of flights are multiples of a period, and their products are rounded: 1.25 x 8.88 s is 11.1 s.
    assert deadline(444 * 0.02, moving=False) >= 555 * 0.02


@rows(
    "metrics, cpu_time, found",
    [
        (GOOD, 0.02, ()),
        (but(arrival=5.0), 0.0, ()),
        (but(arrival=5.02), 0.0, ("leaves",)),
        (but(arrival=None), 0.0, ("leaves",)),
        (but(reached=5.02, arrival=5.0), 0.0, ("late",)),
        (but(reached=None, arrival=None), 0.0, ("late",)),
        (but(rotor_limit_share=0.051), 0.0, ("rotors",)),
        (but(rotor_limit_share=None), 0.0, ("rotors",)),
        (GOOD, 0.021, ("slow",)),
        (but(arrival=9.0, rotor_limit_share=0.5), 0.03, ("leaves", "rotors", "slow")),
        (but(failed=True, reached=None, rotor_limit_share=1.0), 0.03, ("crashed",)),
    ],
)
def test_why_a_flight_does_not_succeed(metrics: Metrics, cpu_time: float, found: tuple[str, ...]) -> None:
    assert reasons(metrics, LATEST, cpu_time) == found


def test_results_of_a_track_count_flights_and_take_the_middle_and_the_tail() -> None:
    """Ten flights: six succeed, one each crashes, is late, leaves and leaves with its rotors at a limit."""
    flown = [but(arrival=3.0 + 0.1 * number, late_error=0.001 * number) for number in range(6)]
    flown += [but(failed=True), but(reached=None, arrival=None, late_error=0.5), but(arrival=6.0, late_error=0.02)]
    flown += [but(arrival=7.0, late_error=0.03, rotor_limit_share=0.95, rotor_power=2.0)]
    why = [reasons(one, LATEST) for one in flown]
    found = summary(flown, why, [4.0] * 10)
    assert (found["flights"], found["succeeded"]) == (10, 6)
    assert found["reasons"] == {"crashed": 1, "late": 1, "leaves": 2, "rotors": 1, "slow": 0}
    assert list(found["reasons"]) == list(REASONS)
    assert found["arrival_ratio"] == pytest.approx(3.4 / 4.0)  # the fifth of ten
    assert found["late_error_90"] == 0.5  # the ninth: the tenth crashed
    assert found["rotor_limit_share"] == pytest.approx((8 * 0.05 + 0.95) / 9)
    assert (found["rotor_power"], found["command_change"]) == (1.1, 0.01)
    nothing = summary([but(failed=True)] * 2, [("crashed",)] * 2, [4.0] * 2)
    for name in ("arrival_ratio", "late_error_90", "rotor_power", "rotor_limit_share", "command_change"):
        assert nothing[name] is None


def test_the_interval_is_wilsons() -> None:
    """By its closed form, z = 1.96."""
    for succeeded in (0, 37, 120):
        share, z, n = succeeded / 120, 1.959963984540054, 120
        middle = (share + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
        np.testing.assert_allclose(interval(succeeded, n), (middle - half, middle + half), atol=1e-12)
