"""The firmware's supervisor: a state machine, updated 25 times a second, that decides whether motors may run.

Behaviour of bitcraze/crazyflie-firmware 2026.08. Times are arguments, in seconds of the drone's clock.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from mjxfly import packets
from mjxfly.twin.conditions import DroneKind

PERIOD = 0.04  # [s] of updates
FLYING_KEPT = 2.0  # [s] it counts as flying after a motor was last above idle
LEVEL_AFTER, LOCK_AFTER = 0.5, 2.0  # [s] without a setpoint until it levels out, until it locks
LANDED_TIME, PREFLIGHT_TIME = 3.0, 30.0  # [s] until it resets after landing; until it disarms on the ground
KEEPALIVE_TIME = 1.0  # [s] longest pause between keepalives of the emergency stop, once they have begun
TILTED, TILTED_TIME = 0.5, 1.0  # tilted if acc.z [g] is lower; [s] until that counts as tumbled
INVERTED, INVERTED_TIME = -0.2, 0.1  # the same for upside down
FREE_FALL = 0.1  # [g] largest reading of every accelerometer axis in free fall
TRAJECTORY_FINISHED = 0x200  # info bit of the high-level commander, which is not simulated


class ArmingPhase(enum.Enum):
    """States of the supervisor."""

    UNKNOWN = "not initialised"
    CHECKS_FAILED = "pre-flight checks not passed"
    CHECKS_PASSED = "pre-flight checks passed"
    ARMING = "arming"
    READY = "ready to fly"
    FLYING = "flying"
    LANDED = "landed"
    RESET = "reset"
    LEVEL_OUT = "warning, level out"
    STOPPED = "exception"
    LOCKED = "locked"
    CRASHED = "crashed"


CAN_FLY = (ArmingPhase.READY, ArmingPhase.FLYING, ArmingPhase.LEVEL_OUT, ArmingPhase.LANDED)
MAY_RUN = (*CAN_FLY, ArmingPhase.ARMING)
AIRBORNE = (ArmingPhase.FLYING, ArmingPhase.LEVEL_OUT)


class Conditions(NamedTuple):
    """Conditions that one update finds; inputs of the transitions."""

    armed: bool
    flying: bool
    tumbled: bool
    silent: bool  # setpoint older than LEVEL_AFTER
    timed_out: bool  # older than LOCK_AFTER
    emergency: bool
    crashed: bool
    waited: bool  # armed on the ground for PREFLIGHT_TIME
    landed: bool  # for LANDED_TIME


Test = Callable[[Conditions], bool]
# Transitions of each phase: the first test that is true selects the next phase; with none the phase stays.
TRANSITIONS: dict[ArmingPhase, tuple[tuple[Test, ArmingPhase], ...]] = {
    ArmingPhase.UNKNOWN: ((lambda now: True, ArmingPhase.CHECKS_FAILED),),
    ArmingPhase.CHECKS_FAILED: (
        (lambda now: now.emergency, ArmingPhase.STOPPED),
        (lambda now: not now.tumbled, ArmingPhase.CHECKS_PASSED),
    ),
    ArmingPhase.CHECKS_PASSED: (
        (lambda now: now.emergency, ArmingPhase.STOPPED),
        (lambda now: now.tumbled, ArmingPhase.CHECKS_FAILED),
        (lambda now: now.armed, ArmingPhase.ARMING),
    ),
    ArmingPhase.ARMING: (
        (lambda now: now.emergency, ArmingPhase.STOPPED),
        (lambda now: now.tumbled or not now.armed, ArmingPhase.CHECKS_FAILED),
        (lambda now: True, ArmingPhase.READY),
    ),
    ArmingPhase.READY: (
        (lambda now: now.emergency, ArmingPhase.STOPPED),
        (lambda now: now.tumbled or now.waited or not now.armed, ArmingPhase.CHECKS_FAILED),
        (lambda now: now.flying, ArmingPhase.FLYING),
    ),
    ArmingPhase.FLYING: (
        (lambda now: now.timed_out or now.emergency, ArmingPhase.STOPPED),
        (lambda now: now.tumbled, ArmingPhase.CRASHED),
        (lambda now: not now.armed, ArmingPhase.RESET),
        (lambda now: now.silent, ArmingPhase.LEVEL_OUT),
        (lambda now: not now.flying, ArmingPhase.LANDED),
    ),
    ArmingPhase.LANDED: (
        (lambda now: now.landed or not now.armed, ArmingPhase.RESET),
        (lambda now: now.flying, ArmingPhase.FLYING),
    ),
    ArmingPhase.RESET: ((lambda now: True, ArmingPhase.CHECKS_FAILED),),
    # Motors that are off do not end this phase: a drone whose laptop falls silent within 2 s of the last thrust locks.
    ArmingPhase.LEVEL_OUT: (
        (lambda now: now.timed_out or now.tumbled or now.emergency, ArmingPhase.STOPPED),
        (lambda now: not now.silent, ArmingPhase.FLYING),
    ),
    ArmingPhase.STOPPED: ((lambda now: True, ArmingPhase.LOCKED),),
    ArmingPhase.LOCKED: (),
    ArmingPhase.CRASHED: (
        (lambda now: not (now.crashed or now.tumbled), ArmingPhase.CHECKS_FAILED),
        (lambda now: now.emergency, ArmingPhase.LOCKED),
    ),
}


def after(phase: ArmingPhase, now: Conditions) -> ArmingPhase:
    """Return the phase that follows `phase` under the conditions `now`."""
    return next((new for test, new in TRANSITIONS[phase] if test(now)), phase)


class FirmwareSupervisor:
    """Supervisor of one drone; `look`, its update, is called every `PERIOD`."""

    def __init__(self, kind: DroneKind, now: float = 0.0, booted: bool = True):
        """Start at `now` [s], with its checks passed if `booted`, else before its first update."""
        self.kind = kind
        self.phase = ArmingPhase.UNKNOWN
        self.armed = self.crashed = self.emergency = self.tumbled = False
        self.stopped = 0.0  # parameter stabilizer.stop: an emergency while it is not 0
        self.tumble_check = 1.0
        self.crash_force = 0.0  # [g] deviation of the acceleration from 1 g that counts as tumbled; 0: off
        self.keepalive: float | None = None
        self.preflight_time, self.landed_time = PREFLIGHT_TIME, LANDED_TIME
        self._thrust_time: float | None = None
        self._tumble_time: float | None = None
        self._ready_since = self._landed_since = now
        if booted:
            self._enter(ArmingPhase.CHECKS_PASSED, now)
            if kind.auto_arm:
                self._enter(ArmingPhase.READY, now)
        self.info = self._bits()

    @property
    def can_fly(self) -> bool:
        """True in phases that execute setpoints."""
        return self.phase in CAN_FLY

    @property
    def motors_allowed(self) -> bool:
        """True in phases in which the motors turn, at idle at least."""
        return self.phase in MAY_RUN

    def request_arming(self, wanted: bool) -> bool:
        """Arm or disarm; return whether the drone is in the `wanted` state."""
        if wanted and not self.armed and self.phase is not ArmingPhase.CHECKS_PASSED:
            return False
        self.armed = wanted
        return True

    def crash(self) -> None:
        """Enter the crashed phase, as after a tumble in flight."""
        self._enter(ArmingPhase.CRASHED, self._ready_since)

    def recover(self) -> bool:
        """Clear a crash; return false while the drone is still tumbled."""
        if self.crashed and self.tumbled:
            return False
        self.crashed = False
        return True

    def look(self, now: float, age: float, pwm: Sequence[float], acceleration: Sequence[float]) -> None:
        """Update at `now` [s] by the setpoint's `age` [s], the motors' `pwm` (4,), measured `acceleration` (3,) [g]."""
        if max(pwm) > self.kind.idle:
            self._thrust_time = now
        flying = self._thrust_time is not None and now - self._thrust_time < FLYING_KEPT
        self.tumbled = self._tumbling(now, *acceleration) and bool(self.tumble_check)
        expired = self.keepalive is not None and now >= self.keepalive + KEEPALIVE_TIME
        found = Conditions(
            armed=self.armed,
            flying=flying,
            tumbled=self.tumbled,
            silent=age > LEVEL_AFTER,
            timed_out=age > LOCK_AFTER,
            emergency=self.emergency or expired or bool(self.stopped),
            crashed=self.crashed,
            waited=self.phase is ArmingPhase.READY and now - self._ready_since > self.preflight_time,
            landed=now - self._landed_since > self.landed_time,
        )
        new = after(self.phase, found)
        if new is not self.phase:
            self._enter(new, now)
        self.info = self._bits()

    def _enter(self, phase: ArmingPhase, now: float) -> None:
        self.phase = phase
        if phase is ArmingPhase.READY:
            self._ready_since = now
        if phase is ArmingPhase.LANDED:
            self._landed_since = now
        if phase is ArmingPhase.CRASHED:
            self.crashed = True
        if phase not in MAY_RUN:
            self.armed = False
        if phase is ArmingPhase.CHECKS_PASSED and self.kind.auto_arm:
            self.armed = True

    def _tumbling(self, now: float, x: float, y: float, z: float) -> bool:
        if 0 < self.crash_force < abs(math.hypot(x, y, z) - 1.0):
            return True
        if abs(x) < FREE_FALL and abs(y) < FREE_FALL and abs(z) < FREE_FALL:
            self._tumble_time = None
        if z >= TILTED:
            self._tumble_time = None
            return False
        if self._tumble_time is None:
            self._tumble_time = now
        lasted = now - self._tumble_time
        return lasted > TILTED_TIME or (z < INVERTED and lasted > INVERTED_TIME)

    def _bits(self) -> int:
        bits = {
            packets.CAN_ARM: self.phase is ArmingPhase.CHECKS_PASSED,
            packets.ARMED: self.armed,
            packets.AUTO_ARMED: self.kind.auto_arm,
            packets.CAN_FLY: self.can_fly,
            packets.FLYING: self.phase in AIRBORNE,
            packets.TUMBLED: self.tumbled,
            packets.LOCKED: self.phase is ArmingPhase.LOCKED,
            packets.CRASHED: self.crashed,
        }
        return TRAJECTORY_FINISHED + sum(bit for bit, is_set in bits.items() if is_set)
