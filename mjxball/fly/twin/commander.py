"""The firmware's commander: which setpoint counts, and how old it is. No clock of its own."""

from __future__ import annotations

import math

from mjxball.fly.packets import ZERO, Setpoint

THRUST_FLOOR, THRUST_CEILING = 1000, 60000  # [thrust units] below: motors stand still; above: cut
PLANNER_PERIOD = 0.01  # [s] of the high-level commander, whose planner never flies here: it asks for motors off
NOBODY, PLANNER, LAPTOP = 0, 1, 2  # priorities of who sent the setpoint
WORST_ANGLE = 30.0  # [deg] in place of a number that is not finite: the real controller takes such a one as a kick


class Commander:
    """Thrust lock, priorities and the newest setpoint of one drone."""

    def __init__(self, now: float = 0.0) -> None:
        self.setpoint, self.time = ZERO, now
        self.priority = NOBODY
        self._locked = True
        self._planned = -math.inf
        self.wire_thrust = 0  # of the last setpoint received, whatever became of it

    def receive(self, value: Setpoint, now: float) -> None:
        """Port 3: a setpoint of any values. After boot, thrust is 0 until a setpoint of thrust 0 came."""
        if self.priority == NOBODY:
            self._locked = True
        if value.thrust == 0:
            self._locked = False
        self.wire_thrust = value.thrust
        thrust = 0 if self._locked or value.thrust < THRUST_FLOOR else min(value.thrust, THRUST_CEILING)
        angles = (part if math.isfinite(part) else WORST_ANGLE for part in value[:3])
        roll, pitch, yaw_rate = (min(max(part, -180.0), 180.0) for part in angles)
        self._take(Setpoint(roll, pitch, yaw_rate, thrust), now, LAPTOP)

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
