"""What a flight needs from the outside (link, watchdog, log), what it is told to do, and what it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjxball.fly.limits import Limits
from mjxball.fly.maneuver import Glimpse, Times
from mjxball.fly.packets import DroneState, Packet, Setpoint
from mjxball.fly.supervisor import Supervisor
from mjxball.fly.telemetry import Telemetry

LIMITS, TIMES = Limits(), Times()


class DroneLink(Protocol):
    """What a flight needs of `link.Link`."""

    telemetry: Telemetry
    lost: str | None

    def send(self, packet: Packet) -> None:
        """Newest setpoint, without blocking."""

    def command(self, packet: Packet) -> None:
        """Before any setpoint, without blocking."""

    def stuck_for(self, now: float) -> float:
        """How long something has waited to be sent [s]."""
        ...


class Guard(Protocol):
    """What a flight needs of the watchdog process."""

    def beat(self, flying: bool, seen: Glimpse) -> bool:
        """Tell it that we live; false if it does not."""
        ...


class Notes(Protocol):
    """What a flight needs of `journal.Journal`."""

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        """Add a record, without blocking."""


@dataclass(frozen=True)
class FlightSettings:
    """What is flown and within which bounds."""

    seconds: float = 20.0  # in State.FLY
    goal: tuple[float, float, float] = (0.0, 0.0, 0.4)  # of O, from where it stands at the start [m]
    dry_run: bool = False  # zeros are sent, whatever is wanted
    period: float = 0.01  # of the loop [s]
    limits: Limits = LIMITS
    times: Times = TIMES


class View(NamedTuple):
    """What a display may show; replaced as a whole at every tick."""

    time: float  # [s] since the start
    supervisor: Supervisor
    states: list[DroneState]
    ages: list[float]
    goal: np.ndarray
    wanted: tuple[Setpoint, Setpoint]
    late: float  # [s]
    missed: int
