"""How a setting is declared: default, help text and bounds, all in the dataclass."""

from __future__ import annotations

from dataclasses import field
from typing import Any

Vector3 = tuple[float, float, float]
Range = tuple[float, float]


def setting(
    default: Any,
    about: str,
    *,
    above: float | None = None,
    low: float | None = None,
    high: float | None = None,
    ordered: bool = False,
) -> Any:
    """Declare a leaf: default, help text, and bounds that hold for each of its numbers.

    `above` is exclusive, `low` and `high` are inclusive, `ordered` asks for low <= high in a range.
    """
    bounds = {"about": about, "above": above, "low": low, "high": high, "ordered": ordered}
    return field(default=default, metadata=bounds)


def drawn(default: Range, about: str, **bounds: Any) -> Any:
    """Declare a range that resets draw from, low <= high."""
    return setting(default, about, ordered=True, **bounds)
