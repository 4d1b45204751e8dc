"""How a setting is declared: default, help text and bounds, all in the dataclass."""

from __future__ import annotations

from dataclasses import field
from typing import Any

Vector3 = tuple[float, float, float]
Range = tuple[float, float]


MOST = 256  # numbers in a tuple of any length


def setting(
    default: Any,
    about: str,
    *,
    low: float | None = None,
    high: float | None = None,
    ordered: bool = False,
    most: int = MOST,
) -> Any:
    """Declare a leaf: default, help text, and the range in which each of its numbers must lie, both ends included.

    Every number has one. It is what some flight or training could want, not what is wise; those of a plant leave room
    for a wrong unit, which `_plausible` names. `ordered` asks for low <= high of a pair; a tuple of any length holds at
    most `most` numbers.
    """
    if (low is None or high is None) and not isinstance(default, (bool, str)):
        raise TypeError(f"the setting of default {default!r} has no range: {about}")
    bounds = {"about": about, "low": low, "high": high, "ordered": ordered, "most": most}
    return field(default=default, metadata=bounds)


def drawn(default: Range, about: str, **bounds: Any) -> Any:
    """Declare a range that resets draw from, low <= high."""
    return setting(default, about, ordered=True, **bounds)
