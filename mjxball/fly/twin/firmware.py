"""What one drone's firmware lets through to its controller: commander and supervisor together, and their faults."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

from mjxball.fly.packets import ZERO, Setpoint
from mjxball.fly.twin.commander import Commander
from mjxball.fly.twin.kind import DELIVERED, DroneKind
from mjxball.fly.twin.supervisor import AIRBORNE, PERIOD, Phase, Supervisor

BOOT_TIME = 1.0  # [s] from power on until the first setpoint can be executed
LEVEL = (0.0, 0.0, 1.0)  # [g] what the accelerometer shows at rest
STILL = (0.0, 0.0, 0.0, 0.0)
WATCHDOG = 0.35  # [s] after which the microcontroller's own watchdog restarts a program that hangs


class Motors(enum.Enum):
    """What drives the motors."""

    RUN = "run"  # the controller, at idle at least
    OFF = "off"
    HELD = "held"  # nothing: their PWM stays as it is


class Order(NamedTuple):
    """What reaches the controller of one drone."""

    setpoint: Setpoint = ZERO
    motors: Motors = Motors.RUN
    flying: bool = False  # by the supervisor, for the estimator


class Firmware:
    """Time and measurements come in, an order for the controller comes out."""

    def __init__(self, kind: DroneKind = DELIVERED, now: float = 0.0, phase: float = 0.0):
        """`phase` 0 .. 1 is where in its period of 40 ms the supervisor is at `now` [s]."""
        self.kind = kind
        self._next_look = now + (1.0 - phase) * PERIOD
        self._start(now, booted=True)

    def _start(self, now: float, booted: bool) -> None:
        self.supervisor = Supervisor(self.kind, now, booted)
        self.commander = Commander(now)
        self.order = Order(ZERO, Motors.RUN if self.supervisor.motors_allowed else Motors.OFF)
        self.dead = False  # without power
        self.booting_until = -math.inf
        self._hung_since: float | None = None

    def reboot(self, now: float) -> None:
        """Power on at `now` [s]: everything is forgotten."""
        self._start(now, booted=False)
        self.booting_until = now + BOOT_TIME
        self._next_look = self.booting_until

    def step(
        self,
        now: float,
        acceleration: Sequence[float] = LEVEL,
        pwm: Sequence[float] = STILL,
        hung: bool = False,
        restarts: bool = True,
    ) -> Order:
        """The order at `now` [s]; measured `acceleration` (3,) [g], `pwm` (4,) of the motors.

        `hung`: the stabilizer does not run. The microcontroller's watchdog ends that, and the program `restarts`.
        """
        if self.dead:
            return self._give(Order(ZERO, Motors.OFF))
        if hung:
            return self._hang(now, restarts)
        self._hung_since = None
        if now < self.booting_until:
            return self._give(Order(ZERO, Motors.OFF))
        self.commander.poll(now, self.supervisor.can_fly)
        while now >= self._next_look - 1e-9:
            self.supervisor.look(now, self.commander.age(now), pwm, acceleration)
            self._next_look += PERIOD
        phase = self.supervisor.phase
        flown = self.commander.setpoint if self.supervisor.can_fly else ZERO
        if phase is Phase.LEVEL_OUT:
            flown = Setpoint(0.0, 0.0, 0.0, flown.thrust)
        motors = Motors.RUN if self.supervisor.motors_allowed else Motors.OFF
        return self._give(Order(flown, motors, phase in AIRBORNE))

    def _hang(self, now: float, restarts: bool) -> Order:
        if self._hung_since is None:
            self._hung_since = now
        if now - self._hung_since < WATCHDOG:
            return self._give(self.order._replace(motors=Motors.HELD))
        if restarts:
            self.reboot(now)
        else:
            self.dead = True
        return self._give(Order(ZERO, Motors.OFF))

    def _give(self, order: Order) -> Order:
        self.order = order
        return order

    @property
    def info(self) -> int:
        """Bits of supervisor.info."""
        return self.supervisor.info

    @property
    def armed(self) -> bool:
        """True if the supervisor has armed it."""
        return self.supervisor.armed

    @property
    def locked(self) -> bool:
        """True until it is rebooted."""
        return self.supervisor.phase is Phase.LOCKED

    @property
    def booting(self) -> bool:
        """True between power on and the first look."""
        return self.supervisor.phase is Phase.UNKNOWN
