"""What stands in a real link's and a flight log's place in virtual time."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any

from mjxball.fly import packets
from mjxball.fly.packets import Packet
from mjxball.fly.telemetry import HealthSample, Telemetry
from mjxball.fly.twin import tables
from mjxball.fly.twin.drone import TwinDrone
from mjxball.fly.twin.protocol import header

BLOCK, HEALTH_BLOCK = 1, 2  # log blocks of the state and of health
HEALTH = (*packets.VARIANCES, *packets.MOTORS[0], packets.ACTING_THRUST)
_HEALTH = struct.Struct("<3f4Hf")


class VirtualLink:
    """In the place of `link.Link`: packets go straight to a drone of the twin."""

    def __init__(self, drone: TwinDrone, clock: Callable[[], float], name: str, notes: Any):
        self.drone, self._clock = drone, clock
        self.name, self._notes = name, notes
        self.telemetry: Telemetry = Telemetry()
        self.lost: str | None = None
        self.stuck = 0.0
        self.busy: bool | str = False
        self.packets: list[tuple[float, Packet]] = []
        self.keep_packets = True

    def send(self, packet: Packet) -> None:
        """Send `packet`, with the link's delay."""
        now = self._clock()
        if self.keep_packets:
            self.packets.append((now, packet))
        self.drone.receive(bytes([header(packet.port, packet.channel)]) + packet.data, now)

    command = send

    def stuck_for(self, now: float) -> float:
        """How long nothing could be sent [s]: as long as a test says."""
        return self.stuck

    def ask(self, port: int, channel: int, data: bytes) -> list[bytes]:
        """Answers to a request, without any delay or loss."""
        return self.drone.peer.receive(bytes([header(port, channel)]) + data, self._clock())

    def write_parameters(self, values: Mapping[str, float]) -> None:
        """Write parameters by name."""
        names = [parameter.name for parameter in tables.PARAMETERS]
        for name, value in values.items():
            number = names.index(name)
            self.ask(2, 2, number.to_bytes(2, "little") + tables.PARAMETERS[number].pack(value))

    write_later = write_parameters

    def start_states(self) -> None:
        """Have the state logged at 100 Hz and health at 20 Hz."""
        names = [name for name, _ in tables.LOG_VARIABLES]
        for block, variables, period in ((BLOCK, packets.STATE_VARIABLES, 1), (HEALTH_BLOCK, HEALTH, 5)):
            entries = [
                bytes([tables.LOG_TYPES[kind][0]]) + names.index(name).to_bytes(2, "little") for name, kind in variables
            ]
            self.ask(5, 1, bytes([2, block]))
            self.ask(5, 1, bytes([6, block]) + b"".join(entries[:9]))
            self.ask(5, 1, bytes([7, block]) + b"".join(entries[9:]))
            self.ask(5, 1, bytes([3, block, period]))

    def take(self, datagram: bytes, now: float) -> None:
        """A datagram came from the drone."""
        logged = datagram[:1] == bytes([header(5, 2)])
        if logged and len(datagram) == 5 + _HEALTH.size and datagram[1] == HEALTH_BLOCK:
            values = zip((name for name, _ in HEALTH), _HEALTH.unpack(datagram[5:]), strict=True)
            self.telemetry.health = HealthSample(packets.health_of(dict(values)), now)
        elif logged and len(datagram) == 5 + packets.STATE_SIZE:
            try:
                state = packets.unpack_state(datagram[5:])
            except packets.PacketError:
                self.telemetry.damaged += 1
                return
            self._notes.note("state", t=now, drone=self.name, raw=datagram[1:].hex())
            self.telemetry.take(state, int.from_bytes(datagram[2:5], "little"), now)


class Notes:
    """In the place of the flight log; `keep` says whether ticks and states are kept as well."""

    def __init__(self, keep: bool = True) -> None:
        self.records: list[dict[str, Any]] = []
        self._keep = keep

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        """Keep one record."""
        if self._keep or kind not in ("tick", "state"):
            self.records.append({"kind": kind, "t": t, **fields})

    def transitions(self) -> list[str]:
        """States of the flight's supervisor in order."""
        return [record["after"] for record in self.records if record["kind"] == "transition"]
