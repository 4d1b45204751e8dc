"""The twin in real time: one thread that serves two UDP sockets on the loopback and steps the physics."""

from __future__ import annotations

import select
import socket
import threading
from dataclasses import dataclass

import numpy as np

from mjxball.errors import InputError
from mjxfly import clock
from mjxfly.app.host import Library
from mjxfly.twin.conditions import Injection
from mjxfly.twin.drone import TwinDrone, advance
from mjxfly.twin.pair import Pair, PairState

HOST = "127.0.0.1"
PERIOD = 0.005  # of physics, firmware and sockets [s]
MOST_BEHIND = 0.5  # [s] largest delay that the twin catches up with; the runner takes it for lost after 0.1 s


@dataclass(frozen=True)
class Truth:
    """True state of the twin at one time."""

    time: float  # [s] of the twin
    state: PairState
    thrust: tuple[int, int]  # inputs of the controllers [thrust units]
    pwm: np.ndarray  # (2, 4) of all motors
    last_wire_thrust: tuple[int, int]  # [thrust units] of the last setpoint received
    info: tuple[int, int]


class Twin:
    """Two drones that answer at `uris`. A context manager; `inject` works while it runs."""

    def __init__(self, pair: Pair, ports: tuple[int, int] = (0, 0), cores: tuple[Library, Library] | None = None):
        """`ports` of leader and follower, 0 for a free one; `cores`: compiled apps on board, see `app.host`."""
        self._pair, self._state = pair, pair.start()
        self.start = self._state  # initial state
        one, other = cores or (None, None)
        self.drones = TwinDrone(pair, 0, one), TwinDrone(pair, 1, other)
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in ports]
        for sock, port in zip(self._sockets, ports, strict=True):
            try:
                sock.bind((HOST, port))
            except OSError as error:
                raise InputError(f"port {port} cannot be had: {error.strerror}; choose another") from None
            sock.setblocking(False)
        self._clients: list[tuple[str, int] | None] = [None, None]
        self.uris = tuple(f"udp://{HOST}:{sock.getsockname()[1]}" for sock in self._sockets)
        self._closed = [False, False]
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._begun = clock.now()
        self._thread = threading.Thread(target=self._run, name="twin", daemon=True)
        self.truth = self._truth_at(0.0)
        self.history: list[Truth] = []  # every tenth step
        self.failure: BaseException | None = None
        self.behind = self.most_behind = 0.0  # delay to real time, now and largest [s]

    def __enter__(self) -> Twin:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5)
        for sock in self._sockets:
            sock.close()

    @property
    def turning(self) -> bool:
        """Whether any motor turns."""
        return bool(self.truth.pwm.max() > 0)

    def inject(self, one: Injection) -> None:
        """Inject a fault now."""
        with self._lock:
            if one.what == "port":  # the radio task ends while the motors run on: the laptop's datagrams are refused
                self._closed[one.drone] = True
                self._sockets[one.drone].close()
            self.drones[one.drone].inject(one.what)

    def _run(self) -> None:
        try:
            self._loop()
        except BaseException as failure:  # kept for the reader of `failure`, in another thread
            self.failure = failure
            raise

    def _now(self) -> float:
        """Time [s] of the twin."""
        return clock.now() - self._begun

    def _loop(self) -> None:
        """Step until `__exit__`, or until the twin is too late: the runner would report the delay as a link fault."""
        self._begun = clock.now()
        step = 0
        while not self._stop.is_set():
            now, due = self._now(), (step + 1) * PERIOD
            self.behind = max(now - due, 0.0)
            self.most_behind = max(self.most_behind, self.behind)
            if now < due:
                self._wait(min(due, *(drone.next_arrival for drone in self.drones)) - now)
                continue
            if self.behind > MOST_BEHIND:
                self.failure = InputError(clock.too_slow(f"the twin is {self.behind:.2f} s behind"))
                return
            step += 1
            with self._lock:
                for number in range(2):
                    self._receive(number, due)
                self._step(due)
            if step % 10 == 0:
                self.history.append(self.truth)

    def _wait(self, seconds: float) -> None:
        """Sleep for at most `seconds`, or until a datagram arrives, and handle it at once.

        Requests are answered between the steps, since a table of contents takes a hundred requests in sequence.
        """
        alive = [n for n in range(2) if not self._closed[n]]
        try:
            sockets = [self._sockets[n] for n in alive]
            readable, _, _ = select.select(sockets, [], [], clock.real(max(seconds, 0.0)))
        except (OSError, ValueError):
            if not any(self._closed[n] for n in alive):
                raise
            return  # `inject` closed a port meanwhile
        with self._lock:
            for number in alive:
                if self._sockets[number] in readable:
                    self._receive(number, self._now())
                self.drones[number].answer(self._now())
                self._transmit(number, self.drones[number].transmit(self._now()))

    def _receive(self, number: int, now: float) -> None:
        """Read at most 50 waiting datagrams; their arrival time is `now` [s], for a late twin that of its step."""
        for _ in range(50):
            if self._closed[number]:
                return
            try:
                datagram, client = self._sockets[number].recvfrom(2048)
            except (BlockingIOError, ConnectionError):
                return
            self._clients[number] = client
            self.drones[number].receive(datagram, now)

    def _step(self, now: float) -> None:
        self._state = advance(self._pair, self.drones, self._state, now, PERIOD)
        self.truth = self._truth_at(now)
        for number, drone in enumerate(self.drones):
            self._transmit(number, drone.send(now))

    def _transmit(self, number: int, datagrams: list[bytes]) -> None:
        client = self._clients[number]
        if client is None or self._closed[number]:
            return
        for datagram in datagrams:
            try:
                self._sockets[number].sendto(datagram, client)
            except OSError:  # no receiver, or the buffer is full: the datagram is lost, as by radio
                return

    def _truth_at(self, now: float) -> Truth:
        one, other = (drone.firmware for drone in self.drones)
        thrust = one.order.setpoint.thrust, other.order.setpoint.thrust
        last = one.commander.wire_thrust, other.commander.wire_thrust
        return Truth(now, self._state, thrust, self._state.report.pwm, last, (one.info, other.info))
