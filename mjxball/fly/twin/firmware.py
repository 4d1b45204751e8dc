"""What one drone's firmware does with what it is sent: thrust lock, arming, watchdog, tumble, stops. No clock.

Times and thresholds are those measured on the real firmware (crazyflie.md); the order of the checks is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjxball.fly import packets
from mjxball.fly.packets import ZERO, Setpoint


@dataclass(frozen=True)
class FirmwareTimes:
    """Behaviour of the firmware."""

    auto_arm: bool = True  # 2.1 arms itself, the brushless does not
    level_after: float = 0.5  # without setpoints, thrust is kept [s]
    lock_after: float = 2.0  # without setpoints, motors off until reboot [s]
    tumble_force: float = 0.5 * 9.81  # specific force along body z below which it may be falling [m/s2]
    tumble_time: float = 1.0  # [s]
    keepalive_time: float = 1.0  # an emergency stop keepalive that was begun must be repeated within this [s]
    thrust_floor: int = 1000  # below, motors stand still [thrust units]
    thrust_ceiling: int = 60000


class Firmware:
    """Supervisor and commander of one drone. Time comes in, setpoints for the physics come out."""

    def __init__(self, times: FirmwareTimes = FirmwareTimes()):
        self.times = times
        self.reboot()

    def reboot(self) -> None:
        """Power on: locked thrust, no memory of crashes."""
        self.armed = self.times.auto_arm
        self.locked = self.crashed = self.tumbled = self.dead = False
        self._thrust_locked = True
        self._last = ZERO
        self._last_time: float | None = None
        self._falling_since: float | None = None
        self._keepalive: float | None = None
        self.flying = False
        self.running = False

    # What the link delivers.

    def receive_setpoint(self, value: Setpoint, now: float) -> None:
        """Port 3: a setpoint of any values; floats that are not finite reach the controller, as they do on a drone."""
        if value.thrust == 0:
            self._thrust_locked = False
        self._last, self._last_time = value, now

    def receive_stop(self) -> None:
        """Port 7, stop: motors off at once, not locked; the next setpoint counts again, after a zero one."""
        self._last, self._last_time, self._thrust_locked, self.running = ZERO, None, True, False

    def emergency_stop(self) -> None:
        """Motors off and locked until reboot."""
        self.locked = True

    def keep_alive(self, now: float) -> None:
        """Emergency stop keepalive: once begun it must go on."""
        self._keepalive = now

    def arm(self, wanted: bool) -> bool:
        """Arm or disarm; true if done."""
        if wanted and (self.locked or self.crashed or self.tumbled):
            return False
        self.armed = wanted
        return True

    def recover(self) -> bool:
        """Leave the crashed state, if upright and not locked."""
        if self.locked or self.tumbled:
            return False
        self.crashed, self._thrust_locked = False, True
        return True

    # What it does every millisecond.

    def step(self, now: float, force_z: float, upright: bool) -> Setpoint:
        """The setpoint that reaches the controller; thrust 0 is motors off.

        `force_z` is the accelerometer's body z [m/s2], `upright` whether body z points up.
        """
        times = self.times
        age = math.inf if self._last_time is None else now - self._last_time
        if age > times.lock_after and self.running:
            self.locked = True
        if self._keepalive is not None and now - self._keepalive > times.keepalive_time:
            self.locked = True
        self._watch_tumble(now, force_z, upright)
        value = self._last if age <= times.lock_after else ZERO
        if age > times.level_after:
            value = Setpoint(0.0, 0.0, 0.0, value.thrust)
        off = not self.armed or self.locked or self.crashed or self.dead or self._thrust_locked
        thrust = 0 if off or value.thrust < times.thrust_floor else min(value.thrust, times.thrust_ceiling)
        self.running = thrust > 0
        self.flying = self.running and thrust > 20000
        # The real controller takes a number that is not finite as a kick; the physics gets the largest tilt instead.
        angles = (part if math.isfinite(part) else 30.0 for part in value[:3])
        roll, pitch, yaw_rate = (min(max(part, -180.0), 180.0) for part in angles)
        return Setpoint(roll, pitch, yaw_rate, thrust)

    def _watch_tumble(self, now: float, force_z: float, upright: bool) -> None:
        self.tumbled = not upright
        if force_z >= self.times.tumble_force or not (self.running or self._falling_since):
            self._falling_since = None
        elif self._falling_since is None:
            self._falling_since = now
        elif now - self._falling_since > self.times.tumble_time:
            self.crashed = True

    @property
    def last_thrust(self) -> int:
        """Of the last setpoint that was received, whatever became of it [thrust units]."""
        return self._last.thrust

    @property
    def info(self) -> int:
        """Bits of supervisor.info."""
        sound = not (self.locked or self.crashed or self.tumbled)
        bits = {
            packets.CAN_ARM: sound,
            packets.ARMED: self.armed,
            packets.AUTO_ARMED: self.times.auto_arm,
            packets.CAN_FLY: sound and self.armed,
            packets.FLYING: self.flying,
            packets.TUMBLED: self.tumbled,
            packets.LOCKED: self.locked,
            packets.CRASHED: self.crashed,
        }
        return sum(bit for bit, is_set in bits.items() if is_set)
