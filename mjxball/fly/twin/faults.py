"""Faults of the link and of a drone, to be switched on and off while the twin flies."""

from __future__ import annotations

import heapq
import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjxball.errors import InputError


@dataclass(frozen=True)
class LinkFaults:
    """What happens to datagrams of one drone. The default is a perfect link."""

    loss: float = 0.0  # share of datagrams that vanish, each way
    delay: float = 0.0  # of every datagram [s]
    jitter: float = 0.0  # added delay, uniform from 0 to this [s]: datagrams may overtake each other
    silent_up: bool = False  # nothing reaches the drone
    silent_down: bool = False  # nothing comes from the drone


@dataclass(frozen=True)
class DroneFaults:
    """What one drone gets wrong. The default is nothing."""

    frozen: bool = False  # the estimator repeats its last state, the clock goes on
    clock_stopped: bool = False  # time stamps stand still
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # added to the reported position [m]
    battery: float = 0.0  # added to the reported voltage [V]
    garbage: float = 0.0  # datagrams of random bytes sent for each step


# What `--fault KIND:DRONE@S` can be: faults of the link, of a drone, or what the twin does to it.
STRIKES: dict[str, LinkFaults | DroneFaults | str] = {
    "silent": LinkFaults(silent_up=True, silent_down=True),
    "silent-up": LinkFaults(silent_up=True),
    "silent-down": LinkFaults(silent_down=True),
    "frozen": DroneFaults(frozen=True),
    "clock": DroneFaults(clock_stopped=True),
    "jump": DroneFaults(offset=(0.0, 0.0, 0.4)),
    "battery": DroneFaults(battery=-1.2),
    "garbage": DroneFaults(garbage=3.0),
    "crash": "crash",
    "power": "kill",
    "port": "close_port",
    "reboot": "reboot",
}


class Strike(NamedTuple):
    """A fault that comes during a rehearsal."""

    what: LinkFaults | DroneFaults | str
    drone: int  # 0 leader, 1 follower
    after: float  # the first motor has turned [s]


def read_strike(text: str) -> Strike:
    """The fault of `KIND:DRONE@S`, such as `frozen:follower@3`. Raises InputError."""
    match = re.fullmatch(r"([\w-]+):(leader|follower)@(\d{1,4}(?:\.\d+)?)", text)
    if match is None or match[1] not in STRIKES:
        raise InputError(f"--fault {text} is no KIND:DRONE@S such as frozen:follower@3; kinds: {', '.join(STRIKES)}")
    return Strike(STRIKES[match[1]], ("leader", "follower").index(match[2]), float(match[3]))


class Channel:
    """One way of a link: datagrams go in, and come out late, or never."""

    def __init__(self, random: np.random.Generator):
        self._random = random
        self._waiting: list[tuple[float, int, bytes]] = []
        self._count = itertools.count()

    def push(self, datagram: bytes, now: float, faults: LinkFaults, silent: bool) -> None:
        """Take a datagram in at time `now` [s]."""
        if silent or (faults.loss and self._random.random() < faults.loss):
            return
        due = now + faults.delay
        if faults.jitter:
            due += faults.jitter * self._random.random()
        heapq.heappush(self._waiting, (due, next(self._count), datagram))

    def due(self, now: float) -> list[bytes]:
        """Datagrams that come out by `now` [s], in order."""
        out = []
        while self._waiting and self._waiting[0][0] <= now:
            out.append(heapq.heappop(self._waiting)[2])
        return out


def garbage(random: np.random.Generator) -> bytes:
    """A datagram of random bytes; half of them begin with a port that is in use."""
    size = int(random.integers(0, 40))
    data = bytearray(random.integers(0, 256, size, dtype=np.uint8).tobytes())
    if size and random.random() < 0.5:
        port, channel = random.choice([0, 2, 3, 4, 5, 7, 9, 13, 15]), random.integers(0, 4)
        data[0] = int(port) << 4 | 0x0C | int(channel)
    return bytes(data)


Inject = Callable[[int, str], None]
