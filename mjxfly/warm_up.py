"""A flight through every state that sends nothing, before the real one, so that no code runs first in the air.

First calls load parts of NumPy, read code from a disk that may be busy and prepare a policy's matrices. They stalled
the control loop for 30 ms on an idle machine and for seconds on a busy one.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence

from mjxfly.controller import FlightController
from mjxfly.flight import Flight
from mjxfly.limits import FlightSettings
from mjxfly.packets import Packet
from mjxfly.setpoints import CurveName, Variants
from mjxfly.supervisor import Event, Fault, FlightState, Supervisor
from mjxfly.telemetry import DroneLink, Rig, Telemetry

TICKS = 6  # in each state: longer than a command lasts
STEP = 1e-4  # [s] between two ticks, so short that the received states stay fresh


class SilentLink:
    """A link with the telemetry of a real one that sends nothing."""

    lost: str | None = None
    busy: bool | str = False

    def __init__(self, telemetry: Telemetry):
        self.telemetry = telemetry

    def send(self, packet: Packet) -> None:
        """Drop `packet`."""

    command = send

    def write_later(self, values: Mapping[str, float]) -> None:
        """Write nothing."""

    def stuck_for(self, now: float) -> float:
        """0: nothing waits."""
        return 0.0


def warm_up(
    kind: type[Flight],
    links: Sequence[DroneLink],
    controller: FlightController,
    variants: Sequence[Variants],
    assumed: Sequence[CurveName],
    rig: Rig,
    settings: FlightSettings,
    now: float,
) -> None:
    """Run a flight of class `kind` through all states on the telemetry of `links` at `now` [s], without sending.

    Resets `controller` and exempts all live objects from later garbage collections.
    """
    deaf = [SilentLink(link.telemetry) for link in links]
    flight = kind(deaf, controller, variants, assumed, rig, settings, lambda *_, **__: None)
    flight.begin(now)
    for state in FlightState:
        cause = Fault(Event.STALE, "of a rehearsal on the ground")
        for number in range(TICKS):
            now += STEP
            flight.supervisor = Supervisor(state, now - number * settings.period, cause)
            flight.tick(now)
    flight.how_it_ended()
    controller.reset()
    gc.collect()
    gc.freeze()
