"""One drone over cflib. Everything that may block does so in a thread of its own, and under a deadline.

cflib is imported when a link is opened, so that all else here works without it.
"""

from __future__ import annotations

import collections
import functools
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mjxball.errors import InputError
from mjxball.fly import packets
from mjxball.fly.packets import Packet, PacketError
from mjxball.fly.telemetry import Telemetry

Note = Callable[..., None]  # note(kind, **fields): into the flight log
PROTOCOL = 12  # CRTP version with a supervisor port
LOG_PORT, LOG_DATA = 5, 2


@dataclass(frozen=True)
class Deadlines:
    """How long the link may take [s]."""

    connect: float = 15.0  # tables and parameters over a radio take several seconds
    parameter: float = 1.0  # each write with its read back
    request: float = 2.0  # a packet of ours, before the flight
    first_state: float = 2.0
    close: float = 2.0


class LinkError(InputError):
    """A drone that cannot be reached or is not what is needed, in one sentence."""


def bounded(action: Callable[[], Any], seconds: float) -> bool:
    """Run `action` in a thread; false if it has not returned after `seconds`, it is then left behind.

    cflib waits without limit in places, and some of its callbacks can lock each other out.
    """
    thread = threading.Thread(target=action, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


class Link:
    """One drone: newest state, newest setpoint out, parameters. `send` and `command` never block."""

    def __init__(self, uri: str, name: str, note: Note, deadlines: Deadlines = Deadlines()):
        self.uri, self.name = uri, name
        self.telemetry = Telemetry()
        self.lost: str | None = None  # why, once the link has ended
        self.overwritten = self.sent = 0
        self.firmware: dict[str, str] = {}
        self._note, self._deadlines = note, deadlines
        self._wake = threading.Condition()
        self._setpoint: Packet | None = None
        self._commands: collections.deque[Packet] = collections.deque()
        self._waiting_since: float | None = None
        self._closing = False
        self._block = -1
        self._crazyflie: Any = None
        self._driver: Any = None
        self._sender = threading.Thread(target=self._send_all, name=f"sender {name}", daemon=True)

    # Before flight; these may block up to their deadlines.

    def open(self) -> None:
        """Connect, with all tables and parameters. Raises LinkError."""
        import cflib.crtp
        from cflib.crazyflie import Crazyflie

        _start_drivers(cflib.crtp)
        crazyflie, ready = Crazyflie(), threading.Event()
        failed: list[str] = []

        def refused(_: str, why: str) -> None:
            failed.append(why)
            ready.set()

        def lost(uri: str, why: str) -> None:
            self._end(why)
            refused(uri, why)

        crazyflie.fully_connected.add_callback(lambda uri: ready.set())
        crazyflie.connection_failed.add_callback(refused)
        crazyflie.connection_lost.add_callback(lost)
        crazyflie.console.receivedChar.add_callback(lambda text: self._note("console", drone=self.name, text=text))
        self._crazyflie = crazyflie
        started = time.monotonic()
        threading.Thread(target=crazyflie.open_link, args=(self.uri,), daemon=True).start()
        arrived = ready.wait(self._deadlines.connect)
        if failed or not arrived:
            self.close()
            reason = failed[0].strip().splitlines()[0] if failed else f"no answer within {self._deadlines.connect:g} s"
            raise LinkError(f"{self.name} at {self.uri} cannot be reached: {reason}")
        self._driver = crazyflie.link
        latency = crazyflie.link_statistics.latency.latency
        # Its pings share a lock with every send, and their thread holds that lock for ever when a link dies.
        bounded(crazyflie.link_statistics.stop, self._deadlines.close)
        self._check_version(time.monotonic() - started, latency)
        self._sender.start()

    def _check_version(self, seconds: float, latency: float) -> None:
        version = self._crazyflie.platform.get_protocol_version()
        names = ("firmware.revision0", "firmware.revision1", "firmware.modified")
        values = self._crazyflie.param.values
        known = {name: values.get(name.split(".")[0], {}).get(name.split(".")[1], "?") for name in names}
        self.firmware = {"protocol": str(version), **known}
        self._note("connected", drone=self.name, uri=self.uri, seconds=seconds, latency_ms=latency, **self.firmware)
        if version < PROTOCOL:
            self.close()
            raise LinkError(f"{self.name} speaks protocol {version}, {PROTOCOL} is needed; update its firmware")

    def start_states(self) -> None:
        """Have the state sent at 100 Hz, and wait for the first one. Raises LinkError."""
        block = self._log_block("state", packets.STATE_VARIABLES, 10)
        self._block = block.id
        self._crazyflie.add_header_callback(self._receive, LOG_PORT, LOG_DATA)
        self._ask(block.start)
        deadline = time.monotonic() + self._deadlines.first_state
        while self.telemetry.newest is None:
            if time.monotonic() > deadline:
                raise LinkError(f"the {self.name} sends no state within {self._deadlines.first_state:g} s")
            time.sleep(0.01)

    def write_parameters(self, values: Mapping[str, float]) -> None:
        """Write each parameter and read it back. Raises LinkError naming the one that differs or is missing."""
        for name, value in values.items():
            answer: list[str] = []
            heard = threading.Event()

            def updated(_: str, text: str, answer: list[str] = answer, heard: threading.Event = heard) -> None:
                answer.append(text)
                if len(answer) >= 2:
                    heard.set()

            group, _, variable = name.partition(".")
            param = self._crazyflie.param
            param.add_update_callback(group, variable, updated)
            refused = self._ask(functools.partial(_write, param, name, value))
            if refused is not None:
                raise LinkError(f"parameter {name} of the {self.name} cannot be written: {refused}")
            in_time = heard.wait(self._deadlines.parameter)
            param.remove_update_callback(group, variable, updated)
            if not in_time:
                raise LinkError(f"the {self.name} did not confirm parameter {name}")
            if abs(float(answer[-1]) - value) > 1e-6 * max(1.0, abs(value)):
                raise LinkError(f"parameter {name} of the {self.name} reads {answer[-1]} after {value:g} was written")
            self._note("parameter", drone=self.name, name=name, value=value)

    def stream(self, variables: tuple[str, ...], period_ms: int, take: Callable[[dict[str, float]], None]) -> Any:
        """Have `take` called with further log variables; returns what `stop_stream` ends. Raises LinkError."""
        block = self._log_block("extra", [(name, "float") for name in variables], period_ms)
        block.data_received_cb.add_callback(lambda stamp, data, config: take(data))
        self._ask(block.start)
        return block

    def stop_stream(self, block: Any) -> None:
        """End a `stream`. Raises LinkError."""
        self._ask(block.stop)
        self._ask(block.delete)

    def _log_block(self, title: str, variables: Iterable[tuple[str, str]], period_ms: int) -> Any:
        from cflib.crazyflie.log import LogConfig

        block = LogConfig(title, period_ms)
        for name, kind in variables:
            block.add_variable(name, kind)
        missing = self._ask(lambda: self._crazyflie.log.add_config(block))
        if missing is not None:
            raise LinkError(f"the firmware of the {self.name} lacks a log variable: {missing}")
        return block

    def _ask(self, request: Callable[[], Any]) -> Any:
        """Make a `request` of cflib, whose sends wait without limit for a link that is dying; its refusal, if any.

        Raises LinkError if that takes too long.
        """
        refused: list[Any] = []

        def ask() -> None:
            try:
                request()
            except Exception as error:  # cflib raises many kinds, Exception itself among them
                refused.append(error.args[0] if error.args else type(error).__name__)

        if not bounded(ask, self._deadlines.request):
            raise LinkError(f"the link to the {self.name} takes no packet within {self._deadlines.request:g} s")
        return refused[0] if refused else None

    # In flight; these never block.

    def send(self, packet: Packet) -> None:
        """Put `packet` out as the newest setpoint; one that was not sent yet is dropped."""
        with self._wake:
            self.overwritten += self._setpoint is not None
            self._setpoint = packet
            self._waiting_since = self._waiting_since or time.monotonic()
            self._wake.notify()

    def command(self, packet: Packet) -> None:
        """Queue `packet` before any setpoint; an older setpoint that still waits is dropped."""
        with self._wake:
            self._setpoint = None
            if packet == packets.EMERGENCY_STOP:
                self._commands.clear()  # nothing may be before it, or in its place
            if len(self._commands) < 20:
                self._commands.append(packet)
            self._waiting_since = self._waiting_since or time.monotonic()
            self._wake.notify()

    def stuck_for(self, now: float) -> float:
        """How long the sender has been unable to send what waits [s]."""
        since = self._waiting_since
        return 0.0 if since is None else now - since

    def close(self) -> None:
        """End the link: cflib sends one zero setpoint. Returns after the deadline at the latest."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        if self._crazyflie is not None and not bounded(self._crazyflie.close_link, self._deadlines.close):
            self._note("warning", text=f"the link of the {self.name} did not close in time")

    def _send_all(self) -> None:
        from cflib.crtp.crtpstack import CRTPPacket

        while True:
            with self._wake:
                while not (self._commands or self._setpoint or self._closing):
                    self._wake.wait()
                if self._closing and not self._commands:
                    return
                packet: Packet | None = None
                if self._commands:
                    packet = self._commands.popleft()
                else:
                    packet, self._setpoint = self._setpoint, None
            if packet is None:
                continue
            wire = CRTPPacket()
            wire.set_header(packet.port, packet.channel)
            wire.data = packet.data
            # Not through Crazyflie.send_packet: its lock stays held when a driver reports an error from inside.
            try:
                self._driver.send_packet(wire)
            except Exception as error:  # whatever a driver raises, this link is at its end and the loop must hear of it
                self._end(f"{type(error).__name__}: {error}")
            self.sent += 1
            with self._wake:
                waiting = self._commands or self._setpoint
                self._waiting_since = time.monotonic() if waiting else None

    def _receive(self, packet: Any) -> None:
        """A log packet, in cflib's thread; whatever is not a whole state is counted and dropped."""
        arrival, data = time.monotonic(), bytes(packet.data)
        if len(data) < 4 or data[0] != self._block:
            return
        try:
            state = packets.unpack_state(data[4:])
        except PacketError:
            self.telemetry.damaged += 1
            return
        sample = self.telemetry.take(state, int.from_bytes(data[1:4], "little"), arrival)
        if sample is not None:
            self._note("state", t=arrival, drone=self.name, raw=data.hex())

    def _end(self, why: str) -> None:
        self.lost = self.lost or (why.strip().splitlines() or ["link error"])[0]
        self._note("link", drone=self.name, text=self.lost)


_drivers = threading.Lock()


def _start_drivers(crtp: Any) -> None:
    """Start cflib's drivers once, and keep its own messages off the terminal."""
    with _drivers:
        if not crtp.CLASSES:
            crtp.init_drivers()
        logger = logging.getLogger("cflib")
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())
            logger.propagate = False


def _write(param: Any, name: str, value: float) -> None:
    param.set_value(name, value)
    param.request_param_update(name)  # what the write echoes is not what the firmware holds
