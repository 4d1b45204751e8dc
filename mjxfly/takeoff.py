"""Off the ground: thrust rises until the legs carry nothing, and the stick is held level, before any law takes over.

Legs hide the load from the laws: a side that stands answers no command, and what a follower remembers of that is wrong
in the air. With the load off the middle the light side comes up first. What the drones lift apart is therefore found
here, while the thrust still rises, by the stick's own angle. Pure.

What holds the stick level at the end of the ramp is what hovers, whether the load lies to one side or one drone's
motors give less than the other's. The laws go on from there (`TakeOff.needed`): else the stick tips as soon as they
take over, and slides until the drones' integrals have made up for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.control import rotations
from mjxfly import setpoints
from mjxfly.limits import NAMES, Times
from mjxfly.packets import THRUST_CEILING, Setpoint
from mjxfly.setpoints import CommandMap
from mjxfly.telemetry import ObjectState, Rig

BEGIN = 0.85  # of the ramp, at 88 % of hover: a side that the load is not on comes off at 96 %
MOST_LIFT = 1.25  # share of hover that is tried: a rig that needs more is not the one that the policy was trained for
CLIMB = 0.1  # [m/s] upward that is held
CLIMB_GAIN = 0.4  # share of hover per m/s that is missing
CLIMB_INTEGRAL = 1.5  # likewise per m: a pair that stands gets 15 % of hover more a second
# Shares of hover that the drones lift apart, per rad, rad/s and rad s of the stick. At 50 ms of motor lag and 40 ms of
# delay the stick settles within half a second; twice these gains let it swing.
LEVEL_GAIN, LEVEL_DAMPING, LEVEL_INTEGRAL = 2.5, 0.35, 15.0
STUCK = "the pair is not seen to leave the ground"
LOAD = 0.03  # share of hover that a load of 20 g, 2 cm beside the middle, has the drones lift apart
DISAGREEING = 1.5  # the same per rad by which the drones' attitudes disagree along the stick: 0.7 - 1.3 on the twin
APART = 0.15  # share of hover that the drones lift apart at most


def _clip(value: float, most: float) -> float:
    return min(max(value, -most), most)


class TakeOff:
    """Setpoints of the ramp. `wanted` is called once per period."""

    def __init__(self, rig: Rig, times: Times, period: float, lifted_at: float, stand: bool):
        """`period` [s]; off the ground from `lifted_at` [m] on; on a `stand` nothing brakes sideways."""
        level = rig.span * [1.0, 1.0, 0.0]
        self._along = level / np.linalg.norm(level)  # from follower to leader, body axes
        self._times, self._period, self._lifted_at, self._stand = times, period, max(lifted_at, 1e-3), stand
        self._share = self._apart = self._resting = 0.0
        self.sent = [0.0, 0.0]  # thrust of leader and follower, last [units]

    def wanted(self, elapsed: float, seen: ObjectState, height: float, maps: Sequence[CommandMap]) -> list[Setpoint]:
        """Both setpoints `elapsed` [s] into the ramp, with O `height` [m] above where it stood."""
        angle = self._angle(seen.matrix)
        tilt = (0.0, 0.0)
        if elapsed < BEGIN * self._times.ramp:
            # The floor need not be level.
            found = [setpoints.ramp(elapsed, self._times, constants) for constants in maps]
            self._share = found[0].thrust / maps[0].hover_thrust - CLIMB_GAIN * CLIMB
            self._apart, self._resting = 0.0, angle
        else:
            shares = self._shares(angle, seen, height)
            tilt = tilt if self._stand else setpoints.brake(seen.velocity)
            thrusts = [share * constants.hover_thrust for share, constants in zip(shares, maps, strict=True)]
            found = [setpoints.level(thrust, tilt) for thrust in thrusts]
        self.sent = [float(one.thrust) for one in found]
        return found

    def _angle(self, matrix: np.ndarray) -> float:
        """Of the stick above the horizon [rad]."""
        return math.asin(_clip(float((matrix @ self._along)[2]), 1.0))

    def _shares(self, angle: float, seen: ObjectState, height: float) -> tuple[float, float]:
        """Shares of hover of leader and follower: a climb that is held, a stick that comes to be level."""
        missing = CLIMB - float(seen.velocity[2])
        self._share = min(max(self._share + CLIMB_INTEGRAL * self._period * missing, 0.0), MOST_LIFT)
        off = angle - self._resting * (1.0 - min(max(height / self._lifted_at, 0.0), 1.0))
        turning = float((seen.matrix @ rotations.cross(seen.rates, self._along))[2])
        self._apart = _clip(self._apart + LEVEL_INTEGRAL * self._period * off, APART)
        apart = _clip(self._apart + LEVEL_GAIN * off + LEVEL_DAMPING * turning, APART)
        both = min(self._share + CLIMB_GAIN * missing, MOST_LIFT)
        return both - apart, both + apart

    def needed(self, quaternions: Sequence[np.ndarray]) -> tuple[float, float]:
        """Force of leader and follower that keeps the stick level, as shares of what should hover.

        Up to `LOAD` it may be the load's place, as the laws know it, and on a `stand` it is the ball's. Attitudes of
        the drones that disagree, `quaternions` (2, 4), have each push its end to another place.
        """
        angles = [self._angle(rotations.matrix_from_quaternion(one)) for one in quaternions]
        motors = abs(self._apart) > LOAD + DISAGREEING * abs(angles[0] - angles[1]) and not self._stand
        return (1.0 - self._apart, 1.0 + self._apart) if motors else (1.0, 1.0)

    def stuck(self, maps: Sequence[CommandMap]) -> str:
        """What is seen of a pair that has not come off: which drone gives what, and at which bound."""
        found = []
        for name, thrust, constants in zip(NAMES, self.sent, maps, strict=True):
            share, bound = thrust / constants.hover_thrust, ""
            if thrust >= THRUST_CEILING:
                bound = ", the most that is ever sent"
            elif share >= MOST_LIFT - 0.01:
                bound = ", the most that is tried"
            found.append(f"the {name} was sent {thrust:.0f} units ({share:.2f} of what should hover{bound})")
        return f"{STUCK}: {' and '.join(found)}; is it heavier, or does a propeller give less?"
