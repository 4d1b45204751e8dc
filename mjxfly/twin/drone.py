"""One drone of the twin: protocol, firmware, app, faults, and both directions of its link."""

from __future__ import annotations

import functools
import heapq
import itertools
import math
from collections.abc import Iterable

import numpy as np

from mjxball.errors import InputError
from mjxfly.app.host import App, Library, OnboardState
from mjxfly.app.protocol import CONTROLLER, GROUP, OUT_OF_TREE, PID
from mjxfly.packets import ZERO, Setpoint
from mjxfly.twin import avionics
from mjxfly.twin.conditions import BODY_FAULTS, FAULT_KINDS, BodyFault, DroneFaults, FaultEffect, LinkFaults
from mjxfly.twin.firmware import Firmware, Motors, Order
from mjxfly.twin.logs import Readings, Snapshot
from mjxfly.twin.pair import Pair, PairState, SupervisorOutputs
from mjxfly.twin.parameters import ESTIMATOR, KALMAN, OF_APP, PARAMETERS
from mjxfly.twin.positioning import DECKS
from mjxfly.twin.protocol import Peer

GRAVITY = 9.81  # [m/s2]
BEAT = 2  # periods of an app between two heartbeats
# Parameters of the supervisor: attribute of `FirmwareSupervisor`, and factor to its unit.
SUPERVISOR = {
    "supervisor.prefltTimeout": ("preflight_time", 1e-3),
    "supervisor.landedTimeout": ("landed_time", 1e-3),
    "supervisor.tmblChckEn": ("tumble_check", 1.0),
    "supervisor.crashDetectGs": ("crash_force", 1.0),
    "stabilizer.stop": ("stopped", 1.0),
}
# Parameters with an effect on the twin; the others are only stored.
ACTED = avionics.ACTED | SUPERVISOR.keys() | {CONTROLLER} | {one.name for one in OF_APP if not one.read_only}


def only_kept(names: Iterable[str]) -> list[str]:
    """Return those of `names` that the twin stores without an effect."""
    return sorted({one.name for one in PARAMETERS}.intersection(names) - ACTED)


