"""One drone's end of the CRTP protocol: a datagram in, datagrams out. No socket, no clock, no physics.

Any bytes may come in; what makes no sense is dropped, as the firmware drops it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from mjxball.fly import packets
from mjxball.fly.twin import tables
from mjxball.fly.twin.firmware import Firmware

VERSION = 12
MAX_DATA = 30
GREETING = b"Bitcraze Crazyflie".ljust(30, b"\0")
MAX_BLOCKS, MAX_BLOCK_BYTES = 16, 26
EXISTS, UNKNOWN, TOO_BIG, NO_MEMORY, BAD = 17, 2, 7, 12, 8
CONSOLE, PARAM, COMMANDER, MEMORY, LOG, GENERIC, SUPERVISOR, PLATFORM, LINK = 0, 2, 3, 4, 5, 7, 9, 13, 15


def header(port: int, channel: int) -> int:
    """First byte of a packet."""
    return port << 4 | 0x0C | channel


@dataclass
class Block:
    """A log block that was created."""

    variables: list[tuple[str, str]] = field(default_factory=list)  # (name, struct code as fetched)
    period: float = 0.0  # [s], 0 while stopped
    due: float = 0.0  # [s]

    @property
    def size(self) -> int:
        """Bytes of its values."""
        return sum(struct.calcsize("<" + code) for _, code in self.variables)


class Peer:
    """The protocol state of one drone."""

    def __init__(self, firmware: Firmware, on_parameter: Callable[[str, float], None] = lambda name, value: None):
        self.firmware = firmware
        self.values = {parameter.name: parameter.default for parameter in tables.PARAMETERS}
        self.blocks: dict[int, Block] = {}
        self._on_parameter = on_parameter
        self._handlers = {
            (LINK, 0): self._echo,
            (LINK, 1): lambda data, now: [GREETING] if data[:1] == b"\0" else [],
            (PLATFORM, 1): self._version,
            (PARAM, 0): lambda data, now: self._contents(data, tables.PARAM_ITEMS, b""),
            (PARAM, 1): self._read_parameter,
            (PARAM, 2): self._write_parameter,
            (PARAM, 3): self._parameter_extra,
            (LOG, 0): lambda data, now: self._contents(data, tables.LOG_ITEMS, bytes([10, 80])),
            (LOG, 1): self._log_settings,
            (MEMORY, 0): lambda data, now: [b"\x01\x00"] if data[:1] == b"\x01" else [],
            (COMMANDER, 0): self._setpoint,
            (GENERIC, 0): self._stop,
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
        return [bytes([header(port, channel)]) + answer for answer in handler(datagram[1:], now)]

    def console(self, text: str) -> bytes:
        """A datagram that prints `text` on the laptop."""
        return bytes([header(CONSOLE, 0)]) + text.encode()[:MAX_DATA]

    def is_due(self, now: float) -> bool:
        """True if `log_data` has something to send at `now` [s]."""
        return any(block.period and now >= block.due for block in self.blocks.values())

    def log_data(self, readings: Mapping[str, float], now: float) -> list[bytes]:
        """The datagrams of all blocks that are due at `now`; their time stamp is `now` in ms."""
        sent = []
        for number, block in self.blocks.items():
            if block.period and now >= block.due:
                late = now - block.due
                block.due = now + block.period if late > block.period else block.due + block.period
                stamp = struct.pack("<I", int(now * 1000) & 0xFFFFFF)[:3]
                values = b"".join(_pack(code, readings[name]) for name, code in block.variables)
                sent.append(bytes([header(LOG, 2), number]) + stamp + values)
        return sent

    # Handlers: payload -> payloads of the answers.

    def _echo(self, data: bytes, now: float) -> list[bytes]:
        return [data]

    def _version(self, data: bytes, now: float) -> list[bytes]:
        if data[:1] == b"\0":
            return [b"\0" + struct.pack("<i", VERSION)]
        return [b"\x01" + b"twin 2026.08\0"] if data[:1] == b"\x01" else []

    def _contents(self, data: bytes, items: list[bytes], tail: bytes) -> list[bytes]:
        if data[:1] == b"\x03":
            return [b"\x03" + struct.pack("<HI", len(items), tables.checksum(items)) + tail]
        if data[:1] == b"\x02" and len(data) >= 3:
            index = struct.unpack("<H", data[1:3])[0]
            return [data[:3] + items[index]] if index < len(items) else []
        return []

    def _parameter(self, data: bytes) -> tables.Parameter | None:
        if len(data) < 2:
            return None
        index = struct.unpack("<H", data[:2])[0]
        return tables.PARAMETERS[index] if index < len(tables.PARAMETERS) else None

    def _read_parameter(self, data: bytes, now: float) -> list[bytes]:
        known = self._parameter(data)
        if known is None:
            return [data[:2] + bytes([UNKNOWN])] if len(data) >= 2 else []
        return [data[:2] + b"\0" + known.pack(self.values[known.name])]

    def _write_parameter(self, data: bytes, now: float) -> list[bytes]:
        known = self._parameter(data)
        if known is None or known.read_only:
            return []
        try:
            value = known.unpack(data[2:])
        except struct.error:
            return []
        self.values[known.name] = value
        self._on_parameter(known.name, value)
        return [data[:2] + known.pack(value)]

    def _parameter_extra(self, data: bytes, now: float) -> list[bytes]:
        known = self._parameter(data[1:3])
        if known is None:
            return [data[:3] + bytes([UNKNOWN])] if len(data) >= 3 else []
        if data[0] == 0x07:
            return [data[:3] + bytes([0, int(known.persistent)])]
        return [data[:3] + b"\0" + known.pack(known.default)] if data[0] == 0x08 else []

    def _log_settings(self, data: bytes, now: float) -> list[bytes]:
        if data[:1] == b"\x05":
            self.blocks.clear()
            return [b"\x05\0\0"]
        if len(data) < 2:
            return []
        return [data[:2] + bytes([self._log_command(data[0], data[1], data[2:], now)])]

    def _log_command(self, command: int, number: int, rest: bytes, now: float) -> int:
        block = self.blocks.get(number)
        if command == 0x06:
            if block is not None:
                return EXISTS
            if len(self.blocks) >= MAX_BLOCKS:
                return NO_MEMORY
            fresh = Block()
            error = _append(fresh, rest)
            if not error:
                self.blocks[number] = fresh
            return error
        if block is None:
            return UNKNOWN
        if command == 0x07:
            return _append(block, rest)
        if command == 0x03 and rest[:1] not in (b"", b"\0"):
            block.period, block.due = rest[0] / 100, now
            return 0
        if command == 0x04:
            block.period = 0.0
            return 0
        if command == 0x02:
            del self.blocks[number]
            return 0
        return BAD

    def _setpoint(self, data: bytes, now: float) -> list[bytes]:
        if len(data) == packets.SETPOINT_SIZE:
            self.firmware.receive_setpoint(packets.unpack_setpoint(data), now)
        return []

    def _stop(self, data: bytes, now: float) -> list[bytes]:
        if data[:1] == b"\0":
            self.firmware.receive_stop()
        return []

    def _info(self, data: bytes, now: float) -> list[bytes]:
        return [b"\x8c" + struct.pack("<H", self.firmware.info)] if data[:1] == b"\x0c" else []

    def _command(self, data: bytes, now: float) -> list[bytes]:
        firmware = self.firmware
        if data[:1] == b"\x01" and len(data) >= 2:
            done = firmware.arm(bool(data[1]))
            return [bytes([0x81, done, firmware.armed])]
        if data[:1] == b"\x02":
            return [bytes([0x82, firmware.recover(), not firmware.crashed])]
        if data[:1] == b"\x03":
            firmware.emergency_stop()
        elif data[:1] == b"\x04":
            firmware.keep_alive(now)
        return []


def _append(block: Block, entries: bytes) -> int:
    """Add (type, id) entries of 3 bytes to `block`; cflib sends one stray byte after the ninth, which is no entry."""
    added = []
    for at in range(0, len(entries) - 2, 3):
        kind, index = entries[at] & 0x0F, struct.unpack("<H", entries[at + 1 : at + 3])[0]
        if index >= len(tables.LOG_VARIABLES) or kind not in tables.LOG_CODES:
            return UNKNOWN
        added.append((tables.LOG_VARIABLES[index][0], tables.LOG_CODES[kind]))
    grown = Block(block.variables + added)
    if grown.size > MAX_BLOCK_BYTES:
        return TOO_BIG
    block.variables = grown.variables
    return 0


_RANGES = {"B": (0, 2**8 - 1), "H": (0, 2**16 - 1), "I": (0, 2**32 - 1)}
_RANGES |= {"b": (-(2**7), 2**7 - 1), "h": (-(2**15), 2**15 - 1), "i": (-(2**31), 2**31 - 1)}


def _pack(code: str, value: float) -> bytes:
    if code in _RANGES:
        low, high = _RANGES[code]
        return struct.pack("<" + code, min(max(int(value), low), high))
    return struct.pack("<" + code, min(max(value, -6e4), 6e4) if code == "e" else value)
