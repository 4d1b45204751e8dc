"""A flight in a notebook, in the viewer of `python -m mjxball.view`."""

from __future__ import annotations

import html

from mjxball.config import Plant
from mjxball.sim.trajectory import Trajectory
from mjxball.view.flight import flight_of
from mjxball.view.page import flight_page


class View:
    """What a notebook shows as the viewer, inside its page: nothing is written, and no server runs."""

    def __init__(self, flight: Trajectory, plant: Plant, title: str = "flight", height: int = 560):
        """One flight, without a batch axis, of `plant`; `height` in pixels."""
        self._page, self._title, self._height = flight_page(flight_of(flight, plant, title)), title, height

    def __repr__(self) -> str:
        return f"<View of {self._title}>"

    def _repr_html_(self) -> str:
        look = f'style="width: 100%; height: {self._height}px; border: 0" sandbox="allow-scripts"'
        return f'<iframe srcdoc="{html.escape(self._page)}" title="{html.escape(self._title)}" {look}></iframe>'
