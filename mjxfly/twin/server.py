"""The twin in real time: one thread, two UDP sockets on loopback, physics in between."""

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
MOST_BEHIND = 0.5  # [s] that a twin makes good which was held up; the runner thinks it lost after 0.1 s


@dataclass(frozen=True)
class Truth:
    """What really happens at one moment, whatever the link says."""

    time: float  # [s] of the twin
    state: PairState
    thrust: tuple[int, int]  # [thrust units] that reach the controllers
    pwm: np.ndarray  # (2, 4) of all motors
    last_wire_thrust: tuple[int, int]  # [thrust units] of the last setpoint received
    info: tuple[int, int]


class Twin:
    """Two drones that answer at `uris`. A context manager; `inject` works while it runs."""

    def __init__(self, pair: Pair, ports: tuple[int, int] = (0, 0), cores: tuple[Library, Library] | None = None):
        """`ports` of leader and follower, 0: any free one; `cores`: the apps on board, see `app.host`."""
        self._pair, self._state = pair, pair.start()
        self.start = self._state  # how the pair stands
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
        self.truth = self._seen(0.0)
        self.history: list[Truth] = []  # one in ten steps
        self.failure: BaseException | None = None
        self.behind = self.most_behind = 0.0  # real time, now and ever [s]

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
        """Have a fault come to pass now."""
        with self._lock:
            if one.what == "port":  # the radio task ends while the motors run on: the laptop's datagrams are refused
                self._closed[one.drone] = True
                self._sockets[one.drone].close()
            self.drones[one.drone].inject(one.what)

    def _run(self) -> None:
        try:
            self._loop()
        except BaseException as failure:  # for tests, which look at what ended the twin
            self.failure = failure
            raise

    def _now(self) -> float:
        """Time [s] of the twin."""
        return clock.now() - self._begun

    def _loop(self) -> None:
        """Until it is left, or cannot keep up: one that stood still meanwhile would have the runner blame its links."""
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
        """Sleep until something is due, or until a datagram comes; it is handled at once.

        Requests are answered between the steps: a table of contents is a hundred of them, one after the other.
        """
        alive = [n for n in range(2) if not self._closed[n]]
        try:
            sockets = [self._sockets[n] for n in alive]
            readable, _, _ = select.select(sockets, [], [], clock.real(max(seconds, 0.0)))
        except (OSError, ValueError):
            if not any(self._closed[n] for n in alive):
                raise
            return  # a port was closed just now
        with self._lock:
            for number in alive:
                if self._sockets[number] in readable:
                    self._receive(number, self._now())
                self.drones[number].answer(self._now())
                self._transmit(number, self.drones[number].transmit(self._now()))

    def _receive(self, number: int, now: float) -> None:
        """Take all that has come. It came at `now` [s], to a twin that is late at the time of its step."""
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
        self.truth = self._seen(now)
        for number, drone in enumerate(self.drones):
            self._transmit(number, drone.send(now))

    def _transmit(self, number: int, datagrams: list[bytes]) -> None:
        client = self._clients[number]
        if client is None or self._closed[number]:
            return
        for datagram in datagrams:
            try:
                self._sockets[number].sendto(datagram, client)
            except OSError:  # no one listens any more, or the buffer is full: the radio forgets it too
                return

    def _seen(self, now: float) -> Truth:
        one, other = (drone.firmware for drone in self.drones)
        thrust = one.order.setpoint.thrust, other.order.setpoint.thrust
        last = one.commander.wire_thrust, other.commander.wire_thrust
        return Truth(now, self._state, thrust, self._state.report.pwm, last, (one.info, other.info))
