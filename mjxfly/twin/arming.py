"""The firmware's supervisor: whether motors may run, from what 25 times a second is true. No clock of its own.

Written from the facts of bitcraze/crazyflie-firmware 2026.08. Times in seconds of the drone's clock.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from mjxfly import packets
from mjxfly.twin.conditions import DroneKind

PERIOD = 0.04  # [s] between two looks at the conditions
FLYING_KEPT = 2.0  # [s] it counts as flying after a motor was last above idle
LEVEL_AFTER, LOCK_AFTER = 0.5, 2.0  # [s] without a setpoint
LANDED_TIME, PREFLIGHT_TIME = 3.0, 30.0  # [s] until it starts over: after landing, and armed on the ground
KEEPALIVE_TIME = 1.0  # [s] a keepalive of the emergency stop that was begun must come again within it
TILTED, TILTED_TIME = 0.5, 1.0  # acc.z [g] below which it is tilted, [s] it may be
INVERTED, INVERTED_TIME = -0.2, 0.1  # likewise upside down
FREE_FALL = 0.1  # [g] no axis of the accelerometer shows more in a fall
TRAJECTORY_FINISHED = 0x200  # info bit of the high-level commander, which is never used here


class Phase(enum.Enum):
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


CAN_FLY = (Phase.READY, Phase.FLYING, Phase.LEVEL_OUT, Phase.LANDED)
MAY_RUN = (*CAN_FLY, Phase.ARMING)
AIRBORNE = (Phase.FLYING, Phase.LEVEL_OUT)


class Conditions(NamedTuple):
    """What one look finds."""

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
# What each phase turns into: the first test that holds decides, and none of them means that it stays.
TRANSITIONS: dict[Phase, tuple[tuple[Test, Phase], ...]] = {
    Phase.UNKNOWN: ((lambda now: True, Phase.CHECKS_FAILED),),
    Phase.CHECKS_FAILED: (
        (lambda now: now.emergency, Phase.STOPPED),
        (lambda now: not now.tumbled, Phase.CHECKS_PASSED),
    ),
    Phase.CHECKS_PASSED: (
        (lambda now: now.emergency, Phase.STOPPED),
        (lambda now: now.tumbled, Phase.CHECKS_FAILED),
        (lambda now: now.armed, Phase.ARMING),
    ),
    Phase.ARMING: (
        (lambda now: now.emergency, Phase.STOPPED),
        (lambda now: now.tumbled or not now.armed, Phase.CHECKS_FAILED),
        (lambda now: True, Phase.READY),
    ),
    Phase.READY: (
        (lambda now: now.emergency, Phase.STOPPED),
        (lambda now: now.tumbled or now.waited or not now.armed, Phase.CHECKS_FAILED),
        (lambda now: now.flying, Phase.FLYING),
    ),
    Phase.FLYING: (
        (lambda now: now.timed_out or now.emergency, Phase.STOPPED),
        (lambda now: now.tumbled, Phase.CRASHED),
        (lambda now: not now.armed, Phase.RESET),
        (lambda now: now.silent, Phase.LEVEL_OUT),
        (lambda now: not now.flying, Phase.LANDED),
    ),
    Phase.LANDED: (
        (lambda now: now.landed or not now.armed, Phase.RESET),
        (lambda now: now.flying, Phase.FLYING),
    ),
    Phase.RESET: ((lambda now: True, Phase.CHECKS_FAILED),),
    # Motors that are off do not end it: a laptop that falls silent within 2 s of the last thrust is locked.
    Phase.LEVEL_OUT: (
        (lambda now: now.timed_out or now.tumbled or now.emergency, Phase.STOPPED),
        (lambda now: not now.silent, Phase.FLYING),
    ),
    Phase.STOPPED: ((lambda now: True, Phase.LOCKED),),
    Phase.LOCKED: (),
    Phase.CRASHED: (
        (lambda now: not (now.crashed or now.tumbled), Phase.CHECKS_FAILED),
        (lambda now: now.emergency, Phase.LOCKED),
    ),
}


def after(phase: Phase, now: Conditions) -> Phase:
    """The phase that follows `phase` under the conditions of one look."""
    return next((new for test, new in TRANSITIONS[phase] if test(now)), phase)


class Supervisor:
    """State of one drone's supervisor. `look` is called every `PERIOD`."""

    def __init__(self, kind: DroneKind, now: float = 0.0, booted: bool = True):
        """At `now` [s]: ready for its first command, or, not `booted`, at its first look."""
        self.kind = kind
        self.phase = Phase.UNKNOWN
        self.armed = self.crashed = self.emergency = self.tumbled = False
        self.stopped = 0.0  # parameter stabilizer.stop: an emergency as long as it is not 0
        self.tumble_check = 1.0
        self.crash_force = 0.0  # [g] beyond 1 g at which it counts as tumbled; 0: none
        self.keepalive: float | None = None
        self.preflight_time, self.landed_time = PREFLIGHT_TIME, LANDED_TIME
        self._thrust_time: float | None = None
        self._tumble_time: float | None = None
        self._ready_since = self._landed_since = now
        if booted:
            self._enter(Phase.CHECKS_PASSED, now)
            if kind.auto_arm:
                self._enter(Phase.READY, now)
        self.info = self._bits()

    @property
    def can_fly(self) -> bool:
        """True where setpoints are executed."""
        return self.phase in CAN_FLY

    @property
    def motors_allowed(self) -> bool:
        """True where the motors turn, if only at idle."""
        return self.phase in MAY_RUN

    def request_arming(self, wanted: bool) -> bool:
        """Arm or disarm; true if that is done or was so already."""
        if wanted and not self.armed and self.phase is not Phase.CHECKS_PASSED:
            return False
        self.armed = wanted
        return True

    def crash(self) -> None:
        """Find that it has crashed, as after a tumble in flight."""
        self._enter(Phase.CRASHED, self._ready_since)

    def recover(self) -> bool:
        """Forget a crash; false while it is still tumbled."""
        if self.crashed and self.tumbled:
            return False
        self.crashed = False
        return True

    def look(self, now: float, age: float, pwm: Sequence[float], acceleration: Sequence[float]) -> None:
        """One look at `now` [s]: `age` of the setpoint [s], `pwm` of the motors, `acceleration` (3,) measured [g]."""
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
            waited=self.phase is Phase.READY and now - self._ready_since > self.preflight_time,
            landed=now - self._landed_since > self.landed_time,
        )
        new = after(self.phase, found)
        if new is not self.phase:
            self._enter(new, now)
        self.info = self._bits()

    def _enter(self, phase: Phase, now: float) -> None:
        self.phase = phase
        if phase is Phase.READY:
            self._ready_since = now
        if phase is Phase.LANDED:
            self._landed_since = now
        if phase is Phase.CRASHED:
            self.crashed = True
        if phase not in MAY_RUN:
            self.armed = False
        if phase is Phase.CHECKS_PASSED and self.kind.auto_arm:
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
            packets.CAN_ARM: self.phase is Phase.CHECKS_PASSED,
            packets.ARMED: self.armed,
            packets.AUTO_ARMED: self.kind.auto_arm,
            packets.CAN_FLY: self.can_fly,
            packets.FLYING: self.phase in AIRBORNE,
            packets.TUMBLED: self.tumbled,
            packets.LOCKED: self.phase is Phase.LOCKED,
            packets.CRASHED: self.crashed,
        }
        return TRAJECTORY_FINISHED + sum(bit for bit, is_set in bits.items() if is_set)
