"""Reading and writing firmware parameters by their packets, with a deadline for every answer and repeats for lost ones.

cflib's own parameter calls wait until it has read all 240 values, and for ever if an answer is lost. Its table of
contents is used; the packets are ours (CRTP port 2, protocol version 4 and later).
"""

from __future__ import annotations

import math
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mjxball.errors import InputError
from mjxball.fly.packets import Packet

PORT, READ, WRITE = 2, 1, 2
WINDOW = 4  # requests on their way at once: the firmware's queue is short
REPEAT = 0.25  # [s] after which a request is sent again


class LinkError(InputError):
    """A drone that cannot be reached or is not what is needed, in one sentence."""


@dataclass(frozen=True)
class Element:
    """One entry of the parameter table."""

    ident: int
    code: str  # of `struct`, little-endian
    read_only: bool

    def pack(self, value: float) -> bytes:
        """`value` as the wire carries it. Raises struct.error or ValueError if the type cannot hold it."""
        return struct.pack(self.code, value if self.code[-1] in "efd" else int(value))

    def unpack(self, data: bytes) -> float:
        """The value in `data`. Raises struct.error for another length."""
        return float(struct.unpack(self.code, data)[0])


class Parameters:
    """The parameters of one drone. `received` is called by the thread that receives, the rest by any other."""

    def __init__(self, drone: str, find: Callable[[str], Element | None], send: Callable[[Packet], None], wait: float):
        """`find` looks an element up by name, `send` must not block, `wait` [s] is the deadline of every answer."""
        self._drone, self._find, self._send, self._wait = drone, find, send, wait
        self._answers: dict[tuple[int, int], bytes] = {}  # (channel, ident) -> payload behind the ident
        self._changed = threading.Condition()

    def received(self, packet: Any) -> None:
        """A packet of port 2 came."""
        data = bytes(packet.data)
        if packet.channel in (READ, WRITE) and len(data) >= 2:
            with self._changed:
                self._answers[packet.channel, struct.unpack("<H", data[:2])[0]] = data[2:]
                self._changed.notify_all()

    def has(self, name: str) -> bool:
        """True if the firmware lists `name`."""
        return self._find(name) is not None

    def read(self, names: Iterable[str]) -> dict[str, float]:
        """Values by name. Raises LinkError for an unknown one, or one that is not answered."""
        elements = {name: self._element(name) for name in names}
        answers = self._ask({name: Packet(PORT, READ, struct.pack("<H", e.ident)) for name, e in elements.items()})
        found = {}
        for name, element in elements.items():
            try:
                found[name] = element.unpack(answers[name][1:])  # a status byte precedes the value
            except struct.error:
                raise LinkError(f"parameter {name} of the {self._drone} cannot be read") from None
        return found

    def write(self, values: Mapping[str, float], check: bool = True) -> None:
        """Write `values`, and read them back unless the firmware may change them itself (`check` false).

        Raises LinkError naming the parameter that is unknown, read-only, not confirmed, or reads otherwise.
        """
        packets = {name: Packet(PORT, WRITE, self._request(name, value)) for name, value in values.items()}
        self._ask(packets)
        if not check:
            return
        for name, found in self.read(values).items():
            value = values[name]
            if not math.isclose(found, value, rel_tol=1e-6, abs_tol=1e-6):
                raise LinkError(f"parameter {name} of the {self._drone} reads {found:g} after {value:g} was written")

    def _element(self, name: str) -> Element:
        element = self._find(name)
        if element is None:
            raise LinkError(f"the firmware of the {self._drone} has no parameter {name}; update it")
        return element

    def _request(self, name: str, value: float) -> bytes:
        element = self._element(name)
        if element.read_only:
            raise LinkError(f"parameter {name} of the {self._drone} cannot be written: it is read-only")
        try:
            return struct.pack("<H", element.ident) + element.pack(value)
        except (struct.error, ValueError, OverflowError):
            text = f"parameter {name} of the {self._drone} cannot be written: {value:g} does not fit its type"
            raise LinkError(text) from None

    def _ask(self, requests: Mapping[str, Packet]) -> dict[str, bytes]:
        """Send all `requests`, a few at a time, and return their answers. Raises LinkError at the deadline."""
        waiting = list(requests)
        found: dict[str, bytes] = {}
        sent: dict[str, float] = {}
        keys = {name: (packet.channel, struct.unpack("<H", packet.data[:2])[0]) for name, packet in requests.items()}
        with self._changed:
            for key in keys.values():
                self._answers.pop(key, None)
        latest = time.monotonic()
        while waiting:
            now = time.monotonic()
            for name in waiting[:WINDOW]:
                if now - sent.get(name, -math.inf) > REPEAT:
                    sent[name] = now
                    self._send(requests[name])
            with self._changed:
                answered = [name for name in waiting if keys[name] in self._answers]
                if not answered:
                    self._changed.wait(0.02)
                    answered = [name for name in waiting if keys[name] in self._answers]
                found |= {name: self._answers.pop(keys[name]) for name in answered}
            waiting = [name for name in waiting if name not in found]
            latest = time.monotonic() if answered else latest
            if waiting and time.monotonic() - latest > self._wait:
                raise LinkError(f"the {self._drone} did not confirm parameter {waiting[0]}")
        return found
