"""Support: a pair in virtual time, on the stand-in unless a test brings its physics."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from command_line import TRANSPORT
from fly_policies import untrained

import virtual_twin as virtual
from mjxball import config as configs
from mjxball.control.crazyflie import gains_to_json
from mjxball.policy import Policy, PolicyFile
from mjxfly import packets, policy_setup
from mjxfly.flight_log import Journal
from mjxfly.limits import FlightSettings
from mjxfly.setpoints import CommandMap
from mjxfly.telemetry import Rig
from mjxfly.twin.conditions import DELIVERED, DroneKind
from mjxfly.twin.pair import Pair
from mjxfly.twin.physics import SimplePair, SimplePlant
from virtual_twin import MemoryLog, VirtualLink

__all__ = ["ARMED_BY_HAND", "MASS", "MemoryLog", "VirtualLink", "VirtualTwin", "log_header", "short_log", "thrusts"]
MASS = 0.07
ARMED_BY_HAND = dataclasses.replace(DELIVERED, auto_arm=False)


class VirtualTwin(virtual.VirtualTwin):
    """A pair, its two drones, and a flight of them."""

    def __init__(
        self,
        settings: FlightSettings | None = None,
        kind: DroneKind = DELIVERED,
        contents: PolicyFile | None = None,
        physics: Pair | None = None,
        log: Any = None,
    ):
        policy = Policy(contents, "given") if contents else Policy.load(TRANSPORT)
        rig = Rig.from_metadata(policy.metadata)
        plant = SimplePlant(mass=MASS, mounts=(rig.leader_mount, rig.follower_mount))
        maps = None if contents else (CommandMap(carried_mass=MASS / 2),) * 2
        settings = settings or FlightSettings(seconds=2.0)
        super().__init__(policy, settings, physics=physics or SimplePair(plant, kind), maps=maps, log=log)


def log_header(contents: PolicyFile, name: str = "nobody") -> dict[str, Any]:
    """What the runner writes first into the log of a flight of the policy: both firmwares are taken for linear ones."""
    config = policy_setup.config_of(contents.metadata)
    gains = gains_to_json(policy_setup.gains_of(policy_setup.with_curve(config, "linear")))
    return {"policy": name, "config": configs.to_dict(config), "curve": "linear", "gains": gains}


def short_log(path: Path, *notes: tuple[str, dict[str, Any]]) -> Path:
    """The log of a short flight, as the runner writes it, with further `notes` at its end: (kind, fields)."""
    contents = untrained("flight")
    with Journal(path, **log_header(contents)) as log:
        VirtualTwin(FlightSettings(seconds=1.0), contents=contents, log=log).run()
        for kind, fields in notes:
            log.note(kind, **fields)
    return path


def thrusts(world: virtual.VirtualTwin, number: int) -> list[tuple[float, int]]:
    """(time, thrust) of every setpoint that a drone was sent."""
    sent = world.links[number].packets
    return [(time, packets.unpack_setpoint(packet.data).thrust) for time, packet in sent if packet.port == 3]
