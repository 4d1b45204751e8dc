"""When a flight of mjxball-bench is met, and what a track comes to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from mjxball.evaluate.metrics import Metrics

# A flight is met if it does not fail and has, of the best that a reference has there, at most
PEAK = 0.003  # more peak [m], times the world's length
LATER, LATER_SECONDS = 0.1, 0.1  # so much later settling, whichever is more: share, [s]
OVERSHOOT = 0.01  # more overshoot
CONFIDENCE = 0.95  # of the interval of what is met (Wilson 1927)


def numbers(metrics: Metrics) -> tuple[float, float, float]:
    """(peak [m], settling time [s], overshoot) of a flight, infinite where it failed or never settled."""
    if metrics.failed or not math.isfinite(metrics.peak):
        return math.inf, math.inf, math.inf
    settling = math.inf if metrics.settling_time is None else metrics.settling_time
    return metrics.peak, settling, math.inf if metrics.overshoot is None else metrics.overshoot


def later(settling: Any) -> Any:
    """The latest settling time [s], or times, with which a flight is met where a reference has `settling`."""
    return settling + np.maximum(LATER_SECONDS, LATER * settling)


def bar(best: np.ndarray, length: float = 1.0) -> np.ndarray:
    """(flights, 3): the largest `numbers` with which flights are met where references have `best` (flights, 3)."""
    peak, settling, overshoot = best.T
    return np.stack([peak + PEAK * length, later(settling), overshoot + OVERSHOOT], axis=1)


def are_met(flown: Sequence[Metrics], bars: np.ndarray) -> list[bool]:
    """Whether each flight is met, of `bars` (flights, 3)."""
    return [
        not metrics.failed and bool((np.array(numbers(metrics)) <= most).all())
        for metrics, most in zip(flown, bars, strict=True)
    ]


def summary(flown: Sequence[Metrics], met: Sequence[bool]) -> dict[str, Any]:
    """A track's numbers in one condition; None for what is infinite."""
    peak, settling, _ = np.array([numbers(one) for one in flown]).T
    interval = binomtest(sum(met), len(met)).proportion_ci(CONFIDENCE, method="wilson")
    sound = [one for one in flown if not one.failed]
    limit, change = (
        [getattr(one, name) for one in sound if getattr(one, name) is not None]
        for name in ("rotors_at_limit", "smoothness")
    )
    found = {
        "flights": len(flown),
        "met": sum(met) / len(met),
        "low": float(interval.low),
        "high": float(interval.high),
        "failed": sum(one.failed for one in flown) / len(flown),
        "settling_50": float(np.quantile(settling, 0.5, method="higher")),
        "peak_90": float(np.quantile(peak, 0.9, method="higher")),
        "rotors_at_limit": float(np.mean(limit)) if limit else math.inf,
        "command_change": float(np.median(change)) if change else math.inf,
    }
    return {name: value if math.isfinite(value) else None for name, value in found.items()}
