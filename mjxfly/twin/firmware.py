"""What one drone's firmware lets through to its controller: commander and supervisor together, and their faults."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

from mjxfly.packets import ZERO, Setpoint
from mjxfly.twin.arming import AIRBORNE, PERIOD, Phase, Supervisor
from mjxfly.twin.conditions import DELIVERED, DroneKind

THRUST_FLOOR, THRUST_CEILING = 1000, 60000  # [thrust units] below: motors stand still; above: cut
PLANNER_PERIOD = 0.01  # [s] of the high-level commander, whose planner never flies here: it asks for motors off
UNSET, PLANNER, LAPTOP, APP = 0, 1, 2, 3  # priorities of who sent the setpoint
WORST_ANGLE = 30.0  # [deg] in place of a number that is not finite: the real controller takes such a one as a kick


class Commander:
    """Thrust lock, priorities and the newest setpoint of one drone."""

    def __init__(self, now: float = 0.0) -> None:
        self.setpoint, self.time = ZERO, now
        self.priority = UNSET
        self._locked = True
        self._planned = -math.inf
        self.wire_thrust = 0  # of the last setpoint received, whatever became of it

    def receive(self, value: Setpoint, now: float) -> None:
        """Port 3: a setpoint of any values. After boot, thrust is 0 until a setpoint of thrust 0 came."""
        if self.priority == UNSET:
            self._locked = True
        if value.thrust == 0:
            self._locked = False
        self.wire_thrust = value.thrust
        thrust = 0 if self._locked or value.thrust < THRUST_FLOOR else min(value.thrust, THRUST_CEILING)
        angles = (part if math.isfinite(part) else WORST_ANGLE for part in value[:3])
        roll, pitch, yaw_rate = (min(max(part, -180.0), 180.0) for part in angles)
        self._take(Setpoint(roll, pitch, yaw_rate, thrust), now, LAPTOP)

    def from_app(self, value: Setpoint, now: float) -> None:
        """A setpoint of an app on board: no thrust lock, and before the laptop's."""
        self._take(value, now, APP)

    def stop(self, now: float) -> None:
        """Port 7, stop: a setpoint that turns the motors off; the thrust lock stays open."""
        self.wire_thrust = 0
        self._take(ZERO, now, LAPTOP)

    def relax(self) -> None:
        """Port 7, the laptop's setpoints end here: the planner takes over."""
        self.priority = PLANNER

    def poll(self, now: float, can_fly: bool) -> None:
        """What the planner does: its setpoints never grow old, and turn the motors off."""
        if can_fly and self.priority <= PLANNER and now - self._planned >= PLANNER_PERIOD:
            self._planned = now
            self._take(ZERO, now, PLANNER)

    def age(self, now: float) -> float:
        """Of the setpoint [s]."""
        return now - self.time

    def _take(self, value: Setpoint, now: float, priority: int) -> None:
        if priority >= self.priority:
            self.setpoint, self.time, self.priority = value, now, priority


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
        self.order = self._hang(now, restarts) if hung and not self.dead else self._run(now, acceleration, pwm)
        return self.order

    def _run(self, now: float, acceleration: Sequence[float], pwm: Sequence[float]) -> Order:
        self._hung_since = None
        if self.dead or now < self.booting_until:
            return Order(ZERO, Motors.OFF)
        self.commander.poll(now, self.supervisor.can_fly)
        while now >= self._next_look - 1e-9:
            self.supervisor.look(now, self.commander.age(now), pwm, acceleration)
            self._next_look += PERIOD
        phase = self.supervisor.phase
        flown = self.commander.setpoint if self.supervisor.can_fly else ZERO
        if phase is Phase.LEVEL_OUT:
            flown = Setpoint(0.0, 0.0, 0.0, flown.thrust)
        motors = Motors.RUN if self.supervisor.motors_allowed else Motors.OFF
        return Order(flown, motors, phase in AIRBORNE)

    def _hang(self, now: float, restarts: bool) -> Order:
        if self._hung_since is None:
            self._hung_since = now
        if now - self._hung_since < WATCHDOG:
            return self.order._replace(motors=Motors.HELD)
        if restarts:
            self.reboot(now)
        else:
            self.dead = True
        return Order(ZERO, Motors.OFF)

    @property
    def info(self) -> int:
        """Bits of supervisor.info."""
        return self.supervisor.info

    @property
    def locked(self) -> bool:
        """True until it is rebooted."""
        return self.supervisor.phase is Phase.LOCKED

    @property
    def booting(self) -> bool:
        """True between power on and the first look."""
        return self.supervisor.phase is Phase.UNKNOWN
