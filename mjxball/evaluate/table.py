"""Plain-text tables of evaluation cells."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mjxball.evaluate.cells import Cell

COLUMNS = (
    ("rmse", "rmse m", 1.0, 3),
    ("settling_time", "settle s", 1.0, 2),
    ("overshoot", "over %", 100.0, 1),
    ("x_peak", "x-peak m", 1.0, 4),
    ("y_peak", "y-peak m", 1.0, 4),
    ("z_peak", "z-peak m", 1.0, 4),
    ("max_tilt", "tilt deg", 180 / math.pi, 1),
    ("action_error", "act.err", 1.0, 3),
)


def table(cells: Sequence[Cell]) -> str:
    """One line per cell; a dash where a metric does not exist."""
    head = ["omega", "ampl.", "mass", "believed", "follower", *(title for _, title, _, _ in COLUMNS), ""]
    rows = [head]
    for cell in cells:
        record = cell.record()
        numbers = (record[key] for key in ("omega", "amplitude", "mass", "believed_mass"))
        row = [*("-" if number is None else f"{number:g}" for number in numbers), cell.follower]
        for name, _, factor, digits in COLUMNS:
            value = record[name]
            row.append("-" if value is None else f"{value * factor:.{digits}f}")
        rows.append([*row, "FAILED" if cell.metrics.failed else ""])
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    return "\n".join("  ".join(text.rjust(w) for text, w in zip(row, widths, strict=True)).rstrip() for row in rows)
