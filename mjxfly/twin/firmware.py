"""Firmware of one drone between radio and controller: commander, supervisor, boot, and hangs with watchdog restart."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

from mjxfly.packets import ZERO, Setpoint
from mjxfly.twin.arming import AIRBORNE, PERIOD, ArmingPhase, FirmwareSupervisor
from mjxfly.twin.conditions import DELIVERED, DroneKind

THRUST_FLOOR, THRUST_CEILING = 1000, 60000  # [thrust units] below: motors off; above: clipped
PLANNER_PERIOD = 0.01  # [s] of the high-level commander, whose planner is idle here and requests motors off
UNSET, PLANNER, LAPTOP, APP = 0, 1, 2, 3  # priority by the sender of the setpoint
WORST_ANGLE = 30.0  # [deg] substitute for an angle that is not finite, to which the real controller reacts with a jerk


class Commander:
    """Commander of one drone: thrust lock, priorities, the newest setpoint."""

    def __init__(self, now: float = 0.0) -> None:
        self.setpoint, self.time = ZERO, now
        self.priority = UNSET
        self._locked = True
        self._planned = -math.inf
        self.wire_thrust = 0  # of the last setpoint received, executed or not

    def receive(self, value: Setpoint, now: float) -> None:
        """Handle a setpoint on port 3, of any values. After boot, thrust stays 0 until a setpoint of thrust 0 came."""
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
        """Handle a setpoint of an app on board: no thrust lock, and a higher priority than the laptop's."""
        self._take(value, now, APP)

    def stop(self, now: float) -> None:
        """Handle a stop on port 7: motors off; the thrust lock stays open."""
        self.wire_thrust = 0
        self._take(ZERO, now, LAPTOP)

    def relax(self) -> None:
        """Handle the end of the laptop's setpoints on port 7: the planner takes over."""
        self.priority = PLANNER

    def poll(self, now: float, can_fly: bool) -> None:
        """Run the idle planner: it renews a setpoint with motors off."""
        if can_fly and self.priority <= PLANNER and now - self._planned >= PLANNER_PERIOD:
            self._planned = now
            self._take(ZERO, now, PLANNER)

    def age(self, now: float) -> float:
        """Age of the setpoint [s]."""
        return now - self.time

    def _take(self, value: Setpoint, now: float, priority: int) -> None:
        if priority >= self.priority:
            self.setpoint, self.time, self.priority = value, now, priority


BOOT_TIME = 1.0  # [s] from power on until the first setpoint can be executed
LEVEL = (0.0, 0.0, 1.0)  # [g] accelerometer at rest
STILL = (0.0, 0.0, 0.0, 0.0)
WATCHDOG = 0.35  # [s] timeout of the microcontroller's watchdog


class Motors(enum.Enum):
    """State of the motors."""

    RUN = "run"  # driven by the controller, at idle at least
    OFF = "off"
    HELD = "held"  # PWM frozen, because the program hangs


class Order(NamedTuple):
    """Input of one drone's controller."""

    setpoint: Setpoint = ZERO
    motors: Motors = Motors.RUN
    flying: bool = False  # the supervisor's flag, an input of the estimator


class Firmware:
    """State machine of one drone's firmware: `step` maps time and measurements to the controller's input."""

    def __init__(self, kind: DroneKind = DELIVERED, now: float = 0.0, phase: float = 0.0):
        """`phase` 0 .. 1: position of `now` [s] within the supervisor's period of 40 ms."""
        self.kind = kind
        self._next_update = now + (1.0 - phase) * PERIOD
        self._start(now, booted=True)

    def _start(self, now: float, booted: bool) -> None:
        self.supervisor = FirmwareSupervisor(self.kind, now, booted)
        self.commander = Commander(now)
        self.order = Order(ZERO, Motors.RUN if self.supervisor.motors_allowed else Motors.OFF)
        self.dead = False  # without power
        self.booting_until = -math.inf
        self._hung_since: float | None = None

    def reboot(self, now: float) -> None:
        """Reset everything as at power on at `now` [s]."""
        self._start(now, booted=False)
        self.booting_until = now + BOOT_TIME
        self._next_update = self.booting_until

    def step(
        self,
        now: float,
        acceleration: Sequence[float] = LEVEL,
        pwm: Sequence[float] = STILL,
        hung: bool = False,
        restarts: bool = True,
    ) -> Order:
        """Return the controller's input at `now` [s]; measured `acceleration` (3,) [g], `pwm` (4,) of the motors.

        `hung`: the stabilizer does not run. The watchdog ends that: the program `restarts`, or its motors stay off.
        """
        self.order = self._hang(now, restarts) if hung and not self.dead else self._run(now, acceleration, pwm)
        return self.order

    def _run(self, now: float, acceleration: Sequence[float], pwm: Sequence[float]) -> Order:
        self._hung_since = None
        if self.dead or now < self.booting_until:
            return Order(ZERO, Motors.OFF)
        self.commander.poll(now, self.supervisor.can_fly)
        while now >= self._next_update - 1e-9:
            self.supervisor.look(now, self.commander.age(now), pwm, acceleration)
            self._next_update += PERIOD
        phase = self.supervisor.phase
        setpoint = self.commander.setpoint if self.supervisor.can_fly else ZERO
        if phase is ArmingPhase.LEVEL_OUT:
            setpoint = Setpoint(0.0, 0.0, 0.0, setpoint.thrust)
        motors = Motors.RUN if self.supervisor.motors_allowed else Motors.OFF
        return Order(setpoint, motors, phase in AIRBORNE)

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
        """Log variable supervisor.info, a bit field."""
        return self.supervisor.info

    @property
    def locked(self) -> bool:
        """True if only a reboot lets the motors run again."""
        return self.supervisor.phase is ArmingPhase.LOCKED

    @property
    def booting(self) -> bool:
        """True between power on and the supervisor's first update."""
        return self.supervisor.phase is ArmingPhase.UNKNOWN
