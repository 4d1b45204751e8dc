"""Interface of laptop and apps: phases, causes, packets of the app channel, parameters and log variables."""

from __future__ import annotations

import enum
import struct
import zlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from mjxfly.packets import Packet

PORT, CHANNEL = 13, 2  # the firmware's channel for apps
BEAT_SIZE, REPLY_SIZE = 24, 8
CHUNK = 24  # bytes of weights in a packet
GROUP = "mjxb"
CONTROLLER, PID, OUT_OF_TREE = "stabilizer.controller", 1, 6  # only an out-of-tree controller is given the state
# Name without the group, type, whether read-only; in the order of glue.c.
PARAMETERS = (
    *((f"{what}{axis}", "float", False) for what in ("goal", "mount") for axis in "XYZ"),
    ("curve", "uint8_t", False),
    ("battery", "float", False),
    ("ident", "uint32_t", True),
    ("role", "uint8_t", True),
    ("period", "uint8_t", True),
)
LOGGED = (
    *((name, "uint8_t") for name in ("phase", "cause", "refusal", "copying")),
    ("late", "float"),
    *((name, "uint32_t") for name in ("used", "laptopAge", "peerAge")),
    *((name, "float") for name in ("roll", "pitch", "az", "thrust")),
)


class AppPhase(enum.IntEnum):
    """`mjxball_phase`: the state of an app, or the state that the laptop requests."""

    IDLE = 0
    SPIN = 1
    RAMP = 2
    FLY = 3
    LAND = 4
    DESCEND = 5
    STOP = 6


CANNOT_FLY = "the firmware cannot fly"
# A sentence for every `mjxball_cause`, in the same order.
CAUSES = (
    "good",
    "asked for by the laptop",
    "the other drone does",
    "the laptop is not heard",
    "the other drone is not heard",
    "the other drone flies another policy",
    "the mount is not set, or no length below 1 m",
    "the goal is beyond the fence or not finite",
    "the policy does not fly with this force curve",
    "the state is old or not finite",
    "the command is not finite",
    "the estimator's position cannot be trusted",
    "beyond the fence",
    "tilted beyond the limit",
    CANNOT_FLY,
    "thrust at its bound for too long",
    "the controller is late",
    "the phase lasted too long",
    "on the ground",
    "weights refused: wrong rate, plant, layers, size or CRC",
    "refused: weights, mount and curve change on the ground only",
    "the battery is low",
    "the limit of the battery is not between 0 and 10 V",
)


def reason(cause: int) -> str:
    """Return the sentence of a `mjxball_cause`."""
    return CAUSES[cause] if 0 <= cause < len(CAUSES) else "unknown"


class AppSample(NamedTuple):
    """A log packet of an app."""

    phase: AppPhase
    cause: int
    refusal: int
    copying: bool
    arrival: float  # [s] of the laptop's monotonic clock


APP_VARIABLES = tuple((f"{GROUP}.{name}", "uint8_t") for name in ("phase", "cause", "refusal", "copying"))


def sample_of(values: Mapping[str, float], arrival: float) -> AppSample | None:
    """Return the sample for the log variables `values` by name; None for an unknown phase."""
    phase, cause, refusal, copying = (int(values[name]) for name, _ in APP_VARIABLES)
    return AppSample(AppPhase(phase), cause, refusal, bool(copying), arrival) if phase <= max(AppPhase) else None


def order(phase: AppPhase) -> Packet:
    """Return the laptop's heartbeat, which requests `phase`."""
    return Packet(PORT, CHANNEL, bytes([1, phase]))


def upload(weights: bytes, key: int) -> Iterator[Packet]:
    """Yield the packets that upload `weights` to a follower with the compatibility `key`; each is answered."""
    yield Packet(PORT, CHANNEL, struct.pack("<BIII", 2, key, len(weights), zlib.crc32(weights)))
    for at in range(0, len(weights), CHUNK):
        yield Packet(PORT, CHANNEL, struct.pack("<BI", 3, at) + weights[at : at + CHUNK])
    yield Packet(PORT, CHANNEL, bytes([4]))


class Reply(NamedTuple):
    """The answer to a packet of an upload."""

    kind: int
    status: int  # a cause; 0: good
    received: int  # bytes so far


def reply_of(data: bytes) -> Reply | None:
    """Decode the payload of a packet of the app channel; None if it is not a reply."""
    return Reply(*struct.unpack("<BBxxI", data)) if len(data) == REPLY_SIZE else None
