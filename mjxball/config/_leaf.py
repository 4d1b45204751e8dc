"""Declaration of a setting in its dataclass: default, help text, bounds."""

from __future__ import annotations

from dataclasses import field
from typing import Any

Vector3 = tuple[float, float, float]
Range = tuple[float, float]


MOST = 256  # entries of a tuple of any length


def setting(
    default: Any,
    about: str,
    *,
    low: float | None = None,
    high: float | None = None,
    ordered: bool = False,
    most: int = MOST,
) -> Any:
    """Declare a setting: default, help text, and the closed range for each of its numbers.

    Every number needs a range. It covers what some flight or training could use, not only what is sensible; the ranges
    of a plant are wide enough for a value in a wrong unit, which `_plausible` reports with a hint. `ordered` requires
    low <= high of a pair; a tuple of any length has at most `most` entries.
    """
    if (low is None or high is None) and not isinstance(default, (bool, str)):
        raise TypeError(f"the setting of default {default!r} has no range: {about}")
    bounds = {"about": about, "low": low, "high": high, "ordered": ordered, "most": most}
    return field(default=default, metadata=bounds)


def sampled(default: Range, about: str, **bounds: Any) -> Any:
    """Declare a range (low, high) from which every reset samples uniformly."""
    return setting(default, about, ordered=True, **bounds)
