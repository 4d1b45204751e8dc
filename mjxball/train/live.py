"""Progress of a training in a notebook: a line of text and a learning curve that are redrawn."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from mjxball import pictures

Report = Callable[[Mapping[str, float]], None]  # steps, total, and episode_return (exploring) or eval_return


def in_notebook() -> bool:
    """Whether this process runs in a notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return hasattr(shell, "kernel")


class LiveCurve:
    """A `Report` that draws in a notebook."""

    def __init__(self, title: str):
        from IPython.display import HTML, display

        self._title, self._html, self._start = title, HTML, time.monotonic()
        self._points: dict[str, list[tuple[float, float]]] = {"episode_return": [], "eval_return": []}
        self._shown: Any = display(HTML(pictures.summary(title, {"compiling": "..."})), display_id=True)

    def __call__(self, row: Mapping[str, float]) -> None:
        """Add the values of `row` (see `Report`) and redraw."""
        for name, points in self._points.items():
            if name in row:
                points.append((row["steps"], row[name]))
        lines = [
            pictures.Curve(label, [x for x, _ in self._points[name]], [y for _, y in self._points[name]], dots)
            for name, label, dots in (("episode_return", "exploring", False), ("eval_return", "evaluated", True))
        ]
        share, seconds = row["steps"] / row["total"], time.monotonic() - self._start
        facts = {f"{share:.0%}": f"{row['steps']:,.0f} of {row['total']:,.0f} steps, {seconds:.0f} s"}
        figure = pictures.curves(lines, "environment steps", "return of an episode")
        self._shown.update(self._html(pictures.summary(self._title, facts, figure)))
