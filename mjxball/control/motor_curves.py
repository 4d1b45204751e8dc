"""One firmware's thrust commands in another's units: the motor curve decides what a command and a gain are worth.

A firmware with battery compensation turns a thrust command into force along a line; an older one passes it on as PWM,
whose force is a curve and falls with the battery. A pair that is to fly alike on both needs the same force for the
same acceleration, and rate gains that turn the pair alike.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie
from mjxball.control.hover import hover

Curve = tuple[float, float]  # force of a motor at full power: share of p^2 and of p, p = command / 65535 [N]
OLDER: Curve = (0.0915, 0.0677)  # a 2.1's firmware without battery compensation
LARGEST_HOVER = 60000.0  # of the paper's law, as the firmware caps it


def compensates(curve: Curve) -> bool:
    """True if a firmware of this curve compensates for the battery: its force is a line."""
    return curve[0] == 0


def firmware(config: Config) -> dict[str, Any]:
    """What a card says about the firmware that its gains and thrust map are for, and which others they convert to.

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
    """`config` for the same drones with a firmware of motor `curve`: the closed loop about hover stays what it was.

    The thrust map takes the new curve; pid_rate.* are scaled by the ratio of both curves' slopes at hover; the paper's
    thrust law gets the hover thrust and the units per acceleration that give the same force and the same slope.
    """
    law = config.autopilot
    curve = (float(curve[0]), float(curve[1]))
    if curve == law.motor_curve:
        return config
    changed = dataclasses.replace(
        config,
        plant=dataclasses.replace(config.plant, rotor_force_max=sum(curve)),
        autopilot=dataclasses.replace(law, motor_curve=curve),
    )
    ratio = hover(config)[1] / hover(changed)[1]
    roll, pitch, yaw = ((ratio * p, ratio * i, ratio * d) for p, i, d in (law.roll_rate, law.pitch_rate, law.yaw_rate))
    force = crazyflie.motor_force(law.motor_curve, law.hover_thrust)
    level = float(crazyflie.motor_command(curve, np.float64(force)))
    scaled = dataclasses.replace(
        changed.autopilot,
        hover_thrust=min(level, LARGEST_HOVER),
        thrust_per_acceleration=law.thrust_per_acceleration
        * slope(law.motor_curve, law.hover_thrust)
        / slope(curve, level),
        roll_rate=roll,
        pitch_rate=pitch,
        yaw_rate=yaw,
    )
    return dataclasses.replace(changed, autopilot=scaled)
