"""Faults of the link and of a drone, to be switched on and off while the twin flies."""

from __future__ import annotations

import heapq
import itertools
import math
import re
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
    stabilizer_dead: bool = False  # its task hangs: the log goes on with fresh stamps and frozen values, PWM stays
    stopped: bool = False  # the program hangs: nothing is answered, PWM stays
    restarts: bool = True  # the microcontroller's watchdog restarts what hangs; else its motors stay off


class BodyFault(NamedTuple):
    """What happens to the body of a drone, see `body.Pair.disturb`."""

    what: str  # "frozen", "lost", "jump": of its poses; "battery", "gain"
    value: float


# What `--fault KIND:DRONE@S` can be: faults of the link, of a drone, or what the twin does to it.
What = LinkFaults | DroneFaults | BodyFault | str
FAULT_KINDS: dict[str, What] = {
    "silent": LinkFaults(silent_up=True, silent_down=True),
    "silent-up": LinkFaults(silent_up=True),
    "silent-down": LinkFaults(silent_down=True),
    "loss": LinkFaults(loss=0.3),
    "frozen": DroneFaults(frozen=True),
    "clock": DroneFaults(clock_stopped=True),
    "jump": DroneFaults(offset=(0.0, 0.0, 0.4)),
    "battery": DroneFaults(battery=-1.2),
    "garbage": DroneFaults(garbage=3.0),
    "crash": "crash",
    "power": "kill",
    "port": "close_port",
    "reboot": "reboot",
    "stabilizer": DroneFaults(stabilizer_dead=True),
    "imu": DroneFaults(stabilizer_dead=True),  # the stabilizer waits for it
    "stopped": DroneFaults(stopped=True),
    "killed": DroneFaults(stopped=True, restarts=False),
    "pose-frozen": BodyFault("frozen", 1.0),
    "pose-lost": BodyFault("lost", 1.0),
    "pose-jump": BodyFault("jump", 0.4),
    "sag": BodyFault("battery", 3.0),
    "weak": BodyFault("gain", 0.9),
}


class Injection(NamedTuple):
    """A fault that comes during a rehearsal."""

    what: What
    drone: int  # 0 leader, 1 follower
    after: float  # the first motor has turned [s]


def read_fault(text: str) -> Injection:
    """The fault of `KIND:DRONE@S`, such as `frozen:follower@3`. Raises InputError."""
    match = re.fullmatch(r"([\w-]+):(leader|follower)@(\d{1,4}(?:\.\d+)?)", text)
    if match is None or match[1] not in FAULT_KINDS:
        raise InputError(
            f"--fault {text} is no KIND:DRONE@S such as frozen:follower@3; kinds: {', '.join(FAULT_KINDS)}"
        )
    return Injection(FAULT_KINDS[match[1]], ("leader", "follower").index(match[2]), float(match[3]))


class Channel:
    """One way of a link: datagrams go in, and come out late, or never."""

    def __init__(self, random: np.random.Generator):
        self._random = random
        self._waiting: list[tuple[float, int, bytes]] = []
        self._count = itertools.count()

    def push(self, datagram: bytes, now: float, faults: LinkFaults, silent: bool, delay: float = 0.0) -> None:
        """Take a datagram in at time `now` [s]; `delay` [s] is added to that of `faults`."""
        if silent or (faults.loss and self._random.random() < faults.loss):
            return
        due = now + faults.delay + delay
        if faults.jitter:
            due += faults.jitter * self._random.random()
        heapq.heappush(self._waiting, (due, next(self._count), datagram))

    def due(self, now: float) -> list[bytes]:
        """Datagrams that come out by `now` [s], in order."""
        return [datagram for _, datagram in self.timed(now)]

    def timed(self, now: float) -> list[tuple[float, bytes]]:
        """The same, each with its time [s]."""
        out = []
        while self._waiting and self._waiting[0][0] <= now + 1e-9:
            due, _, datagram = heapq.heappop(self._waiting)
            out.append((due, datagram))
        return out

    @property
    def next(self) -> float:
        """When the next datagram comes out [s]."""
        return self._waiting[0][0] if self._waiting else math.inf


def garbage(random: np.random.Generator) -> bytes:
    """A datagram of random bytes; half of them begin with a port that is in use."""
    size = int(random.integers(0, 40))
    data = bytearray(random.integers(0, 256, size, dtype=np.uint8).tobytes())
    if size and random.random() < 0.5:
        port, channel = random.choice([0, 2, 3, 4, 5, 7, 9, 13, 15]), random.integers(0, 4)
        data[0] = int(port) << 4 | 0x0C | int(channel)
    return bytes(data)
