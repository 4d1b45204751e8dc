"""Opening a link with cflib, with cached tables of contents, retries and progress; reading and writing parameters.

cflib requests every table entry once and waits for ever if the answer is lost. A silent link is therefore closed and
opened again. Tables that were complete by then are cached by their checksum.

Parameters are read and written with packets of our own (CRTP port 2, protocol 4 and later), with a deadline for every
answer and repeats for lost ones: cflib's own calls wait until it has read all 240 values.
"""

from __future__ import annotations

import logging
import math
import struct
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mjxball.errors import InputError
from mjxball.files import user_cache
from mjxfly import clock
from mjxfly.packets import Packet
from mjxfly.process import bounded


@dataclass(frozen=True)
class Deadlines:
    """Time limits of the link [s]."""

    connect: float = 120.0  # in total: 600 table entries the first time, one round trip each
    silence: float = 2.0  # without a packet while connecting
    attempts: int = 3
    parameter: float = 2.0  # without an answer
    request: float = 2.0  # for cflib to take a packet, before the flight
    first_state: float = 3.0
    version: float = 1.0
    close: float = 2.0


@dataclass(frozen=True)
class Identity:
    """Firmware and hardware that a drone reports; "?" for what it does not."""

    protocol: int = 0
    version: str = "?"  # of the firmware, such as 2026.08
    device: str = "?"  # such as Crazyflie 2.1
    revision: str = "?"  # of the firmware's source


def table_cache() -> str | None:
    """Directory of cached firmware tables of contents, one file each; None if it cannot be created."""
    above = user_cache()
    if above is None:
        return None
    place = above / "crazyflie"
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(place)


def connect(
    uri: str,
    name: str,
    deadlines: Deadlines,
    progress: Callable[[str], None],
    lost: Callable[[str], None],
    console: Callable[[str], None],
) -> Any:
    """An open cflib `Crazyflie`; `lost` receives why it ends, `console` what it prints. Raises LinkError."""
    import cflib.crtp

    _start_drivers(cflib.crtp)
    started = clock.now()
    for attempt in range(1, deadlines.attempts + 1):
        crazyflie, reason, refused = _attempt(uri, name, deadlines, started, progress)
        if not reason:
            crazyflie.connection_lost.add_callback(lambda _, why: lost(why))
            crazyflie.console.receivedChar.add_callback(console)
            if crazyflie.link is None:  # it ended in between
                raise LinkError(f"{name} at {uri} cannot be reached: the link ended; {REACH}")
            # A packet that looks like an answer to connecting would start it again and reset the drone's log.
            crazyflie.log.refresh_toc = lambda *_: None
            # Its pings share a lock with every send; when a link dies, their thread holds the lock for ever.
            bounded(crazyflie.link_statistics.stop, deadlines.close)
            return crazyflie
        bounded(crazyflie.close_link, deadlines.close)
        if refused or clock.now() - started > deadlines.connect or attempt == deadlines.attempts:
            break
        progress(f"{name}: {reason}, trying again")
    why = reason.removeprefix(NO_DRIVER)
    remedy = DONGLE if why != reason and uri.startswith("radio:") else REACH
    raise LinkError(f"{name} at {uri} cannot be reached: {why}; {remedy}")


def _attempt(
    uri: str, name: str, deadlines: Deadlines, started: float, progress: Callable[[str], None]
) -> tuple[Any, str, bool]:
    """(Crazyflie, failure or "", whether the link was refused rather than silent) of one attempt to open a link."""
    from cflib.crazyflie import Crazyflie

    crazyflie, ready = Crazyflie(rw_cache=table_cache()), threading.Event()
    failed: list[str] = []
    heard = [clock.now()]

    def refused(_: str, why: str) -> None:
        failed.append((why.strip().splitlines() or ["link error"])[0])
        ready.set()

    def arrived(_: Any) -> None:
        heard[0] = clock.now()

    # Reading all parameters would take 240 round trips; the few that are needed are read by name.
    crazyflie.param.request_update_of_all_params = lambda: None
    crazyflie.connected.add_callback(lambda _: ready.set())
    crazyflie.connection_failed.add_callback(refused)
    crazyflie.connection_lost.add_callback(refused)
    crazyflie.packet_received.add_callback(arrived)
    threading.Thread(target=crazyflie.open_link, args=(uri,), daemon=True).start()
    while not ready.wait(clock.real(0.5)):
        now = clock.now()
        if now - heard[0] > deadlines.silence or now - started > deadlines.connect:
            return crazyflie, f"no answer within {now - heard[0]:.1f} s", False
        logs, params = _listed(crazyflie.log.toc), _listed(crazyflie.param.toc)
        progress(f"{name}: connecting, {logs} log variables and {params} parameters listed")
    crazyflie.packet_received.remove_callback(arrived)
    return crazyflie, failed[0] if failed else "", bool(failed)


def _listed(table: Any) -> int:
    """Number of entries read so far of a cflib table, which is None before reading begins."""
    return sum(map(len, list(table.toc.values()))) if table is not None else 0


_drivers = threading.Lock()


