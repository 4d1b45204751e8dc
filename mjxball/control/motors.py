"""Brushed and brushless motors of the Crazyflies: force from voltage, and the firmware's battery compensation.

The force follows the voltage at the motor, duty cycle times battery voltage. With battery compensation the firmware
takes a thrust command as a share of `Motor.max_force` and computes the duty cycle (PWM) that gives this force at the
battery's present voltage. Without it the thrust command is the PWM. NumPy and JAX arrays of any shape.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.control import crazyflie
from mjxball.control.constants import hover

FULL = crazyflie.FULL  # PWM of full power, and thrust command of full thrust
USUAL_BATTERY = 3.7  # [V] in hover, used if no voltage is sampled or measured
Curve = tuple[float, float]  # force of a motor at full power: share of p^2 and of p, p = command / 65535 [N]
OLDER: Curve = (0.0915, 0.0677)  # a 2.1's firmware without battery compensation
MAX_HOVER = 60000.0  # of the paper's thrust map, the firmware's cap


@dataclass(frozen=True)
class Motor:
    """One motor with its propeller. Source: the platform defaults of bitcraze/crazyflie-firmware 2026.08."""

    force_polynomial: tuple[float, float, float, float]  # force = c0 + c1 V + c2 V^2 + c3 V^3 [N], V at the motor
    min_force: float  # [N] a smaller commanded force stops the motor
    max_force: float  # [N] at thrust command 65535
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
    c0, c1, c2, c3 = motor.force_polynomial
    found = c0 + (c1 + (c2 + c3 * volts) * volts) * volts
    return xp.where(pwm > 0, xp.maximum(found, 0.0), 0.0)


def voltage(motor: Motor, wanted: Array) -> Array:
    """Voltage (...) [V] at which the motor gives `wanted` (...) [N]: the real root of the cubic (Cardano)."""
    xp = wanted.__array_namespace__()
    c0, c1, c2, c3 = motor.force_polynomial
    centre = -c2 / (3 * c3)
    # V = centre + u turns the cubic into u^3 + 3 p u = 2 q, solved by two cube roots.
    p = c1 / (3 * c3) - centre * centre
    q = -(c0 + c1 * centre + c2 * centre**2 + c3 * centre**3 - wanted) / (2 * c3)
    # Below zero only for forces so small that the firmware stops the motor.
    root = xp.sqrt(xp.maximum(q * q + p**3, 0.0))
    return centre + xp.cbrt(q + root) + xp.cbrt(q - root)


def compensated(motor: Motor, command: Array, supply: Array) -> Array:
    """PWM (...), uncapped above, for a thrust `command` (...) 0 .. 65535 at a battery of `supply` (...) [V]."""
    xp = command.__array_namespace__()
    wanted = command / FULL * motor.max_force
    found = FULL * voltage(motor, wanted) / supply
    return xp.where((wanted < motor.min_force) | (supply < 2.0), 0.0, found)


def compensates(curve: Curve) -> bool:
    """True if a firmware of this curve compensates for the battery: its force is a line."""
    return curve[0] == 0


def firmware(config: Config) -> dict[str, Any]:
    """Metadata of a policy file on the firmware that its gains and thrust map are for, and those that they convert to.

    `drone` is a name of `motors.MOTORS`; `curve` is linear (with battery compensation) or older (without).
    """
    drone = config.autopilot.drone or "2.1"
    line = compensates(config.autopilot.motor_curve)
    other = ["older" if line else "linear"] if drone == "2.1" else []
    return {"drone": drone, "curve": "linear" if line else "older", "converts": other}


def slope(curve: Curve, command: float) -> float:
    """Force of a motor per command [N] at `command`."""
    return (2 * curve[0] * command / crazyflie.FULL + curve[1]) / crazyflie.FULL


def with_curve(config: Config, curve: Curve) -> Config:
    """`config` for the same drones with a firmware of motor `curve`; the closed loop about hover stays the same.

    The thrust map takes the new curve; pid_rate.* are scaled by the ratio of both curves' slopes at hover; the paper's
    thrust map gets the hover thrust and the units per acceleration that give the same force and the same slope.
    """
    autopilot = config.autopilot
    curve = (float(curve[0]), float(curve[1]))
    if curve == autopilot.motor_curve:
        return config
    changed = dataclasses.replace(
        config,
        plant=dataclasses.replace(config.plant, rotor_force_max=sum(curve)),
        autopilot=dataclasses.replace(autopilot, motor_curve=curve),
    )
    ratio = hover(config)[1] / hover(changed)[1]
    loops = (autopilot.roll_rate, autopilot.pitch_rate, autopilot.yaw_rate)
    roll, pitch, yaw = ((ratio * p, ratio * i, ratio * d) for p, i, d in loops)
    force = crazyflie.motor_force(autopilot.motor_curve, autopilot.hover_thrust)
    level = float(crazyflie.motor_command(curve, np.float64(force)))
    scaled = dataclasses.replace(
        changed.autopilot,
        hover_thrust=min(level, MAX_HOVER),
        thrust_per_acceleration=autopilot.thrust_per_acceleration
        * slope(autopilot.motor_curve, autopilot.hover_thrust)
        / slope(curve, level),
        roll_rate=roll,
        pitch_rate=pitch,
        yaw_rate=yaw,
    )
    return dataclasses.replace(changed, autopilot=scaled)
