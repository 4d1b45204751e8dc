"""What a Crazyflie's cascade amounts to while the pair hovers: motor command, its slope, one drone's torques."""

from __future__ import annotations

import math
from typing import NamedTuple

from mjxball.config import Config
from mjxball.control import crazyflie, mixer
from mjxball.control.constants import plant_constants


class DroneLoop(NamedTuple):
    """The linearised cascade of one drone about roll or pitch: kp (asked - angle) - kd rate - kdd rate' + slow z.

    z is the rate loop's integral, z' = stiffness (asked - angle) - rate, where the drone integrates.
    """

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    kdd: float  # [kg m2]
    slow: float  # [N m/rad]
    stiffness: float  # kp of the attitude loop [1/s]
    integral_limit: float  # largest |z| [rad]
    surplus: float  # thrust that a curved motor gives besides a torque, over its square [1/(N m2)]


def hover(config: Config) -> tuple[float, float]:
    """(motor command at hover, force of a motor per command there [N]), the mean of both drones."""
    constants, curve = plant_constants(config.plant, config.attitude), config.autopilot.motor_curve
    weight = (constants.drone_mass + constants.share * config.plant.object_mass) * config.plant.gravity
    command = float(crazyflie.motor_command(curve, weight / 4).mean())
    a, b = curve
    return command, (2 * a * command / crazyflie.FULL + b) / crazyflie.FULL


def thrust_slopes(config: Config) -> tuple[float, float]:
    """Thrust per commanded vertical acceleration [kg] of leader and follower near hover."""
    law, constants = config.autopilot, plant_constants(config.plant, config.attitude)
    if law.kind == "crazyflie" and law.thrust_law == "paper":
        slope = 4 * hover(config)[1] * law.thrust_per_acceleration
        return slope, slope
    led, followed = map(float, constants.drone_mass + constants.share * config.plant.object_mass)
    return led, followed


def drone_loop(config: Config, axis: int) -> DroneLoop:
    """The cascade about `axis` (0 roll, 1 pitch) at hover; attitude ki and kd, which the pair lacks, left out."""
    law, plant = config.autopilot, config.plant
    attitude, rate = ((law.roll, law.roll_rate), (law.pitch, law.pitch_rate))[axis]
    # A rate loop's output moves each of four motors by half of it; the cascade counts in degrees.
    torque = 4 * mixer.lever(plant.arm, plant.layout) / 2 * hover(config)[1] * math.degrees(1)
    return DroneLoop(
        kp=torque * rate[0] * attitude[0],
        kd=torque * rate[0],
        kdd=torque * rate[2],
        slow=torque * rate[1],
        stiffness=attitude[0],
        integral_limit=math.radians(law.rate_limits[axis]),
        # Two motors p up and two p down give 4 a p^2 more than none, p = output / 2 / FULL.
        surplus=law.motor_curve[0] * (math.degrees(1) / (torque * crazyflie.FULL)) ** 2,
    )
