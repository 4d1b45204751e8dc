"""One drone over cflib. Calls that may block run in separate threads with a deadline.

cflib is imported when a link is opened, so that this module can be imported without it.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from mjxfly import clock, packets
from mjxfly.app.protocol import APP_VARIABLES, Reply, reply_of, sample_of
from mjxfly.connection import PORT, Deadlines, Element, Identity, LinkError, Parameters, connect
from mjxfly.packets import Packet, PacketError
from mjxfly.process import bounded, wait_until
from mjxfly.telemetry import HealthSample, Note, SensedSample, Telemetry

Variable = tuple[str, str | None]  # name and type of a log variable; None: the firmware's type
PROTOCOL = 12  # CRTP version with a supervisor port
LOG_PORT, LOG_DATA = 5, 2
DEADLINES = Deadlines()
ATTEMPTS, REPEAT = 8, 0.25  # of a request, and time limit of each answer [s]
PATIENCE = 4  # attempts to start a log block before it is deleted and created again
QUIET = 0.1  # [s] without anything to send after which a ping is sent
REVISION = ("firmware.revision0", "firmware.revision1", "firmware.modified")


class Link:
    """One drone: receives its state, sends setpoints, commands and parameters. `send` and `command` never block."""

    def __init__(self, uri: str, name: str, note: Note, deadlines: Deadlines = DEADLINES, twin: bool = False):
        """Link to the drone `name` at `uri`. A `twin` must list every variable asked for; firmware need not."""
        self.uri, self.name = uri, name
        self.telemetry = Telemetry()
        self.lost: str | None = None  # why, once the link has ended
        self.overwritten = self.sent = 0  # setpoints replaced before they were sent; packets sent, without poses
        self.identity = Identity()
        self.busy: bool | str = False  # of `write_later`: True while writing, a text if it failed
        self._note, self._deadlines, self._twin = note, deadlines, twin
        self._wake = threading.Condition()
        self._setpoint: Packet | None = None
        self._pose: Packet | None = None
        self._commands: collections.deque[Packet] = collections.deque()
        self._waiting_since: float | None = None
        self._closing = False
        self._block = -1
        self._crazyflie: Any = None
        self._driver: Any = None
        self._sender = threading.Thread(target=self._send_all, name=f"sender {name}", daemon=True)
        self.parameters = Parameters(name, self._element, self._request, deadlines.parameter)

    # Before flight: these block up to their deadlines.

    def open(self, progress: Callable[[str], None] = lambda text: None) -> None:
        """Connect and get both tables of contents, which are cached; `progress` receives messages. Raises LinkError."""
        started = clock.now()
        self._crazyflie = connect(self.uri, self.name, self._deadlines, progress, self._end, self._console)
        self._driver = self._crazyflie.link
        self._sender.start()
        self._crazyflie.add_port_callback(PORT, self.parameters.received)
        self._identify(clock.now() - started)

    def _console(self, text: str) -> None:
        self._note("console", drone=self.name, text=text)

    def _identify(self, seconds: float) -> None:
        """Ask for firmware version and kind of drone, and log them. Raises LinkError if the protocol is too old."""
        answers: dict[int, str] = {}
        both = threading.Event()

        def answered(packet: Any) -> None:
            data = bytes(packet.data)
            if packet.channel == 1 and data[:1] in (b"\x01", b"\x02"):
                answers[data[0]] = data[1:].split(b"\0")[0].decode("ascii", "replace").strip()
                if len(answers) == 2:
                    both.set()

        self._crazyflie.add_port_callback(packets.VERSION.port, answered)
        for request in (packets.VERSION, packets.DEVICE):
            self._request(request)
        both.wait(clock.real(self._deadlines.version))
        self._crazyflie.remove_port_callback(packets.VERSION.port, answered)
        names, began = self.parameters.listed(REVISION), clock.now()
        revision = self.parameters.read(names)
        trip = (clock.now() - began) if names else math.nan
        self.identity = Identity(
            protocol=self._crazyflie.platform.get_protocol_version(),
            version=answers.get(1) or "?",
            device=answers.get(2) or "?",
            revision="".join(f"{int(value):x}" for value in revision.values()) or "?",
        )
        found = dataclasses.asdict(self.identity)
        self._note("connected", drone=self.name, uri=self.uri, seconds=seconds, latency_ms=1000 * trip, **found)
        if self.identity.protocol < PROTOCOL:
            self.close()
            spoken = self.identity.protocol
            raise LinkError(f"{self.name} speaks protocol {spoken}, {PROTOCOL} is needed; update its firmware")

    def _element(self, name: str) -> Element | None:
        found = self._find(self._crazyflie.param, name)
        return None if found is None else Element(found.ident, found.pytype, found.access == found.RO_ACCESS)

    def _find(self, table: Any, name: str) -> Any:
        """cflib's table entry for `name`, None if the firmware lacks it. Raises LinkError if a twin lacks it."""
        found = table.toc.get_element_by_complete_name(name)
        if found is None and self._twin:
            raise LinkError(f"the twin has no {name}, which this flight asks the {self.name} for; a rehearsal needs it")
        return found

    def start_states(self) -> None:
        """Log state, sensed values and health at 100, 50, 20 Hz; wait for one packet of each. Raises LinkError."""
        block = self._log_block("newest", packets.STATE_VARIABLES, 10)
        self._block = block.id
        self._crazyflie.add_header_callback(self._receive, LOG_PORT, LOG_DATA)
        health = self._log_block("health", self._health_variables(), 50)
        health.data_received_cb.add_callback(lambda stamp, values, config: self._take_health(values))
        sensed = self._log_block("sensed", self._listed(packets.SENSED), 20)
        sensed.data_received_cb.add_callback(lambda stamp, values, config: self._take_sensed(values, stamp))
        blocks = [block, health, *([sensed] if sensed.variables else [])]
        if self._crazyflie.log.toc.get_element_by_complete_name(APP_VARIABLES[0][0]) is not None:
            blocks.append(self._log_block("app", APP_VARIABLES, 20))
            blocks[-1].data_received_cb.add_callback(lambda stamp, values, config: self._take_app(values))
        self._start(blocks, lambda title: getattr(self.telemetry, title))

    def _start(self, blocks: Sequence[Any], newest: Callable[[str], Any]) -> None:
        """Start log `blocks` and repeat until each has sent a packet: `newest` of its title. Raises LinkError.

        The firmware drops requests while its queue is full, and cflib does not repeat them. A block that stays silent
        is deleted and created again; only packets that arrive after its deletion then count.
        """
        deadline, old, leaving = clock.now() + self._deadlines.first_state, dict[str, Any](), set[str]()
        for attempt in itertools.count(1):
            for one in [one for one in blocks if one.name in leaving and not one.added]:
                old[one.name] = newest(one.name)
                leaving.remove(one.name)
            silent = [one for one in blocks if one.name in leaving or newest(one.name) is old.get(one.name)]
            if not silent:
                return
            if clock.now() > deadline:
                names = ", ".join(one.name for one in silent[0].variables)
                raise LinkError(f"the {self.name} does not send {names}; switch it off and on again")
            for one in silent:
                if one.added and attempt % PATIENCE == 0:
                    leaving.add(one.name)
                self._ask(one.delete if one.name in leaving else one.start)
            wait_until(lambda: not leaving and all(newest(o.name) is not old.get(o.name) for o in blocks), REPEAT)

    def _listed(self, variables: Iterable[Variable]) -> list[Variable]:
        """Those of `variables` that the firmware lists."""
        table = self._crazyflie.log
        return [(name, kind) for name, kind in variables if self._find(table, name) is not None]

    def _health_variables(self) -> list[Variable]:
        motors = next((names for names in packets.MOTORS if len(self._listed(names)) == len(names)), ())
        return [*packets.VARIANCES, *motors, *self._listed([packets.ACTING_THRUST])]

    def read_logs(self, names: Sequence[str]) -> dict[str, float]:
        """Values of the log variables `names`, without those that the firmware does not list, from one packet.

        Raises LinkError if no packet arrives.
        """
        listed = self._listed([(name, None) for name in names])
        if not listed:
            return {}
        block, packets_of = self._log_block("once", listed, 100), list[dict[str, float]]()
        block.data_received_cb.add_callback(lambda stamp, data, config: packets_of.append(data))
        try:
            self._start([block], lambda _: packets_of[-1] if packets_of else None)
        finally:
            self._ask(block.delete)
        return packets_of[-1]

    def write_parameters(self, values: Mapping[str, float], check: bool = True) -> None:
        """Write each parameter and read it back (see `Parameters.write`). Raises LinkError."""
        self.parameters.write(values, check)
        for name, value in values.items():
            self._note("parameter", drone=self.name, name=name, value=value)

    def write_later(self, values: Mapping[str, float]) -> None:
        """Write parameters in a separate thread, also in flight; `busy` has the state."""

        def write() -> None:
            try:
                self.write_parameters(values)
                self.busy = False
            except LinkError as error:
                self.busy = str(error)

        self.busy = True
        threading.Thread(target=write, daemon=True).start()

    def _log_block(self, title: str, variables: Iterable[Variable], period_ms: int) -> Any:
        from cflib.crazyflie.log import LogConfig

        block = LogConfig(title, period_ms)
        for name, kind in variables:
            block.add_variable(name, kind)
        missing = self._ask(lambda: self._crazyflie.log.add_config(block))
        if missing is not None:
            raise LinkError(f"the firmware of the {self.name} lacks a log variable: {missing}; update it")
        return block

    def _ask(self, request: Callable[[], Any]) -> Any:
        """Call `request` of cflib; return the first argument of an exception that it raised, else None.

        Raises LinkError if it takes too long: sends of cflib on a dying link wait without limit.
        """
        refused: list[Any] = []

        def ask() -> None:
            try:
                request()
            except Exception as error:  # cflib raises many kinds, Exception itself among them
                refused.append(error.args[0] if error.args else type(error).__name__)

        if not bounded(ask, self._deadlines.request):
            text = f"the link to the {self.name} takes no packet within {self._deadlines.request:g} s"
            raise LinkError(f"{text}; is it on and in reach?")
        return refused[0] if refused else None

    def ask_app(self, packet: Packet) -> Reply:
        """Answer of the app on board to `packet`, which is sent up to `ATTEMPTS` times. Raises LinkError."""
        answers: list[Reply] = []
        heard = threading.Event()

        def answered(wire: Any) -> None:
            reply = reply_of(bytes(wire.data)) if wire.channel == packet.channel else None
            if reply is not None and reply.kind == packet.data[0]:
                answers.append(reply)
                heard.set()

        self._crazyflie.add_port_callback(packet.port, answered)
        try:
            for _ in range(ATTEMPTS):
                self._request(packet)
                if heard.wait(clock.real(REPEAT)):
                    return answers[0]
        finally:
            self._crazyflie.remove_port_callback(packet.port, answered)
        raise LinkError(f"the app of the {self.name} does not answer; switch the drone off and on again")

    # In flight: these never block.

    def send(self, packet: Packet) -> None:
        """Send `packet` as the newest setpoint; it replaces one that still waits."""
        with self._queue():
            self.overwritten += self._setpoint is not None
            self._setpoint = packet

    def command(self, packet: Packet) -> None:
        """Queue `packet` ahead of later setpoints; a setpoint that still waits is dropped."""
        with self._queue():
            self._setpoint = None
            if packet == packets.EMERGENCY_STOP:
                self._commands.clear()  # nothing may delay it or fill the queue
            if len(self._commands) < 20:
                self._commands.append(packet)

    def pose(self, packet: Packet) -> None:
        """Send `packet` as the newest measured pose once no command or setpoint waits; it replaces one that waits.

        Waiting poses do not count in `stuck_for`: a busy radio drops them first.
        """
        with self._wake:
            self._pose = packet
            self._wake.notify()

    def _request(self, packet: Packet) -> None:
        """Queue `packet` behind waiting commands; a waiting setpoint is kept."""
        with self._queue():
            self._commands.append(packet)

    @contextlib.contextmanager
    def _queue(self) -> Iterator[None]:
        """Hold the sender's lock to change what waits, then wake the sender."""
        with self._wake:
            yield
            self._waiting_since = self._waiting_since or clock.now()
            self._wake.notify()

    def stuck_for(self, now: float) -> float:
        """Time for which waiting packets could not be sent [s]."""
        since = self._waiting_since
        return 0.0 if since is None else now - since

    def close(self) -> None:
        """Close the link; cflib sends one zero setpoint. Returns after the deadline at the latest."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        if self._crazyflie is None:
            return
        self._crazyflie.incoming.stop()  # ends with the next packet; close_link stops it later and waits 1 s for it
        if not bounded(self._crazyflie.close_link, self._deadlines.close):
            self._note("warning", text=f"the link of the {self.name} did not close in time")

    def _send_all(self) -> None:
        from cflib.crtp.crtpstack import CRTPPacket

        while True:
            with self._wake:
                if not (self._commands or self._setpoint or self._pose or self._closing):
                    self._wake.wait(clock.real(QUIET))
                if self._closing and not self._commands:
                    return
                packet = packets.PING  # the firmware stops its logs if it hears nothing for 1 s
                if self._commands:
                    packet = self._commands.popleft()
                elif self._setpoint is not None:
                    packet, self._setpoint = self._setpoint, None
                elif self._pose is not None:
                    packet, self._pose = self._pose, None
            wire = CRTPPacket()
            wire.set_header(packet.port, packet.channel)
            wire.data = packet.data
            # Not through Crazyflie.send_packet, whose lock stays held if a driver reports an error while sending.
            try:
                self._driver.send_packet(wire)
            except Exception as error:  # whatever a driver raises, the link has ended and the control loop must know
                self._end(f"{type(error).__name__}: {error}")
            self.sent += packet.port != packets.POSE_PORT
            with self._wake:
                waiting = self._commands or self._setpoint
                self._waiting_since = clock.now() if waiting else None

    def _receive(self, packet: Any) -> None:
        """Take a log packet, in cflib's thread; a damaged state is counted and dropped."""
        arrival, data = clock.now(), bytes(packet.data)
        if len(data) < 4 or data[0] != self._block:
            return
        try:
            state = packets.unpack_state(data[4:])
        except PacketError:
            self.telemetry.damaged += 1
            return
        if self.telemetry.take(state, int.from_bytes(data[1:4], "little"), arrival):
            self._note("state", t=arrival, drone=self.name, raw=data.hex())

    def _take_health(self, values: Mapping[str, float]) -> None:
        arrival, health = clock.now(), packets.health_of(values)
        self.telemetry.health = HealthSample(health, arrival)
        self._note("health", t=arrival, drone=self.name, **health._asdict())

    def _take_sensed(self, values: Mapping[str, float], stamp: int) -> None:
        self.telemetry.sensed = SensedSample(packets.sensed_of(values), stamp)

    def _take_app(self, values: Mapping[str, float]) -> None:
        self.telemetry.app = sample_of(values, clock.now())

    def _end(self, why: str) -> None:
        self.lost = self.lost or (why.strip().splitlines() or ["link error"])[0]
        self._note("link", drone=self.name, text=self.lost)
