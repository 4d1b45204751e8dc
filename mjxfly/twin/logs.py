"""Log variables of one drone, computed on demand, and its log blocks with the firmware's limits."""

from __future__ import annotations

import csv
import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjxball.control.rotations import matrix_from_quaternion
from mjxfly import packets
from mjxfly.app.protocol import GROUP, LOGGED
from mjxfly.packets import Setpoint
from mjxfly.twin.estimators import euler_of
from mjxfly.twin.pair import Report

GRAVITY = 9.81  # [m/s2]
# Type number and struct code of each type of log variables (docs/hardware.md).
LOG_TYPES = {"uint8_t": (1, "B"), "uint16_t": (2, "H"), "uint32_t": (3, "I"), "int8_t": (4, "b"), "int16_t": (5, "h")}
LOG_TYPES |= {"int32_t": (6, "i"), "float": (7, "f"), "FP16": (8, "e")}
LOG_CODES = dict(LOG_TYPES.values())


def listed(table: str) -> list[dict[str, str]]:
    """Return the rows of `names.csv` of the `table` "log" or "param", in the firmware's order, including its decks."""
    with Path(__file__).with_name("names.csv").open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["table"] == table]


def item(type_byte: int, name: str) -> bytes:
    """Return type, group and name of one entry, encoded as in the table of contents."""
    group, _, variable = name.partition(".")
    return bytes([type_byte]) + group.encode() + b"\0" + variable.encode() + b"\0"


LOG_VARIABLES: tuple[tuple[str, str], ...] = tuple((row["name"], row["type"]) for row in listed("log"))
OF_APP = tuple((f"{GROUP}.{name}", kind) for name, kind in LOGGED)
KNOWN = LOG_VARIABLES + OF_APP  # a drone without an app does not list `OF_APP`


class Snapshot(NamedTuple):
    """State of one drone at one time, the source of its log variables."""

    report: Report  # of both drones
    drone: int
    setpoint: Setpoint
    info: int
    voltage: float  # [V]
    position: np.ndarray  # (3,) estimated [m], with the offset of a fault
    app: Mapping[str, float] = {}  # log variables of the app on board, by names without the group
    deck: Mapping[str, float] = {}  # log variables of the positioning deck, by full names

    @property
    def quaternion(self) -> np.ndarray:
        """(4,) estimated (w, x, y, z)."""
        return np.asarray(self.report.quaternion[self.drone])

    @property
    def acceleration(self) -> np.ndarray:
        """(3,) measured, body axes [g]."""
        return np.asarray(self.report.acceleration[self.drone]) / GRAVITY

    @property
    def world_acceleration(self) -> np.ndarray:
        """(3,) [g], gravity included."""
        return np.asarray(matrix_from_quaternion(self.quaternion) @ self.acceleration)


def _named(names: str, values: Iterable[float]) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names.split(), values, strict=True)}


def _attitude(one: Snapshot) -> dict[str, float]:
    roll, pitch, yaw = map(math.degrees, euler_of(one.quaternion))
    return {"roll": roll, "pitch": -pitch, "yaw": yaw}


def _estimate(one: Snapshot) -> dict[str, float]:
    values = _named("x y z", one.position) | _named("vx vy vz", one.report.velocity[one.drone])
    values |= _named("ax ay az", one.world_acceleration - np.array([0.0, 0.0, 1.0]))
    return values | _named("qw qx qy qz", one.quaternion) | _attitude(one)


def _compressed(one: Snapshot) -> dict[str, float]:
    values = _named("x y z", 1000 * one.position) | _named("vx vy vz", 1000 * one.report.velocity[one.drone])
    values |= _named("ax ay az", 1000 * GRAVITY * one.world_acceleration)
    rates = 1000 * one.report.rates[one.drone] * np.array([1.0, -1.0, 1.0])
    values |= _named("rateRoll ratePitch rateYaw", rates)
    return values | {"quat": packets.compress_quaternion(one.quaternion)}


