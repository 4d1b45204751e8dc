"""CRTP protocol of one drone: maps a received datagram to answers, without sockets, clock and physics.

Any bytes may arrive. Invalid datagrams are dropped, as by the firmware.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping

import numpy as np

from mjxfly import packets
from mjxfly.app.host import App
from mjxfly.packets import PacketError
from mjxfly.twin.firmware import Firmware
from mjxfly.twin.logs import (
    LOG_TYPES,
    LOG_VARIABLES,
    MAX_BLOCKS,
    MAX_VARIABLES,
    OF_APP,
    UNKNOWN,
    Blocks,
    Readings,
    item,
)
from mjxfly.twin.parameters import Parameter, Values

VERSION = 12
MAX_DATA = 30
GREETING = b"Bitcraze Crazyflie".ljust(30, b"\0")
PARAM, COMMANDER, MEMORY, LOG, LOCALIZATION, GENERIC, SUPERVISOR = 2, 3, 4, 5, 6, 7, 9
PLATFORM, LINK = 13, 15
ADDRESS = 0xE7  # last byte of the radio's address, which identifies the drone in packed poses
EMERGENCY, KEEPALIVE, POSE, POSES = 3, 4, 8, 9  # kinds of generic localization packets
Pose = Callable[[np.ndarray, "np.ndarray | None"], None]


def header(port: int, channel: int) -> int:
    """Return the first byte of a packet."""
    return port << 4 | 0x0C | channel


class Peer:
    """The protocol state of one drone."""

    def __init__(
        self,
        firmware: Firmware,
        on_parameter: Callable[[str, float], None] = lambda name, value: None,
        on_pose: Pose = lambda position, quaternion: None,
        app: App | None = None,
        decks: Mapping[str, float] | None = None,
    ):
        """`on_parameter` and `on_pose` handle writes and poses; `decks`: values after boot that decks change."""
        self.firmware, self._app = firmware, app
        self.values = Values(firmware.kind, on_parameter, decks, None if app is None else app.parameters)
        self.parameters = self.values.listed
        parameters = [item(one.type_byte, one.name) for one in self.parameters]
        listed = LOG_VARIABLES + (() if app is None else OF_APP)
        variables = [item(LOG_TYPES[kind][0], name) for name, kind in listed]
        self.logs = Blocks(listed)
        self._on_pose = on_pose
        self._handlers: dict[tuple[int, int], Callable[[bytes, float], list[bytes] | None]] = {
            (LINK, 0): lambda data, now: [data],
            (LINK, 1): lambda data, now: [GREETING] if data[:1] == b"\0" else [],
            (PLATFORM, 0): self._platform,
            (PLATFORM, 1): self._version,
            (PLATFORM, 2): self._app_channel,
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
        """Return the answers to one datagram at time `now` [s]."""
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
        """Return the datagrams of all log blocks that are due at `now` [s]."""
        return [bytes([header(LOG, 2)]) + data for data in self.logs.take(readings, now)]

    # Handlers: payload -> payloads of the answers.

    def _version(self, data: bytes, now: float) -> list[bytes]:
        kind = self.firmware.kind
        answers = {0: struct.pack("<i", VERSION), 1: kind.version.encode(), 2: kind.device.encode()}
        return [data[:1] + answers[data[0]]] if data and data[0] in answers else []

    def _platform(self, data: bytes, now: float) -> list[bytes]:
        """Arming and recovery by the older requests."""
        supervisor = self.firmware.supervisor
        if data[:1] == b"\x01":
            done = len(data) > 1 and supervisor.request_arming(bool(data[1]))
            return [bytes([1, done, supervisor.armed])]
        return [bytes([2, supervisor.recover(), not supervisor.crashed])] if data[:1] == b"\x02" else [data]

    def _app_channel(self, data: bytes, now: float) -> list[bytes]:
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
        parameter = self._parameter(data)
        if parameter is None:
            return [data[:2] + bytes([UNKNOWN])] if len(data) >= 2 else []
        return [data[:2] + b"\0" + parameter.pack(self.values[parameter.name])]

    def _write_parameter(self, data: bytes, now: float) -> list[bytes]:
        parameter = self._parameter(data)
        if parameter is None:
            return [data[:2] + bytes([UNKNOWN])] if len(data) >= 2 else []
        if parameter.read_only:
            return []
        try:
            value = parameter.unpack(data[2:])
        except struct.error:
            return []
        self.values.write(parameter.name, value)
        return [data[:2] + parameter.pack(value)]

    def _parameter_extra(self, data: bytes, now: float) -> list[bytes]:
        parameter = self._parameter(data[1:3])
        if parameter is None:
            return [data[:3] + bytes([UNKNOWN])] if len(data) >= 3 else []
        if data[0] == 0x07:
            return [data[:3] + bytes([0, int(parameter.persistent)])]
        return [data[:3] + b"\0" + parameter.pack(self.values.defaults[parameter.name])] if data[0] == 0x08 else []

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
            x, y, z, *attitude = struct.unpack("<7f", data[1:29])
            self._pose((x, y, z), attitude)
        elif data[:1] == bytes([POSES]):
            self._packed_poses(data[1:])

    def _packed_poses(self, data: bytes) -> None:
        for number, x, y, z, attitude in struct.iter_unpack("<BhhhI", data[: len(data) // 11 * 11]):
            if number == ADDRESS:
                try:
                    w, *vector = packets.decompress_quaternion(attitude).tolist()
                except PacketError:
                    continue
                self._pose([x / 1000, y / 1000, z / 1000], [*vector, w])

    def _pose(self, position: object, attitude: object = None) -> None:
        """Pass on a pose, `attitude` as (x, y, z, w). Poses that would make the filter not finite are dropped."""
        point = np.array(position, float)
        quaternion = None if attitude is None else np.roll(np.array(attitude, float), 1)
        if not np.isfinite(point).all() or (quaternion is not None and not np.isfinite(quaternion).all()):
            return
        if quaternion is None or 0.5 < float(quaternion @ quaternion) < 2.0:
            self._on_pose(point, quaternion)

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
