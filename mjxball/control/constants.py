"""Numbers that follow from the plant: inertia about O, attitude gains, hover shares. NumPy, float64."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Attitude, Config, Plant
from mjxball.control import crazyflie, mixer, rotations
from mjxball.control.attitude import AttitudeGains, design_gains
from mjxball.control.mixer import torque_per_force

Array = Any
ROLLING_INERTIA = 0.4  # spin inertia of a solid ball over r^2 and its mass: (7/5) m x'' = m g sin


class PlantConstants(NamedTuple):
    """Derived constants of one plant."""

    drone_mass: np.ndarray  # (2,) leader, follower [kg]
    mounts: np.ndarray  # (2, 3) leader, follower from O, body axes [m]
    share: np.ndarray  # (2,) share of the object's weight that each drone carries with the CG at O
    gains: AttitudeGains  # attitude gains of each drone
    drone_moment: np.ndarray  # (3,) sum of m_i r_i [kg m]
    drone_inertia: np.ndarray  # (3, 3) inertia of both drones about O, body axes [kg m2]
    shell_inertia_per_mass: np.ndarray  # (3,) of the fixed part of the object about O, per kg of object [m2]
    ball_inertia_per_mass: np.ndarray  # (3,) of the moving part about its own centre, per kg of object [m2]

    @property
    def object_inertia_per_mass(self) -> np.ndarray:
        """(3,) of the whole object about O with the CG at O, per kg of object [m2]."""
        return self.shell_inertia_per_mass + self.ball_inertia_per_mass


def box_inertia_per_mass(size: tuple[float, float, float]) -> np.ndarray:
    """Principal inertia (3,) [m2] of a uniform box with edges `size` [m], about its centre, per unit mass."""
    a, b, c = size
    return np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 12


def plant_constants(plant: Plant, attitude: Attitude) -> PlantConstants:
    """Derive the constants of `plant`; the attitude gains are those of `attitude.design_object_mass` at c = 0.

    If the whole object moves (`moving_fraction` 1) the moving mass has the box's inertia, as in the reference
    plant; else it is a solid ball, and the fixed rest is the box.
    """
    mass = np.array([plant.leader_mass, plant.follower_mass])
    mounts = np.array([plant.leader_mount, plant.follower_mount])
    own = np.diag(plant.leader_inertia) + np.diag(plant.follower_inertia)
    drone_inertia = own + sum(m * rotations.point_inertia(r) for m, r in zip(mass, mounts, strict=True))
    box, fraction = box_inertia_per_mass(plant.object_size), plant.moving_fraction
    ball = box if fraction == 1 else np.full(3, fraction * ROLLING_INERTIA * plant.ball_radius**2)
    shell = (1 - fraction) * box
    design_inertia = np.diag(drone_inertia) + attitude.design_object_mass * (shell + ball)
    ahead, behind = mounts[:, "xy".index(plant.cg_axis)]
    share = np.array([-behind, ahead]) / (ahead - behind)
    gains = design_gains(design_inertia, attitude.natural_frequency, attitude.damping)
    gains = AttitudeGains(tuple(map(float, gains.kp)), tuple(map(float, gains.kd)))
    return PlantConstants(mass, mounts, share, gains, mass @ mounts, drone_inertia, shell, ball)


def trim_limit(
    plant: Plant,
    object_mass: Array,
    margin: float,
    believed_mass: Array | None = None,
    thrust: tuple[Array, Array] = (1.0, 1.0),
) -> Array:
    """CG offset (...) [m] up to which the follower alone trims the assembly at its goal (ours); negative: nowhere.

    At the goal the leader commands a level hover with its share of the mass (...) that it believes [kg]; `thrust`
    is what leader's and follower's rotors (...) give of what they are asked for. What is missing of the weight the
    follower lifts at its own mount, and its pitch torque, 2 (F_max - T / 4) L for an asked thrust T, must hold the
    moment of that and of the CG with the share `margin` of it left.
    """
    believed = object_mass if believed_mass is None else believed_mass
    ahead, behind = (getattr(plant, name)["xy".index(plant.cg_axis)] for name in ("leader_mount", "follower_mount"))
    strong, own = thrust
    # What each drone lifts beyond its own mass.
    leader_lift = strong * (plant.leader_mass - behind / (ahead - behind) * believed) - plant.leader_mass
    follower_lift = object_mass - leader_lift
    asked = (plant.follower_mass + follower_lift) * plant.gravity / 4  # of each rotor, times `own`
    torque = (1 - margin) * torque_per_force(plant.arm, plant.layout) * (own * plant.rotor_force_max - asked)
    uneven = abs(ahead * leader_lift + behind * follower_lift) * plant.gravity  # moment about O of both lifts
    return (torque - uneven) / (object_mass * plant.gravity)


class DroneLoop(NamedTuple):
    """The linearised cascade of one drone about roll or pitch: kp (asked - angle) - kd rate - kdd rate' + slow z.

    z is the rate loop's integral, z' = stiffness (asked - angle) - rate, where the drone integrates.
    """

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    kdd: float  # [kg m2]
    integral_gain: float  # [N m/rad]
    stiffness: float  # kp of the attitude loop [1/s]
    integral_limit: float  # largest |z| [rad]
    thrust_surplus: float  # thrust that a curved motor gives besides a torque, over its square [1/(N m2)]


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
    leader, follower = map(float, constants.drone_mass + constants.share * config.plant.object_mass)
    return leader, follower


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
        integral_gain=torque * rate[1],
        stiffness=attitude[0],
        integral_limit=math.radians(crazyflie.RATE_LIMITS[axis]),
        # Two motors p up and two p down give 4 a p^2 more than none, p = output / 2 / FULL.
        thrust_surplus=law.motor_curve[0] * (math.degrees(1) / (torque * crazyflie.FULL)) ** 2,
    )