def _kalman(one: Snapshot) -> dict[str, float]:
    values = _named("varX varY varZ varPX varPY varPZ varD0 varD1 varD2", one.report.variance[one.drone])
    if one.report.estimator[one.drone] != 2:
        return values
    body = matrix_from_quaternion(one.quaternion).T @ one.report.velocity[one.drone]
    values |= _named("stateX stateY stateZ", one.position) | _named("statePX statePY statePZ", body)
    return values | _named("q0 q1 q2 q3", one.quaternion) | {"rtPred": 100.0, "rtUpdate": 1000.0}


def _motors(one: Snapshot) -> dict[str, float]:
    pwm, requested = one.report.pwm[one.drone], one.report.requested[one.drone]
    return _named("m1 m2 m3 m4", pwm) | _named("m1req m2req m3req m4req", requested)


def _power(one: Snapshot) -> dict[str, float]:
    low = float(one.voltage < 3.2)
    return {"vbat": one.voltage, "vbatMV": 1000 * one.voltage, "state": 3 * low, "batteryLevel": 10.0 * (1 - low)}


def _controller(one: Snapshot) -> dict[str, float]:
    thrust, rates = float(one.report.thrust[one.drone]), one.report.rates[one.drone] * np.array([1.0, -1.0, 1.0])
    values = {"cmd_thrust": thrust, "actuatorThrust": thrust, "roll": one.setpoint.roll, "pitch": one.setpoint.pitch}
    return values | _named("r_roll r_pitch r_yaw", rates)


GROUPS: dict[str, Callable[[Snapshot], dict[str, float]]] = {
    "stateEstimate": _estimate,
    "stateEstimateZ": _compressed,
    "kalman": _kalman,
    "motor": _motors,
    "pm": _power,
    "stabilizer": lambda one: {"thrust": float(one.report.thrust[one.drone]), "rtStab": 1000.0, **_attitude(one)},
    "controller": _controller,
    "ctrltarget": lambda one: _named("roll pitch yaw thrust", one.setpoint) | {"yaw": -one.setpoint.yaw_rate},
    "supervisor": lambda one: {"info": one.info, "accNorm": float(np.linalg.norm(one.acceleration))},
    "sys": lambda one: {
        name: float(bool(one.info & bit))
        for name, bit in (("canfly", packets.CAN_FLY), ("isFlying", packets.FLYING), ("isTumbled", packets.TUMBLED))
    },
    "acc": lambda one: _named("x y z", one.acceleration),
    "gyro": lambda one: _named("x y z", np.degrees(one.report.rates[one.drone])),
    "ext_pos": lambda one: _named("X Y Z", one.report.pose[one.drone, :3]),
    "locSrv": lambda one: _named("x y z qx qy qz qw", one.report.pose[one.drone]),
    GROUP: lambda one: dict(one.app),
    "radio": lambda one: {"isConnected": 1.0, "rssi": 40.0},
}


class Readings:
    """Log variables of one drone at one time, by full names; those that the twin does not simulate are 0."""

    def __init__(self, snapshot: Snapshot):
        self.snapshot = snapshot
        self._groups: dict[str, dict[str, float]] = {}

    def __getitem__(self, name: str) -> float:
        if name in self.snapshot.deck:
            return self.snapshot.deck[name]
        group, _, variable = name.partition(".")
        if group not in self._groups:
            make = GROUPS.get(group)
            self._groups[group] = make(self.snapshot) if make else {}
        return self._groups[group].get(variable, 0.0)


MAX_BLOCKS, MAX_VARIABLES, MAX_BLOCK_BYTES = 16, 128, 26
EXISTS, UNKNOWN, TOO_BIG, NO_MEMORY, BAD = 17, 2, 7, 12, 8
DELETE, START, STOP, RESET, CREATE, APPEND, START_MS = 2, 3, 4, 5, 6, 7, 8


@dataclass
class Block:
    """A log block."""

    variables: list[tuple[str, str]] = field(default_factory=list)  # (name, struct code as fetched)
    period: float = 0.0  # [s], 0 while stopped
    due: float = 0.0  # time of the next packet [s]
    once: bool = False  # send one packet only

    def is_due(self, now: float) -> bool:
        """True if a packet is due at `now` [s]."""
        return bool(self.period or self.once) and now >= self.due