def _start_drivers(crtp: Any) -> None:
    """Start cflib's drivers once, and keep its log messages off the terminal."""
    with _drivers:
        if not crtp.CLASSES:
            crtp.init_drivers()
        logger = logging.getLogger("cflib")
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())
            logger.propagate = False


NO_DRIVER = "Couldn't load link driver: "  # cflib's message if no dongle is found
DONGLE = "plug a Crazyradio in for it; on Linux it needs Bitcraze's udev rules"
REACH = "is it on and in reach, and is the URI its own?"
PORT, READ, WRITE = 2, 1, 2
WINDOW = 4  # requests in flight: the firmware's queue is short
REPEAT = 0.25  # [s] after which a request is repeated


class LinkError(InputError):
    """A drone cannot be reached or does not fit the flight; the message is one sentence."""


@dataclass(frozen=True)
class Element:
    """One entry of the parameter table."""

    ident: int
    code: str  # of `struct`, little-endian
    read_only: bool


class Parameters:
    """The parameters of one drone. The receiving thread calls `received`; any other thread may call the rest."""

    def __init__(self, drone: str, find: Callable[[str], Element | None], send: Callable[[Packet], None], wait: float):
        """`find` looks up an element by name, `send` must not block, `wait` [s] is the deadline of every answer."""
        self._drone, self._find, self._send, self._wait = drone, find, send, wait
        self._answers: dict[tuple[int, int], bytes] = {}  # (channel, ident) -> payload behind the ident
        self._changed = threading.Condition()

    def received(self, packet: Any) -> None:
        """Store the answer in a packet of port 2."""
        data = bytes(packet.data)
        if packet.channel in (READ, WRITE) and len(data) >= 2:
            with self._changed:
                self._answers[packet.channel, struct.unpack("<H", data[:2])[0]] = data[2:]
                self._changed.notify_all()

    def listed(self, names: Iterable[str]) -> list[str]:
        """Those of `names` that the firmware lists."""
        return [name for name in names if self._find(name) is not None]

    def read(self, names: Iterable[str]) -> dict[str, float]:
        """Values by name. Raises LinkError for a parameter that is unknown or not answered."""
        elements = {name: self._element(name) for name in names}
        answers = self._ask({name: Packet(PORT, READ, struct.pack("<H", e.ident)) for name, e in elements.items()})
        try:  # a status byte precedes the value
            return {name: float(struct.unpack(e.code, answers[name][1:])[0]) for name, e in elements.items()}
        except struct.error:
            raise LinkError(
                f"a parameter of the {self._drone} cannot be read: {', '.join(elements)}; update its firmware"
            ) from None

    def write(self, values: Mapping[str, float], check: bool = True) -> None:
        """Write `values` and read them back; without `check` if the firmware changes them itself.

        Raises LinkError naming a parameter that is unknown, read-only, not confirmed, or reads back differently.
        """
        packets = {name: Packet(PORT, WRITE, self._request(name, value)) for name, value in values.items()}
        self._ask(packets)
        if not check:
            return
        for name, found in self.read(values).items():
            value = values[name]
            if not math.isclose(found, value, rel_tol=1e-6, abs_tol=1e-6):
                text = f"parameter {name} of the {self._drone} reads {found:g} after {value:g} was written"
                raise LinkError(f"{text}; does another program write it?")

    def _element(self, name: str) -> Element:
        element = self._find(name)
        if element is None:
            raise LinkError(f"the firmware of the {self._drone} has no parameter {name}; update it")
        return element

    def _request(self, name: str, value: float) -> bytes:
        element = self._element(name)
        if element.read_only:
            raise LinkError(f"parameter {name} of the {self._drone} cannot be written: it is read-only; leave it out")
        try:
            number = value if element.code[-1] in "efd" else int(value)
            return struct.pack("<H", element.ident) + struct.pack(element.code, number)
        except (struct.error, ValueError, OverflowError):
            text = f"parameter {name} of the {self._drone} cannot be written: {value:g} does not fit its type"
            raise LinkError(text) from None

    def _ask(self, requests: Mapping[str, Packet]) -> dict[str, bytes]:
        """Send all `requests`, `WINDOW` at a time; return the answers. Raises LinkError at the deadline."""
        waiting, found, sent = list(requests), dict[str, bytes](), dict[str, float]()
        keys = {name: (packet.channel, struct.unpack("<H", packet.data[:2])[0]) for name, packet in requests.items()}
        with self._changed:
            for key in keys.values():
                self._answers.pop(key, None)
        latest = clock.now()
        while waiting:
            now = clock.now()
            for name in waiting[:WINDOW]:
                if now - sent.get(name, -math.inf) > REPEAT:
                    sent[name] = now
                    self._send(requests[name])
            with self._changed:
                self._changed.wait_for(lambda: any(keys[name] in self._answers for name in waiting), 0.02)  # noqa: B023
                answered = [name for name in waiting if keys[name] in self._answers]
                found |= {name: self._answers.pop(keys[name]) for name in answered}
            waiting = [name for name in waiting if name not in found]
            latest = clock.now() if answered else latest
            if waiting and clock.now() - latest > self._wait:
                raise LinkError(f"the {self._drone} did not confirm parameter {waiting[0]}; is it in reach?")
        return found
