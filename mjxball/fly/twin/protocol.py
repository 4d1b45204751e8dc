"""One drone's end of the CRTP protocol: a datagram in, datagrams out. No socket, no clock, no physics.

Any bytes may come in; what makes no sense is dropped, as the firmware drops it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjxball.control.crazyflie import STOCK, gains_of
from mjxball.fly import packets
from mjxball.fly.app.host import App
from mjxball.fly.app.protocol import GROUP
from mjxball.fly.app.protocol import PARAMETERS as APP_PARAMETERS
from mjxball.fly.packets import PacketError
from mjxball.fly.twin.conditions import DroneKind
from mjxball.fly.twin.firmware import Firmware
from mjxball.fly.twin.logs import (
    LOG_TYPES,
    LOG_VARIABLES,
    MAX_BLOCKS,
    MAX_VARIABLES,
    OF_DECKS,
    UNKNOWN,
    Blocks,
    Readings,
    item,
    listed,
)
from mjxball.fly.twin.logs import OF_APP as LOGGED_BY_APP

VERSION = 12
MAX_DATA = 30
GREETING = b"Bitcraze Crazyflie".ljust(30, b"\0")
CONSOLE, PARAM, COMMANDER, MEMORY, LOG, LOCALIZATION, GENERIC, SUPERVISOR = 0, 2, 3, 4, 5, 6, 7, 9
PLATFORM, LINK = 13, 15
ADDRESS = 0xE7  # last byte of the radio's, by which packed poses are told apart
# Parameters that the firmware sets to 0 by itself, within a millisecond or so: no radio reads them back sooner.
CLEARED = {"kalman.resetEstimation", "supervisor.infdmp", "syslink.probe", "system.taskDump", "system.storageStats"}
CLEARED |= {"health.startPropTest", "health.startBatTest"}
EMERGENCY, KEEPALIVE, POSE, POSES = 3, 4, 8, 9  # kinds of generic localization packets
Pose = Callable[[np.ndarray, "np.ndarray | None"], None]


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
    "lighthouse.fwdToEstimator": 1.0,
    "loco.fwdToEstimator": 1.0,
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


def _parameters(table: str) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(row["name"], row["type"], DEFAULTS.get(row["name"], 0.0), row["access"] == "r", row["access"] == "p")
        for row in listed(table)
    )


PARAMETERS = _parameters("param")
DECK_PARAMETERS = _parameters("deck param")
OF_APP = tuple(Parameter(f"{GROUP}.{name}", kind, 0.0, read_only) for name, kind, read_only in APP_PARAMETERS)


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


def header(port: int, channel: int) -> int:
    """First byte of a packet."""
    return port << 4 | 0x0C | channel


class Peer:
    """The protocol state of one drone."""

    def __init__(
        self,
        firmware: Firmware,
        on_parameter: Callable[[str, float], None] = lambda name, value: None,
        on_pose: Pose = lambda position, quaternion: None,
        estimator: int = 2,
        app: App | None = None,
        decks: Mapping[str, float] | None = None,
    ):
        """`estimator` is what the drone's decks ask for: 1 complementary, 2 Kalman; `app`: what runs beside it.

        With `decks` it lists what positioning decks have: values of those parameters that are not 0.
        """
        self.firmware, self._app = firmware, app
        self.values = defaults_of(firmware.kind, estimator)
        none: tuple[Any, ...] = ()
        more = (none if app is None else OF_APP) + (none if decks is None else DECK_PARAMETERS)
        self.parameters = PARAMETERS + more
        self.values |= {one.name: one.default for one in more} | dict(decks or {})
        parameters = [item(one.type_byte, one.name) for one in self.parameters]
        known = LOG_VARIABLES + (none if app is None else LOGGED_BY_APP) + (none if decks is None else OF_DECKS)
        variables = [item(LOG_TYPES[kind][0], name) for name, kind in known]
        self.logs = Blocks(known)
        self._estimator = estimator
        self._on_parameter, self._on_pose = on_parameter, on_pose
        self._handlers: dict[tuple[int, int], Callable[[bytes, float], list[bytes] | None]] = {
            (LINK, 0): lambda data, now: [data],
            (LINK, 1): lambda data, now: [GREETING] if data[:1] == b"\0" else [],
            (PLATFORM, 0): self._platform,
            (PLATFORM, 1): self._version,
            (PLATFORM, 2): self._of_app,
            (PARAM, 0): lambda data, now: self._contents(data, parameters, b""),
            (PARAM, 1): self._read_parameter,
            (PARAM, 2): self._write_parameter,
            (PARAM, 3): self._parameter_extra,
            (LOG, 0): lambda data, now: self._contents(data, variables, bytes([MAX_BLOCKS, MAX_VARIABLES])),
            (LOG, 1): self.logs.control,
            (MEMORY, 0): lambda data, now: [b"\x01\x00"] if data[:1] == b"\x01" else [],
            (COMMANDER, 0): self._setpoint,
            (GENERIC, 0): lambda data, now: firmware.commander.stop(now) if data[:1] == b"\0" else None,
            (GENERIC, 1): lambda data, now: firmware.commander.relax() if data[:1] == b"\0" else None,
            (LOCALIZATION, 0): self._position,
            (LOCALIZATION, 1): self._localization,
            (LOCALIZATION, 2): self._positions,
            (SUPERVISOR, 0): self._info,
            (SUPERVISOR, 1): self._command,
        }

    def receive(self, datagram: bytes, now: float) -> list[bytes]:
        """Answers to one datagram at time `now` [s]."""
        if not datagram or len(datagram) > 1 + MAX_DATA:
            return []
        if datagram[0] == 0xFF:  # a scan
            return [bytes([0xFF])] if len(datagram) == 1 else []
        port, channel = datagram[0] >> 4, datagram[0] & 3
        handler = self._handlers.get((port, channel))
        if handler is None:
            return []
        return [bytes([header(port, channel)]) + answer for answer in handler(datagram[1:], now) or ()]

    def log_data(self, readings: Readings | Mapping[str, float], now: float) -> list[bytes]:
        """The datagrams of all log blocks that are due at `now`."""
        return [bytes([header(LOG, 2)]) + data for data in self.logs.take(readings, now)]

    # Handlers: payload -> payloads of the answers.

    def _version(self, data: bytes, now: float) -> list[bytes]:
        kind = self.firmware.kind
        answers = {0: struct.pack("<i", VERSION), 1: kind.version.encode(), 2: kind.device.encode()}
        return [data[:1] + answers[data[0]]] if data and data[0] in answers else []

    def _platform(self, data: bytes, now: float) -> list[bytes]:
        """Arming and recovery as older programs ask for it."""
        supervisor = self.firmware.supervisor
        if data[:1] == b"\x01":
            done = len(data) > 1 and supervisor.request_arming(bool(data[1]))
            return [bytes([1, done, supervisor.armed])]
        return [bytes([2, supervisor.recover(), not supervisor.crashed])] if data[:1] == b"\x02" else [data]

    def _of_app(self, data: bytes, now: float) -> list[bytes]:
        answer = b"" if self._app is None else self._app.laptop(data, int(1000 * now))
        return [answer] if answer else []

    def _contents(self, data: bytes, items: list[bytes], tail: bytes) -> list[bytes]:
        if data[:1] == b"\x03":
            return [b"\x03" + struct.pack("<HI", len(items), zlib.crc32(b"".join(items))) + tail]
        if data[:1] == b"\x02" and len(data) >= 3:
            index = struct.unpack("<H", data[1:3])[0]
            return [data[:3] + items[index]] if index < len(items) else [data[:1]]
        return []

    def _parameter(self, data: bytes) -> Parameter | None:
        index = int.from_bytes(data[:2], "little") if len(data) >= 2 else len(self.parameters)
        return self.parameters[index] if index < len(self.parameters) else None

    def _read_parameter(self, data: bytes, now: float) -> list[bytes]:
        known = self._parameter(data)
        if known is None:
            return [data[:2] + bytes([UNKNOWN])] if len(data) >= 2 else []
        if self._app is not None:
            self.values |= {f"{GROUP}.{name}": value for name, value in self._app.parameters().items()}
        return [data[:2] + b"\0" + known.pack(self.values[known.name])]

    def _write_parameter(self, data: bytes, now: float) -> list[bytes]:
        known = self._parameter(data)
        if known is None:
            return [data[:2] + bytes([UNKNOWN])] if len(data) >= 2 else []
        if known.read_only:
            return []
        try:
            value = known.unpack(data[2:])
        except struct.error:
            return []
        self.values[known.name] = 0.0 if known.name in CLEARED else value
        if known.name == "stabilizer.estimator" and value not in (1, 2):
            self.values[known.name] = float(self._estimator)
        self._on_parameter(known.name, value)
        return [data[:2] + known.pack(value)]

    def _parameter_extra(self, data: bytes, now: float) -> list[bytes]:
        known = self._parameter(data[1:3])
        if known is None:
            return [data[:3] + bytes([UNKNOWN])] if len(data) >= 3 else []
        if data[0] == 0x07:
            return [data[:3] + bytes([0, int(known.persistent)])]
        default = defaults_of(self.firmware.kind, self._estimator).get(known.name, known.default)
        return [data[:3] + b"\0" + known.pack(default)] if data[0] == 0x08 else []

    def _setpoint(self, data: bytes, now: float) -> None:
        if len(data) == packets.SETPOINT_SIZE:
            self.firmware.commander.receive(packets.unpack_setpoint(data), now)

    def _position(self, data: bytes, now: float) -> None:
        if len(data) >= 12:
            self._pose(struct.unpack("<fff", data[:12]))

    def _positions(self, data: bytes, now: float) -> None:
        for number, *millimetres in struct.iter_unpack("<Bhhh", data[: len(data) // 7 * 7]):
            if number == ADDRESS:
                self._pose([value / 1000 for value in millimetres])

    def _localization(self, data: bytes, now: float) -> None:
        supervisor = self.firmware.supervisor
        if data[:1] == bytes([EMERGENCY]):
            supervisor.emergency = True
        elif data[:1] == bytes([KEEPALIVE]):
            supervisor.keepalive = now
        elif data[:1] == bytes([POSE]) and len(data) >= 29:
            x, y, z, *turned = struct.unpack("<7f", data[1:29])
            self._pose((x, y, z), turned)
        elif data[:1] == bytes([POSES]):
            self._packed_poses(data[1:])

    def _packed_poses(self, data: bytes) -> None:
        for number, x, y, z, turned in struct.iter_unpack("<BhhhI", data[: len(data) // 11 * 11]):
            if number == ADDRESS:
                try:
                    w, *vector = packets.decompress_quaternion(turned).tolist()
                except PacketError:
                    continue
                self._pose([x / 1000, y / 1000, z / 1000], [*vector, w])

    def _pose(self, position: object, turned: object = None) -> None:
        """Hand on a pose, `turned` as (x, y, z, w); the twin drops what would make its filter not finite."""
        place = np.array(position, float)
        quaternion = None if turned is None else np.roll(np.array(turned, float), 1)
        if not np.isfinite(place).all() or (quaternion is not None and not np.isfinite(quaternion).all()):
            return
        if quaternion is None or 0.5 < float(quaternion @ quaternion) < 2.0:
            self._on_pose(place, quaternion)

    def _info(self, data: bytes, now: float) -> list[bytes]:
        info = self.firmware.info
        if data[:1] == b"\x0c":
            return [b"\x8c" + struct.pack("<H", info)]
        return [bytes([0x80 | data[0], info >> data[0] - 1 & 1])] if data and 1 <= data[0] <= 11 else []

    def _command(self, data: bytes, now: float) -> list[bytes]:
        supervisor = self.firmware.supervisor
        if data[:1] == b"\x01" and len(data) >= 2:
            done = supervisor.request_arming(bool(data[1]))
            return [bytes([0x81, done, supervisor.armed])]
        if data[:1] == b"\x02":
            return [bytes([0x82, supervisor.recover(), not supervisor.crashed])]
        if data[:1] == b"\x03":
            supervisor.emergency = True
        elif data[:1] == b"\x04":
            supervisor.keepalive = now
        return []