class Blocks:
    """All log blocks of one drone."""

    def __init__(self, listed: Sequence[tuple[str, str]] = KNOWN) -> None:
        """`listed`: name and type of the drone's log variables, in the order of its table of contents."""
        self._listed = listed
        self.by_number: dict[int, Block] = {}

    def is_due(self, now: float) -> bool:
        """True if a packet of any block is due at `now` [s]."""
        return any(block.is_due(now) for block in self.by_number.values())

    def take(self, readings: Readings | Mapping[str, float], now: float) -> list[bytes]:
        """Return the payloads of all blocks that are due at `now` [s]; their time stamp is `now` in ms."""
        sent = []
        for number, block in self.by_number.items():
            if block.is_due(now):
                block.due = now + block.period if now - block.due > block.period else block.due + block.period
                block.once = False
                stamp = struct.pack("<I", int(now * 1000 + 1e-6) & 0xFFFFFF)[:3]
                values = b"".join(pack(code, readings[name]) for name, code in block.variables)
                sent.append(bytes([number]) + stamp + values)
        return sent

    def control(self, data: bytes, now: float) -> list[bytes]:
        """Return the answers to a request on the control channel."""
        if data[:1] == bytes([RESET]):
            self.by_number.clear()
            return [b"\x05\0\0"]
        if len(data) < 2:
            return []
        return [data[:2] + bytes([self._execute(data[0], data[1], data[2:], now)])]

    def _execute(self, command: int, number: int, rest: bytes, now: float) -> int:
        block = self.by_number.get(number)
        if command == CREATE:
            if block is not None:
                return EXISTS
            if len(self.by_number) >= MAX_BLOCKS:
                return NO_MEMORY
            self.by_number[number] = Block()  # kept, even if its variables are refused
            return self._append(self.by_number[number], rest)
        if command not in (APPEND, START, START_MS, STOP, DELETE):
            return BAD
        if block is None:
            return UNKNOWN
        if command == APPEND:
            return self._append(block, rest)
        if command in (START, START_MS):
            return _start(block, command, rest, now)
        if command == STOP:
            block.period, block.once = 0.0, False
        else:
            del self.by_number[number]
        return 0

    def _append(self, block: Block, entries: bytes) -> int:
        """Add (type, id) entries of 3 bytes; return an error code or 0. A stray byte, which cflib sends, is ignored."""
        for at in range(0, len(entries) - 2, 3):
            kind, index = entries[at] & 0x0F, struct.unpack("<H", entries[at + 1 : at + 3])[0]
            if kind not in LOG_CODES:
                return UNKNOWN
            code = LOG_CODES[kind]
            if struct.calcsize("<" + "".join([*(known for _, known in block.variables), code])) > MAX_BLOCK_BYTES:
                return TOO_BIG
            if sum(len(one.variables) for one in self.by_number.values()) >= MAX_VARIABLES:
                return NO_MEMORY
            if index >= len(self._listed):
                return UNKNOWN
            block.variables.append((self._listed[index][0], code))
        return 0


def _start(block: Block, command: int, rest: bytes, now: float) -> int:
    size = 2 if command == START_MS else 1
    if len(rest) < size:
        return BAD
    period = int.from_bytes(rest[:size], "little") * (1e-3 if command == START_MS else 1e-2)
    block.period, block.once, block.due = period, not period, now + period
    return 0


_RANGES = {"B": (0, 2**8 - 1), "H": (0, 2**16 - 1), "I": (0, 2**32 - 1)}
_RANGES |= {"b": (-(2**7), 2**7 - 1), "h": (-(2**15), 2**15 - 1), "i": (-(2**31), 2**31 - 1)}


def pack(code: str, value: float) -> bytes:
    """Encode `value`, clipped to the range of the struct `code`."""
    if code in _RANGES:
        low, high = _RANGES[code]
        return struct.pack("<" + code, min(max(int(value), low), high))
    return struct.pack("<" + code, min(max(value, -6e4), 6e4) if code == "e" else value)
