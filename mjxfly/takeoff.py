"""Take-off: thrust rises until the pair is off the ground, with the stick held level, before the controllers take over.

On the ground the legs carry part of the load: a side that stands does not respond to commands, and a recurrent follower
would remember that. With an off-centre load the lighter side lifts first. The difference between the drones' thrusts is
therefore found here, by feedback of the stick's angle, while the thrust rises. Pure.

The thrusts that hold the stick level at the end of the ramp are those of hover, whether the load is off-centre or one
drone has weaker motors. The controllers start from them (`TakeOff.needed`). Otherwise the stick would tip when they
take over, and the pair would drift until their integrals have compensated.
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

BEGIN = 0.85  # fraction of the ramp at which feedback starts, at 88 % of hover: an unloaded side lifts at 96 %
MOST_LIFT = 1.25  # largest thrust over hover: a rig that needs more is not the one that the policy was trained for
CLIMB = 0.1  # [m/s] climb rate that is controlled
CLIMB_GAIN = 0.4  # thrust over hover per m/s of error
CLIMB_INTEGRAL = 1.5  # the same per m: a pair that stands gets 15 % of hover more per second
# Opposite corrections of the drones' thrusts over hover, per rad, rad/s and rad s of the stick. With 50 ms of motor lag
# and 40 ms of delay the stick settles within half a second; with twice these gains it oscillates.
LEVEL_GAIN, LEVEL_DAMPING, LEVEL_INTEGRAL = 2.5, 0.35, 15.0
STUCK = "the pair is not seen to leave the ground"
LOAD = 0.03  # this correction for a load of 20 g, 2 cm off the middle
DISAGREEING = 1.5  # the same per rad between the drones' attitudes along the stick: 0.7 - 1.3 on the twin
APART = 0.15  # largest correction


def _clip(value: float, most: float) -> float:
    return min(max(value, -most), most)


class TakeOff:
    """Setpoints of the ramp. `wanted` is called once per period."""

    def __init__(self, rig: Rig, times: Times, period: float, lifted_at: float, stand: bool):
        """`period` [s] of the loop; airborne from height `lifted_at` [m] on; no sideways braking on a `stand`."""
        level = rig.span * [1.0, 1.0, 0.0]
        self._along = level / np.linalg.norm(level)  # from follower to leader, body axes
        self._times, self._period, self._lifted_at, self._stand = times, period, max(lifted_at, 1e-3), stand
        self._share = self._apart = self._resting = 0.0
        self.sent = [0.0, 0.0]  # last thrust of leader and follower [units]

    def wanted(self, elapsed: float, seen: ObjectState, height: float, maps: Sequence[CommandMap]) -> list[Setpoint]:
        """Setpoints of leader and follower `elapsed` [s] into the ramp, with O at `height` [m] above its start."""
        angle = self._angle(seen.matrix)
        tilt = (0.0, 0.0)
        if elapsed < BEGIN * self._times.ramp:
            # Open loop. The stick's angle on the ground is recorded, since the floor need not be level.
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
        """Elevation of the stick from follower to leader [rad], attitude `matrix` (3, 3) body -> world."""
        return math.asin(_clip(float((matrix @ self._along)[2]), 1.0))

    def _shares(self, angle: float, seen: ObjectState, height: float) -> tuple[float, float]:
        """Thrust over hover of leader and follower: controls the climb rate and brings the stick level."""
        missing = CLIMB - float(seen.velocity[2])
        self._share = min(max(self._share + CLIMB_INTEGRAL * self._period * missing, 0.0), MOST_LIFT)
        off = angle - self._resting * (1.0 - min(max(height / self._lifted_at, 0.0), 1.0))
        turning = float((seen.matrix @ rotations.cross(seen.rates, self._along))[2])
        self._apart = _clip(self._apart + LEVEL_INTEGRAL * self._period * off, APART)
        apart = _clip(self._apart + LEVEL_GAIN * off + LEVEL_DAMPING * turning, APART)
        both = min(self._share + CLIMB_GAIN * missing, MOST_LIFT)
        return both - apart, both + apart

    def needed(self, quaternions: Sequence[np.ndarray]) -> tuple[float, float]:
        """Hover force of leader and follower over nominal, by the thrusts that keep the stick level.

        (1, 1) for a difference that an off-centre load explains, which the controllers can handle: up to `LOAD`, more
        if the drones' attitudes `quaternions` (2, 4) disagree, and always on a stand, where it is the ball's.
        """
        angles = [self._angle(rotations.matrix_from_quaternion(one)) for one in quaternions]
        motors = abs(self._apart) > LOAD + DISAGREEING * abs(angles[0] - angles[1]) and not self._stand
        return (1.0 - self._apart, 1.0 + self._apart) if motors else (1.0, 1.0)

    def stuck(self, maps: Sequence[CommandMap]) -> str:
        """Message on a pair that has not left the ground, with both drones' thrusts and their bounds."""
        found = []
        for name, thrust, constants in zip(NAMES, self.sent, maps, strict=True):
            share, bound = thrust / constants.hover_thrust, ""
            if thrust >= THRUST_CEILING:
                bound = ", the most that is ever sent"
            elif share >= MOST_LIFT - 0.01:
                bound = ", the most that is tried"
            found.append(f"the {name} was sent {thrust:.0f} units ({share:.2f} of what should hover{bound})")
        return f"{STUCK}: {' and '.join(found)}; is it heavier, or does a propeller give less?"
