"""The one definition of success, and the summary of a track's flights.

A flight succeeds if the object reaches its goal at most 25 % later than with the oracle, a controller that knows
everything, and stays there to the end, with no rotor at its limit for more than 5 % of the time. "There" is within a
radius about the goal, see `mjxball.bench.tracks`. A goal that moves must be followed within the radius from 3 s on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjxball.evaluate.metrics import Metrics

LATER = 1.25  # largest arrival over that of the oracle
MOVING_DEADLINE = 3.0  # from which on a goal that moves must be followed [s]
MAX_ROTOR_SHARE = 0.05  # of the time at a limit, of any one rotor
# CPU time of the follower for one control step of one flight [s]: that of the slowest call for all flights on a plant
# over their number, but for the first calls (`process.RemoteFollower`). No step of one flight alone is timed.
MAX_CPU_TIME = 0.020
SOONEST = 0.1  # of an oracle's arrival that another is compared with; it may be there from the start [s]
ROUNDING = 1e-9  # of a time [s]
CONFIDENCE = 0.95  # of the interval of the share of successes (Wilson 1927)
# Why flights do not succeed. A crash has no other reason, and late and leaves exclude each other.
REASONS = {
    "crashed": "O is farther from the goal than scenario.termination_distance, or a value is not finite",
    "late": "the object is within the radius for the first time after the deadline, or never",
    "leaves": "it was there in time, but is beyond the radius after the deadline",
    "rotors": f"a rotor is at its limit for more than {100 * MAX_ROTOR_SHARE:g} % of the time",
    "slow": f"a control step takes more than {1e3 * MAX_CPU_TIME:g} ms of CPU time for each flight on the plant",
}


def deadline(oracle_arrival: float, moving: bool) -> float:
    """When the object must have arrived for good [s], where with the oracle it arrives at `oracle_arrival` [s]."""
    return MOVING_DEADLINE if moving else LATER * oracle_arrival + ROUNDING


def reasons(metrics: Metrics, deadline: float, cpu_time: float = 0.0) -> tuple[str, ...]:
    """Keys of `REASONS` why a flight does not succeed; () if it does.

    `metrics` were measured with the flight's radius; `cpu_time` [s] is that of `MAX_CPU_TIME`.
    """
    if metrics.failed:
        return ("crashed",)
    found = []
    if metrics.reached is None or metrics.reached > deadline:
        found.append("late")
    elif metrics.arrival is None or metrics.arrival > deadline:
        found.append("leaves")
    if metrics.rotor_limit_share is None or metrics.rotor_limit_share > MAX_ROTOR_SHARE:
        found.append("rotors")
    if cpu_time > MAX_CPU_TIME:
        found.append("slow")
    return tuple(found)


def interval(succeeded: int, flights: int) -> tuple[float, float]:
    """Wilson's 95 % interval of the share of successes."""
    from scipy.stats import binomtest  # takes half a second to import

    found = binomtest(succeeded, flights).proportion_ci(CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


def summary(
    flown: Sequence[Metrics], failures: Sequence[tuple[str, ...]], oracle_arrivals: Sequence[float]
) -> dict[str, Any]:
    """Results of a track in one condition: counts, and values that are None where they would be infinite.

    `failures` are the `reasons` of each flight, `oracle_arrivals` the times [s] at which the oracle arrives. Rotor and
    command values are those of flights that did not crash.
    """
    sound = [one for one in flown if not one.failed]
    ratios = [
        math.inf if one.failed or one.arrival is None else one.arrival / max(oracle, SOONEST)
        for one, oracle in zip(flown, oracle_arrivals, strict=True)
    ]
    errors = [math.inf if one.failed or one.late_error is None else one.late_error for one in flown]
    found = {
        # Median arrival over the oracle's; 90 % quantile of the largest errors after the deadline [m].
        "arrival_ratio": _quantile(ratios, 0.5),
        "late_error_90": _quantile(errors, 0.9),
        # Median power over hover; mean share of the time of the rotor that is longest at a limit; median change [rad].
        "rotor_power": _quantile([one.rotor_power for one in sound], 0.5),
        "rotor_limit_share": float(np.mean([one.rotor_limit_share for one in sound])) if sound else math.inf,
        "command_change": _quantile([one.smoothness for one in sound], 0.5),
    }
    return {
        "flights": len(flown),
        "succeeded": sum(not one for one in failures),
        "reasons": {name: sum(name in one for one in failures) for name in REASONS},
        **{name: value if math.isfinite(value) else None for name, value in found.items()},
    }


def _quantile(values: Sequence[float | None], share: float) -> float:
    """The smallest of `values` that at least `share` of them do not exceed; None counts as infinite."""
    known = [math.inf if value is None else value for value in values]
    return float(np.quantile(known, share, method="inverted_cdf")) if known else math.inf
