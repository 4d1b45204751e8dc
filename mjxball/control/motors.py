"""Brushed and brushless motors of the Crazyflies: force from voltage, and the firmware's battery compensation.

The force follows the voltage at the motor, duty cycle times battery voltage. With battery compensation the firmware
takes a thrust command as a share of `Motor.most` and computes the duty cycle (PWM) that gives this force at the
battery's present voltage. Without it, the thrust command is the PWM. NumPy and JAX arrays of any shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Array = Any
FULL = 65535.0  # PWM of full power, and thrust command of full thrust


@dataclass(frozen=True)
class Motor:
    """One motor with its propeller. Source: the platform defaults of bitcraze/crazyflie-firmware 2026.08."""

    volts: tuple[float, float, float, float]  # force = c0 + c1 V + c2 V^2 + c3 V^3 [N], V at the motor
    least: float  # [N] a smaller commanded force stops the motor
    most: float  # [N] at thrust command 65535
    yaw_per_thrust: float  # [m]


MOTORS = {
    "2.1": Motor(
        (-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145),
        0.012817578393224994,
        0.12,
        0.0069928948992470565,
    ),
    "2.1-legacy": Motor(
        (-0.014830744918356092, 0.04724465241828281, -0.01847364358025878, 0.005960923942142),
        0.012817578393224994,
        0.12,
        0.007350862856566459,
    ),
    "thrust-upgrade": Motor(
        (0.006728127583707208, 0.01011557616217668, 0.010263198062061085, 0.0028358638322392503),
        0.01922636758983749,
        0.18,
        0.0051648627905205285,
    ),
    "brushless": Motor(
        (-0.014058926705279723, 0.04265273261724981, 0.0018327760144017432, 0.0020576974784587178),
        0.02136263065537499,
        0.20,
        0.00569278844371417,
    ),
}


def force(motor: Motor, pwm: Array, supply: Array) -> Array:
    """Steady force (...) [N] at `pwm` (...) 0 .. 65535 and a battery of `supply` (...) [V]; never negative."""
    xp = pwm.__array_namespace__()
    volts = pwm / FULL * supply
    c0, c1, c2, c3 = motor.volts
    found = c0 + (c1 + (c2 + c3 * volts) * volts) * volts
    return xp.where(pwm > 0, xp.maximum(found, xp.zeros_like(found)), xp.zeros_like(found))


def voltage(motor: Motor, wanted: Array) -> Array:
    """Voltage (...) [V] at which the motor gives `wanted` (...) [N]: the real root of the cubic (Cardano)."""
    xp = wanted.__array_namespace__()
    c0, c1, c2, c3 = motor.volts
    centre = -c2 / (3 * c3)
    # V = centre + u turns the cubic into u^3 + 3 p u = 2 q, solved by two cube roots.
    p = c1 / (3 * c3) - centre * centre
    q = -(c0 + c1 * centre + c2 * centre**2 + c3 * centre**3 - wanted) / (2 * c3)
    # Below zero only for forces so small that the firmware stops the motor.
    root = xp.sqrt(xp.maximum(q * q + p**3, xp.zeros_like(q)))
    return centre + xp.cbrt(q + root) + xp.cbrt(q - root)


def compensated(motor: Motor, command: Array, supply: Array) -> Array:
    """PWM (...), uncapped above, for a thrust `command` (...) 0 .. 65535 at a battery of `supply` (...) [V]."""
    xp = command.__array_namespace__()
    wanted = command / FULL * motor.most
    found = FULL * voltage(motor, wanted) / supply
    return xp.where((wanted < motor.least) | (supply < 2.0), xp.zeros_like(found), found)
