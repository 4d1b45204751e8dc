"""Force of a drone from the thrust that it is sent, and which of two firmwares is connected. Pure.

Firmware with battery compensation (2025.12.1 and later by default) makes the force proportional to the thrust command:
`linear`. Firmware without it takes the command as the motors' PWM: `older`. No parameter says which, but the PWM does
that the firmware makes of a small thrust.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mjxball.control import crazyflie, motor_curves, motors
from mjxball.control.motors import Motor
from mjxball.fly.packets import Health

CurveName = Literal["linear", "older"]
CURVE_NAMES: tuple[CurveName, ...] = ("linear", "older")
SPIN_THRUST = 16000  # [thrust units] a third of hover: the motors turn, the pair does not lift
COMPENSATES_SINCE = (2025, 12)  # version of the firmware, as delivered
LIKELY = 0.12  # of ln(PWM / expected PWM): half of what lies between the two firmwares at a full battery


@dataclass(frozen=True)
class ForceCurve:
    """Force of one motor from p = thrust units / 65535: `quadratic` p^2 + `linear` p [N] (crazyflie.md)."""

    quadratic: float = 0.0  # [N]
    linear: float = 0.12  # [N] Crazyflie 2.1+ with battery compensation

    def force(self, thrust: float) -> float:
        """Force of the four motors of one drone [N] at `thrust` units."""
        return 4 * float(crazyflie.motor_force((self.quadratic, self.linear), thrust))

    def thrust(self, force: float) -> float:
        """Thrust units at which four motors give `force` [N]; not bounded above, 0 for none."""
        return float(crazyflie.motor_command((self.quadratic, self.linear), np.float64(force / 4)))


LINEAR = ForceCurve()
OLDER = ForceCurve(*motor_curves.OLDER)  # firmware without battery compensation, 2.1 motors


def curve_of_version(version: str) -> CurveName | None:
    """What a firmware of this `version`, such as 2026.08, has as delivered; None if it does not say."""
    found = re.match(r"(20\d\d)\.(\d\d)", version)
    if found is None:
        return None
    return "linear" if (int(found[1]), int(found[2])) >= COMPENSATES_SINCE else "older"


def expected_pwm(name: CurveName, motor: Motor, thrust: float, battery: float) -> float:
    """PWM of every motor at `thrust` units on level ground, by a firmware of this kind at `battery` [V]."""
    if name == "older":
        return thrust
    return float(motors.compensated(motor, np.float64(thrust), np.float64(battery)))


def recognise(seen: Health, battery: float, motor: Motor) -> CurveName | None:
    """Which firmware makes the PWM that was `seen` of the thrust that it reports; None if neither does.

    The mean of the four motors counts, in which roll, pitch and yaw cancel.
    """
    pwm, thrust = float(np.mean(seen.motors)), seen.thrust
    if not (pwm > 0 and thrust > 0 and battery > 0):
        return None
    expected = {name: expected_pwm(name, motor, thrust, battery) for name in CURVE_NAMES}
    off = {name: abs(math.log(pwm / value)) if value > 0 else math.inf for name, value in expected.items()}
    best = min(CURVE_NAMES, key=lambda name: off[name])
    return best if off[best] < LIKELY else None
