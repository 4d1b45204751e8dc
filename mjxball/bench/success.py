"""When a flight succeeds beside references, and the summary of a track of mjxball-bench."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from mjxball.evaluate.metrics import Metrics


class Bound(NamedTuple):
    """By how much a number may exceed that of the best reference: by the larger of both."""

    absolute: float = 0.0  # in the unit of the number; of a peak [m] times the length of the plant
    relative: float = 0.0  # share of the reference's number


# A flight of mjxball-bench succeeds if it does not fail and is within these: peak [m], settling time [s], overshoot.
BOUNDS = {"peak": Bound(0.003), "settling": Bound(0.1, 0.1), "overshoot": Bound(0.01)}
CONFIDENCE = 0.95  # of the interval of the share of successes (Wilson 1927)


def numbers(metrics: Metrics) -> tuple[float, float, float]:
    """(peak [m], settling time [s], overshoot) of a flight, infinite where it failed or never settled."""
    if metrics.failed or not math.isfinite(metrics.peak):
        return math.inf, math.inf, math.inf
    settling = math.inf if metrics.settling_time is None else metrics.settling_time
    return metrics.peak, settling, math.inf if metrics.overshoot is None else metrics.overshoot


def limits(best: Mapping[str, Any], bounds: Mapping[str, Bound], length: Any = 1.0) -> dict[str, Any]:
    """The largest numbers that succeed, for each name of `bounds`, where references have `best`; arrays or floats.

    Infinite where no reference has a finite number. `length` of the plant, over that which the bounds are meant for.
    """
    most = {}
    for name, bound in bounds.items():
        absolute = bound.absolute * length if name == "peak" else bound.absolute
        most[name] = best[name] + np.maximum(absolute, bound.relative * best[name] if bound.relative else 0.0)
    return most


def bar(best: np.ndarray, length: float = 1.0) -> np.ndarray:
    """(flights, 3): the largest `numbers` with which flights succeed where references have `best` (flights, 3)."""
    return np.stack([*limits(dict(zip(BOUNDS, best.T, strict=True)), BOUNDS, length).values()], axis=1)


def successes(flown: Sequence[Metrics], bars: np.ndarray) -> list[bool]:
    """Whether each flight succeeds, of `bars` (flights, 3)."""
    return [
        not metrics.failed and bool((np.array(numbers(metrics)) <= most).all())
        for metrics, most in zip(flown, bars, strict=True)
    ]


def summary(flown: Sequence[Metrics], succeeded: Sequence[bool]) -> dict[str, Any]:
    """A track's numbers in one condition; None for what is infinite."""
    peak, settling, _ = np.array([numbers(one) for one in flown]).T
    interval = binomtest(sum(succeeded), len(succeeded)).proportion_ci(CONFIDENCE, method="wilson")
    sound = [one for one in flown if not one.failed]
    limit, change = (
        [getattr(one, name) for one in sound if getattr(one, name) is not None]
        for name in ("rotors_at_limit", "smoothness")
    )
    found = {
        "flights": len(flown),
        "met": sum(succeeded) / len(succeeded),
        "low": float(interval.low),
        "high": float(interval.high),
        "failed": sum(one.failed for one in flown) / len(flown),
        "settling_50": float(np.quantile(settling, 0.5, method="higher")),
        "peak_90": float(np.quantile(peak, 0.9, method="higher")),
        "rotors_at_limit": float(np.mean(limit)) if limit else math.inf,
        "command_change": float(np.median(change)) if change else math.inf,
    }
    return {name: value if math.isfinite(value) else None for name, value in found.items()}
