"""Bounds of numbers beside those of references, for scripts that compare flight by flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mjxball.evaluate.metrics import Metrics


class Bound(NamedTuple):
    """By how much a number may exceed that of the best reference: by the larger of both."""

    absolute: float = 0.0  # in the unit of the number; of a peak [m] times the length of the plant
    relative: float = 0.0  # share of the reference's number


BOUNDS = {"peak": Bound(0.003), "settling": Bound(0.1, 0.1), "overshoot": Bound(0.01)}


def numbers(metrics: Metrics) -> tuple[float, float, float]:
    """(peak [m], settling time [s], overshoot) of a flight, infinite where it failed or never settled."""
    if metrics.failed or not math.isfinite(metrics.peak):
        return math.inf, math.inf, math.inf
    settling = math.inf if metrics.settling_time is None else metrics.settling_time
    return metrics.peak, settling, math.inf if metrics.overshoot is None else metrics.overshoot


def limits(best: Mapping[str, Any], bounds: Mapping[str, Bound], length: Any = 1.0) -> dict[str, Any]:
    """The largest numbers within `bounds` of those that references have, `best`; arrays or floats.

    Infinite where no reference has a finite number. `length` of the plant, over that which the bounds are meant for.
    """
    most = {}
    for name, bound in bounds.items():
        absolute = bound.absolute * length if name == "peak" else bound.absolute
        most[name] = best[name] + np.maximum(absolute, bound.relative * best[name] if bound.relative else 0.0)
    return most
