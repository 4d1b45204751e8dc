"""The viewer of `python -m mjxball.view` in a notebook."""

from __future__ import annotations

import html

from mjxball.config import Plant
from mjxball.sim.trajectory import Trajectory
from mjxball.view.flight import flight_of
from mjxball.view.page import flight_page


class View:
    """A flight that a notebook displays in the viewer, embedded in its page without files or a server."""

    def __init__(self, flight: Trajectory, plant: Plant, title: str = "flight", height: int = 560):
        """`flight` of `plant` without a batch axis; `height` of the viewer [pixels]."""
        self._page, self._title, self._height = flight_page(flight_of(flight, plant, title)), title, height

    def __repr__(self) -> str:
        return f"<View of {self._title}>"

    def _repr_html_(self) -> str:
        look = f'style="width: 100%; height: {self._height}px; border: 0" sandbox="allow-scripts"'
        return f'<iframe srcdoc="{html.escape(self._page)}" title="{html.escape(self._title)}" {look}></iframe>'
