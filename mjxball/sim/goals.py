"""Goals that move, along a line, around a circle or by a step. Followers observe their rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Scalar, Vector


class Goal(NamedTuple):
    """Where O is to be, and how fast that place moves."""

    position: Vector  # [m]
    rate: Vector | None = None  # [m/s]; None: it rests


@dataclass(frozen=True)
class GoalMotion:
    """Motion of the goal of one flight, relative to goal and waypoints of its `Scenario`. By default it rests."""

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of a ramp from the start [m/s]
    until: float = math.inf  # when the ramp ends [s]
    radius: float = 0.0  # of a horizontal circle that starts at the goal [m]
    speed: float = 0.0  # around it, anticlockwise if positive [rad/s]
    phase: float = 0.0  # direction from the circle's centre to the start [rad]


class GoalPath(NamedTuple):
    """Goals (...) that move as `GoalMotion` says, and may jump once."""

    start: Vector  # [m]
    velocity: Vector
    until: Scalar
    radius: Scalar
    speed: Scalar
    phase: Scalar
    step: Vector  # [m]
    step_time: Scalar  # [s]

    def at(self, time: Scalar) -> Goal:
        """The goals (...) at `time` [s]."""
        xp = self.start.__array_namespace__()
        angle = self.phase + self.speed * time
        circle = self.radius[..., None] * (_direction(angle) - _direction(self.phase))
        ramp = xp.minimum(time, self.until)[..., None] * self.velocity
        step = self.step * xp.astype(time >= self.step_time, time.dtype)[..., None]
        rate = self.velocity * xp.astype(time < self.until, time.dtype)[..., None]
        turning = (self.radius * self.speed)[..., None] * _direction(angle + math.pi / 2)
        return Goal(self.start + ramp + circle + step, rate + turning)


def _direction(angle: Scalar) -> Float[Array, "... 3"]:
    xp = angle.__array_namespace__()
    return xp.stack([xp.cos(angle), xp.sin(angle), 0.0 * angle], axis=-1)
