"""A flight through every state before the first one begins: what it would do for the first time in the air is done.

The first call of a policy makes its matrices, a part of NumPy is loaded where it is first named, code is read from a
disk that may be busy: the thread that flies stood for 30 ms where a machine was idle, and for seconds where it was not.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence

from mjxfly.card import Controller
from mjxfly.flight import Flight
from mjxfly.limits import FlightSettings
from mjxfly.packets import Packet
from mjxfly.setpoints import CurveName, Variants
from mjxfly.supervisor import Event, Fault, State, Supervisor
from mjxfly.telemetry import DroneLink, Rig, Telemetry

TICKS = 6  # in each state: longer than a command lasts
STEP = 1e-4  # [s] between two of them: what has been heard must stay fresh


class Deaf:
    """A link over which nothing is sent, with what a real one has heard."""

    lost: str | None = None
    busy: bool | str = False

    def __init__(self, telemetry: Telemetry):
        self.telemetry = telemetry

    def send(self, packet: Packet) -> None:
        """Nothing goes out."""

    command = send

    def write_later(self, values: Mapping[str, float]) -> None:
        """Nothing is written."""

    def stuck_for(self, now: float) -> float:
        """Nothing waits."""
        return 0.0


def warm_up(
    kind: type[Flight],
    links: Sequence[DroneLink],
    controller: Controller,
    variants: Sequence[Variants],
    assumed: Sequence[CurveName],
    rig: Rig,
    settings: FlightSettings,
    now: float,
) -> None:
    """Fly `kind` on what `links` have heard by `now` [s], without a word to them, and forget it.

    What lives by then is left out of later searches for garbage.
    """
    deaf = [Deaf(link.telemetry) for link in links]
    flight = kind(deaf, controller, variants, assumed, rig, settings, lambda *_, **__: None)
    flight.begin(now)
    for state in State:
        cause = Fault(Event.STALE, "of a rehearsal on the ground")
        for number in range(TICKS):
            now += STEP
            flight.supervisor = Supervisor(state, now - number * settings.period, cause)
            flight.tick(now)
    flight.how_it_ended()
    controller.reset()
    gc.collect()
    gc.freeze()
