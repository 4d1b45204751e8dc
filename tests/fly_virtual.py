"""Support: a pair in virtual time: the twin's drones without sockets, a flight without a clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from command_line import TRANSPORT

from mjxball.fly import packets, pair
from mjxball.fly.card import command_maps, gains_of
from mjxball.fly.command import CommandMap
from mjxball.fly.contract import FlightSettings
from mjxball.fly.flight import Flight
from mjxball.fly.limits import NAMES
from mjxball.fly.packets import Packet
from mjxball.fly.pilot import Pilot
from mjxball.fly.supervisor import State
from mjxball.fly.telemetry import Telemetry
from mjxball.fly.twin import tables
from mjxball.fly.twin.body import Pair
from mjxball.fly.twin.drone import TwinDrone, drone_state
from mjxball.fly.twin.firmware import FirmwareTimes
from mjxball.fly.twin.protocol import header
from mjxball.fly.twin.standin import StandIn, StandInPlant
from mjxball.policy import Policy, PolicyFile

MASS = 0.07
STEP = 0.01
BLOCK = 1


class VirtualLink:
    """In the place of `link.Link`: packets go straight to a twin's drone."""

    def __init__(self, drone: TwinDrone, clock: Callable[[], float], name: str, notes: Any):
        self.drone, self._clock = drone, clock
        self.name, self._notes = name, notes
        self.telemetry, self.lost = Telemetry(), None
        self.stuck = 0.0
        self.packets: list[tuple[float, Packet]] = []
        names = [name for name, _ in tables.LOG_VARIABLES]
        kinds = dict(packets.STATE_VARIABLES)
        entries = b"".join(
            bytes([tables.LOG_TYPES[kinds[name]][0]]) + names.index(name).to_bytes(2, "little") for name in kinds
        )
        drone.peer.receive(bytes([header(5, 1), 6, BLOCK]) + entries[:27], 0.0)
        drone.peer.receive(bytes([header(5, 1), 7, BLOCK]) + entries[27:], 0.0)
        drone.peer.receive(bytes([header(5, 1), 3, BLOCK, 1]), 0.0)

    def send(self, packet: Packet) -> None:
        now = self._clock()
        self.packets.append((now, packet))
        self.drone.receive(bytes([header(packet.port, packet.channel)]) + packet.data, now)

    command = send

    def stuck_for(self, now: float) -> float:
        return self.stuck

    def take(self, datagram: bytes, now: float) -> None:
        if datagram[:1] == bytes([header(5, 2)]) and len(datagram) == 5 + packets.STATE_SIZE:
            self._notes.note("state", t=now, drone=self.name, raw=datagram[1:].hex())
            self.telemetry.take(packets.unpack_state(datagram[5:]), int.from_bytes(datagram[2:5], "little"), now)


class Notes:
    """In the place of the flight log."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        self.records.append({"kind": kind, "t": t, **fields})

    def transitions(self) -> list[str]:
        return [record["after"] for record in self.records if record["kind"] == "transition"]


class World:
    """A pair, its two drones, and a flight of them."""

    def __init__(
        self,
        settings: FlightSettings | None = None,
        times: FirmwareTimes | None = None,
        contents: PolicyFile | None = None,
        physics: Pair | None = None,
        notes: Any = None,
    ):
        policy = Policy(contents, "given") if contents else Policy.load(TRANSPORT)
        self.rig = pair.Rig.of_card(policy.card)
        plant = StandInPlant(mass=MASS, mounts=(self.rig.leader_mount, self.rig.follower_mount))
        self.pair: Pair = physics or StandIn(plant)
        self.state = self.pair.start()
        self.now = 0.0
        self.drones = [TwinDrone(times or FirmwareTimes(), seed, self._writer(seed - 1)) for seed in (1, 2)]
        self.notes: Any = notes or Notes()
        named = zip(NAMES, self.drones, strict=True)
        self.links = [VirtualLink(drone, lambda: self.now, name, self.notes) for name, drone in named]
        pilot = Pilot(policy)
        for number, gains in enumerate(gains_of(pilot.config)):
            for name, value in gains.items():
                self.pair.set_parameter(number, name, value)
        maps = command_maps(pilot.config) if contents else (CommandMap(carried_mass=MASS / 2),) * 2
        settings = settings or FlightSettings(seconds=2.0)
        self.flight = Flight(self.links, pilot, maps, self.rig, settings, self.notes)
        self.advance(0.05)
        self.flight.ready = True
        self.flight.begin(self.now)

    def _writer(self, number: int) -> Callable[[str, float], None]:
        return lambda name, value: self.pair.set_parameter(number, name, value)

    def advance(self, seconds: float) -> None:
        """Let the twin live on for `seconds`."""
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            rows = []
            for number, drone in enumerate(self.drones):
                force = float(self.state.specific_force[number, 2])
                rows.append(drone.step(drone_state(self.state, number), force, self.now))
            self.state = self.pair.advance(np.array(rows, float), STEP)
            for drone, link in zip(self.drones, self.links, strict=True):
                for datagram in drone.send(self.now):
                    link.take(datagram, self.now)

    def tick(self) -> bool:
        """One period of twin and flight."""
        self.advance(self.flight.settings.period)
        return self.flight.tick(self.now)

    def fly_until(self, wanted: State, limit: float = 30.0) -> None:
        """Tick until the supervisor is in `wanted`; fails after `limit` seconds."""
        end = self.now + limit
        while self.flight.supervisor.state is not wanted:
            assert self.now < end, f"still in {self.flight.supervisor} after {limit} s"
            assert self.tick() or self.flight.supervisor.state is wanted

    def fly_for(self, seconds: float) -> None:
        """Tick for `seconds`, or until the flight is done."""
        end = self.now + seconds
        while self.now < end and self.tick():
            pass

    def running(self) -> list[bool]:
        """Whose motors turn."""
        return [drone.setpoint.thrust > 0 for drone in self.drones]

    def spoil(self, number: int, **faults: Any) -> None:
        """Switch `DroneFaults` of one drone on."""
        self.drones[number].faults = dataclasses.replace(self.drones[number].faults, **faults)

    def disturb(self, number: int, **faults: Any) -> None:
        """Switch `LinkFaults` of one drone on."""
        self.drones[number].link = dataclasses.replace(self.drones[number].link, **faults)


def thrusts(world: World, number: int) -> list[tuple[float, int]]:
    """(time, thrust) of every setpoint that a drone was sent."""
    sent = world.links[number].packets
    return [(time, packets.unpack_setpoint(packet.data).thrust) for time, packet in sent if packet.port == 3]
