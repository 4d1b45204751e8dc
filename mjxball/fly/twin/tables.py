"""What a Crazyflie lists: all log variables and parameters of firmware 2026.08, with the types of the wire.

The names are in `names.csv`, in the order of the firmware's own tables. Defaults that matter are here; others are 0.
"""

from __future__ import annotations

import csv
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

from mjxball.control.firmware_gains import STOCK, gains_of
from mjxball.fly.twin.kind import DroneKind

# Type numbers of the two tables, each with its struct code (crazyflie.md).
LOG_TYPES = {"uint8_t": (1, "B"), "uint16_t": (2, "H"), "uint32_t": (3, "I"), "int8_t": (4, "b"), "int16_t": (5, "h")}
LOG_TYPES |= {"int32_t": (6, "i"), "float": (7, "f"), "FP16": (8, "e")}
LOG_CODES = dict(LOG_TYPES.values())
PARAM_TYPES = {"uint8_t": (8, "B"), "uint16_t": (9, "H"), "uint32_t": (10, "I"), "int8_t": (0, "b")}
PARAM_TYPES |= {"int16_t": (1, "h"), "int32_t": (2, "i"), "float": (6, "f")}
READ_ONLY, EXTENDED = 0x40, 0x10
DEFAULTS = {
    **gains_of(STOCK),
    "firmware.revision0": float(0x20260800),
    "kalman.attitudeRev": 0.001,
    "kalman.mNBaro": 2.0,
    "kalman.mNGyro_rollpitch": 0.1,
    "kalman.mNGyro_yaw": 0.1,
    "kalman.maxPos": 100.0,
    "kalman.maxVel": 10.0,
    "kalman.pNAcc_xy": 0.5,
    "kalman.pNAcc_z": 1.0,
    "locSrv.extPosStdDev": 0.01,
    "locSrv.extQuatStdDev": 4.5e-3,
    "pm.criticalLowVoltage": 3.0,
    "pm.lowVoltage": 3.2,
    "stabilizer.controller": 1.0,
    "stabilizer.estimator": 2.0,
    "supervisor.landedTimeout": 3000.0,
    "supervisor.prefltTimeout": 30000.0,
    "supervisor.spinupTimeout": 2000.0,
    "supervisor.tmblChckEn": 1.0,
    "system.selftestPassed": 1.0,
    "flightmode.stabModeRoll": 1.0,
    "flightmode.stabModePitch": 1.0,
    "flightmode.yawMode": 2.0,
}


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


def _listed(table: str) -> list[dict[str, str]]:
    with Path(__file__).with_name("names.csv").open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["table"] == table]


PARAMETERS = tuple(
    Parameter(row["name"], row["type"], DEFAULTS.get(row["name"], 0.0), row["access"] == "r", row["access"] == "p")
    for row in _listed("param")
)
LOG_VARIABLES: tuple[tuple[str, str], ...] = tuple((row["name"], row["type"]) for row in _listed("log"))


def defaults_of(kind: DroneKind, estimator: int) -> dict[str, float]:
    """Values that the parameters of a drone of a `kind` have after boot; `estimator` is what its decks ask for."""
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    values["stabilizer.estimator"] = float(estimator)
    values["powerDist.idleThrust"] = float(kind.idle)
    if kind.motor == "brushless":
        values["pm.lowVoltage"] = 3.35
    for axis in ("roll", "pitch"):
        values[f"pid_rate.{axis}_kp"] = kind.rate_gain
        values[f"pid_rate.{axis}_ki"] = 2 * kind.rate_gain
    return values


def checksum(entries: list[bytes]) -> int:
    """A number that changes with the table."""
    return zlib.crc32(b"".join(entries))


def item(type_byte: int, name: str) -> bytes:
    """Type, group, name of one entry as the table of contents sends them."""
    group, _, variable = name.partition(".")
    return bytes([type_byte]) + group.encode() + b"\0" + variable.encode() + b"\0"


PARAM_ITEMS = [item(parameter.type_byte, parameter.name) for parameter in PARAMETERS]
LOG_ITEMS = [item(LOG_TYPES[kind][0], name) for name, kind in LOG_VARIABLES]
