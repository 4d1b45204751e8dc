"""Quantities that follow from a plant and its autopilot: trim limits, hover commands, linearised loops."""

from __future__ import annotations

import math
from typing import NamedTuple

from mjxball.arrays import Array
from mjxball.config import Config, Plant
from mjxball.control import crazyflie
from mjxball.control.mixer import torque_per_force
from mjxball.plant import plant_parameters
from mjxball.plant.rotors import lever


def trim_limit(
    plant: Plant,
    object_mass: Array,
    margin: float,
    believed_mass: Array | None = None,
    thrust: tuple[Array, Array] = (1.0, 1.0),
) -> Array:
    """CG offset (...) [m] up to which the follower alone trims the assembly at its goal (ours); negative: nowhere.

    At the goal the leader commands a level hover with its share of the mass (...) that it assumes [kg]. `thrust` are
    factors (...) on the rotor forces of leader and follower. The follower lifts the rest of the weight at its mount.
    Its pitch torque, 2 (F_max - T / 4) L at thrust T, holds the moment of both lifts and of the CG with the share
    `margin` left. The function can be traced, for training. It ignores that rotor forces cannot be negative;
    `mjxball.plant.trim` serves any plant.
    """
    believed = object_mass if believed_mass is None else believed_mass
    lead, follow = plant.pair
    ahead, behind = (drone.mount[plant.directions[0]] for drone in (lead, follow))
    arm, most = follow.arm or plant.arm, follow.rotor_force_max or plant.rotor_force_max
    strong, own = thrust
    # What each drone lifts beyond its own mass.
    leader_lift = strong * (lead.mass - behind / (ahead - behind) * believed) - lead.mass
    follower_lift = object_mass - leader_lift
    asked = (follow.mass + follower_lift) * plant.gravity / 4  # of each rotor, times `own`
    torque = (1 - margin) * torque_per_force(arm, plant.layout) * (own * most - asked)
    uneven = abs(ahead * leader_lift + behind * follower_lift) * plant.gravity  # moment about O of both lifts
    return (torque - uneven) / (object_mass * plant.gravity)


class DroneLoop(NamedTuple):
    """Linearised cascade of one drone about roll or pitch: kp (asked - angle) - kd rate - kdd rate' + integral_gain z.

    z is the integral of the rate loop, z' = stiffness (asked - angle) - rate, if the drone has one.
    """

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    kdd: float  # [kg m2]
    integral_gain: float  # [N m/rad]
    stiffness: float  # kp of the attitude loop [1/s]
    integral_limit: float  # largest |z| [rad]
    thrust_surplus: float  # extra thrust of a torque by the motor curve's curvature, over its square [1/(N m2)]


def hover(config: Config) -> tuple[float, float]:
    """Motor command at hover, and force of a motor per command there [N]; the mean of both drones."""
    constants, curve = plant_parameters(config.plant, config.attitude), config.autopilot.motor_curve
    weight = (constants.known_mass + constants.load_share * config.plant.object_mass) * config.plant.gravity
    command = float(crazyflie.motor_command(curve, weight / 4).mean())
    a, b = curve
    return command, (2 * a * command / crazyflie.FULL + b) / crazyflie.FULL


def thrust_slopes(config: Config) -> tuple[float, float]:
    """Thrust per commanded vertical acceleration [kg] of leader and follower near hover."""
    autopilot, constants = config.autopilot, plant_parameters(config.plant, config.attitude)
    if autopilot.kind == "crazyflie" and autopilot.thrust_law == "paper":
        slope = 4 * hover(config)[1] * autopilot.thrust_per_acceleration
        return slope, slope
    leader, follower = map(float, constants.known_mass + constants.load_share * config.plant.object_mass)
    return leader, follower


def drone_loop(config: Config, axis: int) -> DroneLoop:
    """The cascade about `axis` (0 roll, 1 pitch) at hover, without attitude ki and kd, which the pair does not use."""
    autopilot, plant = config.autopilot, config.plant
    attitude, rate = ((autopilot.roll, autopilot.roll_rate), (autopilot.pitch, autopilot.pitch_rate))[axis]
    # A rate loop's output moves each of four motors by half of it; the cascade counts in degrees.
    torque = 4 * lever(plant.arm, plant.layout) / 2 * hover(config)[1] * math.degrees(1)
    return DroneLoop(
        kp=torque * rate[0] * attitude[0],
        kd=torque * rate[0],
        kdd=torque * rate[2],
        integral_gain=torque * rate[1],
        stiffness=attitude[0],
        integral_limit=math.radians(crazyflie.RATE_LIMITS[axis]),
        # Two motors p up and two p down give 4 a p^2 more than none, p = output / 2 / FULL.
        thrust_surplus=autopilot.motor_curve[0] * (math.degrees(1) / (torque * crazyflie.FULL)) ** 2,
    )