class TwinDrone:
    """A drone at one address. One thread calls `receive`, `step` and `send`."""

    def __init__(self, pair: Pair, number: int, core: Library | None = None):
        """Drone `number` (0 leader, 1 follower) of `pair`; `core`: the compiled app on board, if any."""
        self._pair, self.number = pair, number
        self._random = np.random.default_rng([pair.surroundings.seed, number])
        self.firmware = Firmware(pair.kind, phase=float(self._random.random()))
        self._core = core
        self._deck = DECKS.get(pair.surroundings.positioning)
        self.app = self._new_app()
        self.peer = self._new_peer()
        self.link, self.faults = LinkFaults(), DroneFaults()
        self.up, self.down = Channel(self._random), Channel(self._random)
        self._now = self._stamp = self._booted = 0.0  # [s]
        self._readings: Readings | None = None

    def _new_peer(self) -> Peer:
        return Peer(
            self.firmware,
            self._on_parameter,
            functools.partial(self._pair.receive_pose, self.number),
            self.app,
            ({ESTIMATOR: KALMAN} if self._pair.surroundings.deck else {})
            | dict(self._deck.parameters if self._deck else {}),
        )

    def _new_app(self) -> App | None:
        self.beat = b""  # heartbeat in transit to the other drone
        self._ticks, self._next_tick, self._app_ran = 0, 0.0, False
        self._app_state = OnboardState()  # set by the out-of-tree controller, the only access of an app to the estimate
        return None if self._core is None else App(self._core, self.number)

    def _on_parameter(self, name: str, value: float) -> None:
        if name in SUPERVISOR:
            field, factor = SUPERVISOR[name]
            setattr(self.firmware.supervisor, field, value * factor)
        if self.app is not None and name.startswith(f"{GROUP}."):
            self.app.set(name.removeprefix(f"{GROUP}."), value)
        self._pair.set_parameter(self.number, name, value)

    @property
    def controller(self) -> int:
        """Value of the parameter stabilizer.controller."""
        return int(self.peer.values[CONTROLLER])

    def receive(self, datagram: bytes, now: float) -> None:
        """Put a datagram of the laptop into the link."""
        self.up.push(datagram, now, self.link, self.link.silent_up, self._pair.surroundings.delay)

    @property
    def next_arrival(self) -> float:
        """Time of the next datagram that leaves the link, in either direction [s]."""
        return min(self.up.next, self.down.next)

    @property
    def _silent(self) -> bool:
        return self.faults.stopped or self.firmware.dead or self.firmware.booting

    def inject(self, what: FaultEffect) -> None:
        """Inject a fault; "port" is handled by the server. Raises InputError for what is no fault."""
        match what:
            case LinkFaults():
                self.link = what
            case DroneFaults():
                self.faults = what
            case BodyFault(part, value) if part in BODY_FAULTS:
                self._pair.disturb(self.number, part, value)
            case "crash":  # the firmware detects a crash: motors off
                self.firmware.supervisor.crash()
            case "power":  # motors off, no answers at all
                self.firmware.dead = True
                self.link = LinkFaults(silent_up=True, silent_down=True)
            case "reboot":
                self.reboot()
            case "port":
                pass
            case _:
                raise InputError(f"{what!r} is no fault; expected FAULT_KINDS[kind].what of {', '.join(FAULT_KINDS)}")

    def answer(self, now: float) -> None:
        """Handle the datagrams that have arrived by `now` [s]."""
        for due, datagram in self.up.due(now):
            for reply in [] if self._silent else self.peer.receive(datagram, due):
                self._reply(reply, due)

    def step(self, state: PairState, now: float) -> Order:
        """Handle arrived datagrams, run the app and the firmware; return the controller's input."""
        self._now = now
        self.answer(now)
        report, number, faults = state.report, self.number, self.faults
        hung = faults.stopped or faults.stabilizer_dead
        if not (faults.stopped or self.firmware.dead or self.firmware.booting):
            self._run_app(state, now)
        before = self.firmware.supervisor
        acceleration = (report.acceleration[number] / GRAVITY).tolist()
        order = self.firmware.step(now, acceleration, report.pwm[number].tolist(), hung, faults.restarts)
        if self.controller not in (PID, OUT_OF_TREE):
            order = self.firmware.order = Order(ZERO, Motors.OFF)
        if self.firmware.supervisor is not before:
            self._reset(now)
        if not faults.clock_stopped:
            self._stamp = now - self._booted
        frozen = faults.frozen or (hung and order.motors is Motors.HELD)
        if not frozen or self._readings is None:
            self._readings = Readings(self._snapshot(state))
        elif not hung:
            self._readings = Readings(self._readings.snapshot._replace(info=self.firmware.info))
        return order

    def _run_app(self, state: PairState, now: float) -> None:
        """Run one period of the app, if it is due: the app takes the newest estimate and sends a setpoint."""
        if self.app is None or now < self._next_tick - 1e-9:
            return
        self._next_tick = max(self._next_tick, now - 1e-9) + self.app.period / 1000
        snapshot = self._readings.snapshot if self.faults.frozen and self._readings else self._snapshot(state)
        report, number, estimate, clock = snapshot.report, self.number, self._app_state, round(1000 * now)
        if self.controller == OUT_OF_TREE and not self.faults.stabilizer_dead:
            estimate.position[:], estimate.velocity[:] = snapshot.position.tolist(), report.velocity[number].tolist()
            estimate.quaternion[:] = report.quaternion[number].tolist()
            estimate.rates[:], estimate.time = report.rates[number].tolist(), clock
        estimate.variance[:] = report.variance[number][:3].tolist()
        estimate.voltage, estimate.can_fly = snapshot.voltage, self.firmware.supervisor.can_fly
        wanted = self.app.tick(estimate, clock)
        if wanted.active:
            self.firmware.commander.from_app(Setpoint(wanted.roll, wanted.pitch, 0.0, int(wanted.thrust)), now)
        elif self._app_ran:
            self.firmware.commander.relax()
        self._app_ran = wanted.active
        if self._ticks % BEAT == 0:
            self.beat = self.app.send()
        self._ticks += 1

    def hear(self, beat: bytes, now: float) -> None:
        """Deliver a heartbeat of the other drone's app, unless the link loses it."""
        lost = self.link.loss and self._random.random() < self.link.loss
        if self.app is not None and not self._silent and not lost:
            self.app.hear(beat, round(1000 * now))

    def _snapshot(self, state: PairState) -> Snapshot:
        position = state.report.position[self.number] + np.array(self.faults.offset)
        voltage = float(state.battery[self.number]) + self.faults.battery
        setpoint = self.firmware.order.setpoint
        logged = {} if self.app is None else self.app.logged()
        deck = {} if self._deck is None else self._deck.logged
        return Snapshot(state.report, self.number, setpoint, self.firmware.info, voltage, position, logged, deck)

    def send(self, now: float) -> list[bytes]:
        """Queue the log data that is due; return the datagrams that reach the laptop by `now` [s]."""
        if self._readings is not None and not self._silent and self.peer.logs.is_due(now):
            for datagram in self.peer.log_data(self._readings, now):
                stamp = (int(self._stamp * 1000 + 1e-6) & 0xFFFFFF).to_bytes(3, "little")
                self._reply(datagram[:2] + stamp + datagram[5:], now)
        for _ in range(int(self._random.poisson(self.faults.garbage)) if self.faults.garbage else 0):
            self._reply(garbage(self._random), now)
        return self.transmit(now)

    def transmit(self, now: float) -> list[bytes]:
        """Return the datagrams that have passed the link to the laptop by `now` [s]."""
        return [datagram for _, datagram in self.down.due(now)]

    def _reply(self, datagram: bytes, now: float) -> None:
        self.down.push(datagram, now, self.link, self.link.silent_down, self._pair.surroundings.delay)

    def reboot(self) -> None:
        """Power off and on: log blocks and parameters are reset."""
        self.firmware.reboot(self._now)
        self._reset(self._now)

    def _reset(self, now: float) -> None:
        self.app = self._new_app()
        self.peer = self._new_peer()
        self._booted = now
        self.faults = DroneFaults()
        for name, value in self.peer.values.defaults.items():
            self._pair.set_parameter(self.number, name, value)
        self._pair.set_parameter(self.number, "kalman.resetEstimation", 1.0)


