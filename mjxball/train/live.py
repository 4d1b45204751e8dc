"""How a training in a notebook is going: a line and a curve that are redrawn."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from mjxball import pictures

Report = Callable[[Mapping[str, float]], None]  # steps, total, and episode_return (exploring) or eval_return


def in_notebook() -> bool:
    """Whether what this process displays is seen in a notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return hasattr(shell, "kernel")


class LiveCurve:
    """A `Report` that a notebook shows."""

    def __init__(self, title: str):
        from IPython.display import HTML, display

        self._title, self._html, self._start = title, HTML, time.monotonic()
        self._points: dict[str, list[tuple[float, float]]] = {"episode_return": [], "eval_return": []}
        self._shown: Any = display(HTML(pictures.card(title, {"compiling": "..."})), display_id=True)

    def __call__(self, said: Mapping[str, float]) -> None:
        """Redraw with what was `said`."""
        for name, points in self._points.items():
            if name in said:
                points.append((said["steps"], said[name]))
        lines = [
            pictures.Curve(called, [x for x, _ in self._points[name]], [y for _, y in self._points[name]], dots)
            for name, called, dots in (("episode_return", "exploring", False), ("eval_return", "evaluated", True))
        ]
        share, seconds = said["steps"] / said["total"], time.monotonic() - self._start
        facts = {f"{share:.0%}": f"{said['steps']:,.0f} of {said['total']:,.0f} steps, {seconds:.0f} s"}
        drawn = pictures.curves(lines, "environment steps", "return of an episode")
        self._shown.update(self._html(pictures.card(self._title, facts, drawn)))
