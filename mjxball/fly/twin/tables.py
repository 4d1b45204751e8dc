"""What a Crazyflie lists: log variables and parameters, with the types of the wire (ours, a subset that is flown)."""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

from mjxball.control.firmware_gains import STOCK, gains_of

# Type numbers of the two tables, each with its struct code (crazyflie.md).
LOG_TYPES = {"uint8_t": (1, "B"), "uint16_t": (2, "H"), "uint32_t": (3, "I"), "int8_t": (4, "b"), "int16_t": (5, "h")}
LOG_TYPES |= {"int32_t": (6, "i"), "float": (7, "f"), "FP16": (8, "e")}
LOG_CODES = dict(LOG_TYPES.values())
PARAM_TYPES = {"uint8_t": (8, "B"), "uint16_t": (9, "H"), "uint32_t": (10, "I"), "int8_t": (0, "b")}
PARAM_TYPES |= {"int16_t": (1, "h"), "int32_t": (2, "i"), "float": (6, "f")}
READ_ONLY, EXTENDED = 0x40, 0x10


class Parameter(NamedTuple):
    """One parameter of the firmware."""

    name: str  # "group.name"
    kind: str  # a key of PARAM_TYPES
    default: float
    read_only: bool = False
    persistent: bool = False

    @property
    def type_byte(self) -> int:
        """The byte that describes it in the table of contents."""
        return PARAM_TYPES[self.kind][0] | READ_ONLY * self.read_only | EXTENDED * self.persistent

    def pack(self, value: float) -> bytes:
        """`value` as bytes of its type."""
        return struct.pack("<" + PARAM_TYPES[self.kind][1], value if self.kind == "float" else int(value))

    def unpack(self, data: bytes) -> float:
        """Value in `data`; raises struct.error for a wrong length."""
        return float(struct.unpack("<" + PARAM_TYPES[self.kind][1], data)[0])


def _gains() -> list[Parameter]:
    return [Parameter(name, "float", value, persistent=True) for name, value in gains_of(STOCK).items()]


PARAMETERS = (
    Parameter("commander.enHighLevel", "uint8_t", 0),
    Parameter("firmware.modified", "uint8_t", 0, read_only=True),
    Parameter("firmware.revision0", "uint32_t", 0x20260800, read_only=True),
    Parameter("firmware.revision1", "uint16_t", 0, read_only=True),
    Parameter("kalman.resetEstimation", "uint8_t", 0),
    Parameter("stabilizer.estimator", "uint8_t", 2),
    Parameter("stabilizer.controller", "uint8_t", 1),
    *_gains(),
)

_STATE = [f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz")]
_RATES = [f"stateEstimateZ.{name}" for name in ("rateRoll", "ratePitch", "rateYaw")]
_PLAIN = ["acc.z", "gyro.x", "gyro.y", "gyro.z", "kalman.varPX", "kalman.varPY", "kalman.varPZ", "pm.vbat"]
_PLAIN += [f"stateEstimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
LOG_VARIABLES: tuple[tuple[str, str], ...] = (
    *((name, "float") for name in _PLAIN),
    ("pm.vbatMV", "uint16_t"),
    ("stabilizer.thrust", "float"),
    *((name, "int16_t") for name in _STATE),
    ("stateEstimateZ.quat", "uint32_t"),
    *((name, "int16_t") for name in _RATES),
    ("supervisor.info", "uint16_t"),
)


def checksum(entries: list[bytes]) -> int:
    """A number that changes with the table."""
    return zlib.crc32(b"".join(entries))


def item(type_byte: int, name: str) -> bytes:
    """Type, group, name of one entry as the table of contents sends them."""
    group, _, variable = name.partition(".")
    return bytes([type_byte]) + group.encode() + b"\0" + variable.encode() + b"\0"


PARAM_ITEMS = [item(parameter.type_byte, parameter.name) for parameter in PARAMETERS]
LOG_ITEMS = [item(LOG_TYPES[kind][0], name) for name, kind in LOG_VARIABLES]