class Channel:
    """One direction of a link, with delay, jitter and loss."""

    def __init__(self, random: np.random.Generator):
        self._random = random
        self._waiting: list[tuple[float, int, bytes]] = []
        self._count = itertools.count()

    def push(self, datagram: bytes, now: float, faults: LinkFaults, silent: bool, delay: float = 0.0) -> None:
        """Send a datagram at `now` [s]; `delay` [s] is added to that of `faults`."""
        if silent or (faults.loss and self._random.random() < faults.loss):
            return
        due = now + faults.delay + delay
        if faults.jitter:
            due += faults.jitter * self._random.random()
        heapq.heappush(self._waiting, (due, next(self._count), datagram))

    def due(self, now: float) -> list[tuple[float, bytes]]:
        """Remove and return the datagrams that arrive by `now` [s], in order, each with its time [s]."""
        out = []
        while self._waiting and self._waiting[0][0] <= now + 1e-9:
            due, _, datagram = heapq.heappop(self._waiting)
            out.append((due, datagram))
        return out

    @property
    def next(self) -> float:
        """Arrival time of the next datagram [s]."""
        return self._waiting[0][0] if self._waiting else math.inf


def garbage(random: np.random.Generator) -> bytes:
    """Return a datagram of random bytes; half of them start with a valid port."""
    size = int(random.integers(0, 40))
    data = bytearray(random.integers(0, 256, size, dtype=np.uint8).tobytes())
    if size and random.random() < 0.5:
        port, channel = random.choice([0, 2, 3, 4, 5, 7, 9, 13, 15]), random.integers(0, 4)
        data[0] = int(port) << 4 | 0x0C | int(channel)
    return bytes(data)


def advance(pair: Pair, drones: tuple[TwinDrone, TwinDrone], state: PairState, now: float, dt: float) -> PairState:
    """Step both drones at `now` [s], then the physics by `dt` [s]; return the new state."""
    one, other = drones[0].step(state, now), drones[1].step(state, now)
    for drone, peer in (drones, drones[::-1]):
        if drone.beat and not drone.faults.peer_silent:
            peer.hear(drone.beat, now)
        drone.beat = b""
    modes = SupervisorOutputs(
        run=(one.motors is not Motors.OFF, other.motors is not Motors.OFF),
        held=(one.motors is Motors.HELD, other.motors is Motors.HELD),
        flying=(one.flying, other.flying),
    )
    return pair.advance(np.array([one.setpoint, other.setpoint], float), dt, modes)
