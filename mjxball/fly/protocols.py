"""What a flight needs from the outside (link, watchdog, log), what it is told to do, and what it shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjxball.control.firmware_gains import Gains
from mjxball.control.motors import MOTORS, Motor
from mjxball.fly.command import CommandMap
from mjxball.fly.limits import Limits
from mjxball.fly.maneuver import LastKnownState, Times
from mjxball.fly.packets import DroneState, Packet, Setpoint
from mjxball.fly.supervisor import Fault, Supervisor
from mjxball.fly.telemetry import Telemetry
from mjxball.fly.thrust import CurveName

LIMITS, TIMES, MOTOR = Limits(), Times(), MOTORS["2.1"]


class DroneLink(Protocol):
    """What a flight needs of `link.Link`."""

    telemetry: Telemetry
    lost: str | None
    busy: bool | str  # with `write_later`: True while writing, else why it failed

    def send(self, packet: Packet) -> None:
        """Newest setpoint, without blocking."""

    def command(self, packet: Packet) -> None:
        """Before any setpoint, without blocking."""

    def write_later(self, values: Mapping[str, float]) -> None:
        """Write firmware parameters, without blocking; see `busy`."""

    def stuck_for(self, now: float) -> float:
        """How long something has waited to be sent [s]."""
        ...


class Guard(Protocol):
    """What a flight needs of the watchdog process."""

    def beat(self, flying: bool, seen: LastKnownState) -> bool:
        """Tell it that we live; false if it does not."""
        ...


class Poses(Protocol):
    """What a flight needs of `mocap.Mocap`."""

    def faults(self, now: float) -> list[Fault]:
        """What is wrong with the poses that the drones are sent; never blocks."""
        ...


class Notes(Protocol):
    """What a flight needs of `flight_log.Journal`."""

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        """Add a record, without blocking."""


class Variant(NamedTuple):
    """How one drone is flown if its firmware has a certain force curve."""

    map: CommandMap
    gains: Gains


Variants = Mapping[CurveName, Variant]  # of one drone, by the curve of its firmware


@dataclass(frozen=True)
class FlightSettings:
    """What is flown and within which bounds."""

    seconds: float = 20.0  # in State.FLY
    goal: tuple[float, float, float] = (0.0, 0.0, 0.4)  # of O, from where it stands at the start [m]
    dry_run: bool = False  # zeros are sent, whatever is wanted
    period: float = 0.01  # of the loop [s]
    motor: Motor = MOTOR  # of both drones, by which the firmware's curve is recognised
    stand: bool = False  # sideways and pitch are locked
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
