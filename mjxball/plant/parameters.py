"""Physical parameters of a plant as a pytree of arrays, and the mass and inertia about O that follow from them.

The structure (number of drones, rotor layout, stand, directions of the load) is static and stays in `config.Plant`; the
values are `PlantParameters`. NumPy arrays are constants, which fold into a compiled program; JAX arrays may differ from
environment to environment.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.arrays import Array, joined
from mjxball.config import Attitude, Plant, ball_limit
from mjxball.plant.rotors import blocked_shares

ROLLING_INERTIA = 0.4  # spin inertia of a solid ball over r^2 and its mass: (7/5) m x'' = m g sin


class AttitudeGains(NamedTuple):
    """PD gains of one drone on (roll, pitch, yaw)."""

    kp: Array  # (3,) [N m/rad]
    kd: Array  # (3,) [N m s/rad]


class PlantParameters(NamedTuple):
    """Parameters of a plant of N drones; every array may have leading batch axes."""

    drone_mass: Array  # (N,) [kg]
    own_inertia: Array  # (N, 3) principal inertia about each drone's own centre and axes [kg m2]
    mounts: Array  # (N, 3) centres from O, body axes [m]
    yaw: Array  # (N,) angle about body z by which a drone is turned [rad]
    arm: Array  # (N,) centre to rotor [m]
    yaw_per_thrust: Array  # (N,) yaw moment of a rotor over its force [m]
    rotor_force_max: Array  # (N,) [N]
    rotor_lag: Array  # (N,) time constant of a rotor's force [s]
    known_mass: Array  # (N,) that hover thrust assumes besides the load: the drone and its share of the carrier [kg]
    load_share: Array  # (N,) share of the load's weight that a drone's hover thrust assumes
    gains: AttitudeGains  # of each drone, about body axes
    carrier_mass: Array  # () [kg]
    carrier_inertia: Array  # (3,) about O [kg m2]
    moving_fraction: Array  # () share of the object's mass that moves
    shell_inertia_per_mass: Array  # (3,) of the fixed part of the object about O, per kg of object [m2]
    ball_inertia_per_mass: Array  # (3,) of the moving part about its own centre, per kg of object [m2]
    ball_limit: Array  # () offset of a rolling ball at which it touches an end stop or the rim [m]
    gravity: Array  # () [m/s2]
    blocked: Array | None = None  # (N, 4) share of each rotor's wake that falls on the object; None: unknown, none

    @property
    def object_inertia_per_mass(self) -> Array:
        """Inertia (3,) of the whole object about O with the CG at O, per kg of object [m2]."""
        return self.shell_inertia_per_mass + self.ball_inertia_per_mass

    @property
    def drone_inertia(self) -> np.ndarray:
        """Inertia (3, 3) of all drones and the carrier about O, body axes [kg m2]; of NumPy parameters."""
        return rigid_inertia(self)

    @property
    def size(self) -> int:
        """Number of drones, N."""
        return int(self.drone_mass.shape[-1])


def rigid_mass(parameters: PlantParameters) -> Array:
    """Mass () of all drones and the carrier [kg]."""
    return parameters.drone_mass.sum(axis=-1) + parameters.carrier_mass


def rigid_moment(parameters: PlantParameters) -> Array:
    """First moment of mass (3,) about O: sum of m_i r_i over the drones [kg m]. The carrier's centre is O."""
    return (parameters.drone_mass[..., None] * parameters.mounts).sum(axis=-2)


def rigid_inertia(parameters: PlantParameters) -> Array:
    """Inertia (3, 3) of all drones and the carrier about O, body axes [kg m2]."""
    far = parameters.drone_mass[..., None, None] * point_inertia(parameters.mounts)
    return own_inertia(parameters).sum(axis=-3) + far.sum(axis=-3) + diagonal(parameters.carrier_inertia)


def own_inertia(parameters: PlantParameters) -> Array:
    """Inertia (N, 3, 3) of each drone about its own centre, body axes: Rz I Rz^T, Rz its rotation by yaw [kg m2]."""
    xp = parameters.yaw.__array_namespace__()
    c, s, zero = xp.cos(parameters.yaw), xp.sin(parameters.yaw), xp.zeros_like(parameters.yaw)
    turn = joined([joined([c, -s, zero]), joined([s, c, zero]), joined([zero, zero, zero + 1.0])], axis=-2)
    return (turn[..., None, :] * parameters.own_inertia[..., None, None, :] * turn[..., None, :, :]).sum(axis=-1)


def point_inertia(place: Array) -> Array:
    """Inertia |r|^2 1 - r r^T (..., 3, 3) of a unit mass at `place` r (..., 3), without differences of squares."""
    x, y, z = (place[..., i] for i in range(3))
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, -x * y, -x * z, -y * z
    return joined([joined([yy + zz, xy, xz]), joined([xy, xx + zz, yz]), joined([xz, yz, xx + yy])], axis=-2)


def diagonal(values: Array) -> Array:
    """Matrices (..., 3, 3) with `values` (..., 3) on their diagonals."""
    return values[..., None] * np.eye(3, dtype=values.dtype)


def box_inertia_per_mass(size: tuple[float, float, float]) -> np.ndarray:
    """Principal inertia (3,) [m2] of a uniform box with edges `size` [m], about its centre, per unit mass."""
    a, b, c = size
    return np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 12


def design_gains(inertia: Array, natural_frequency: Array, damping: float, drones: int = 2) -> AttitudeGains:
    """Attitude gains of one of N equal `drones` that share an assembly with this inertia about O (3,) [kg m2].

    Kp = J wn^2 / N, Kd = 2 J zeta wn / N (ours).
    """
    kp = tuple(j * w * w / drones for j, w in zip(inertia, natural_frequency, strict=True))
    kd = tuple(2 / drones * j * damping * w for j, w in zip(inertia, natural_frequency, strict=True))
    return AttitudeGains(kp, kd)


def plant_parameters(plant: Plant, attitude: Attitude) -> PlantParameters:
    """Parameters of `plant` as constants, with attitude gains for an object of `attitude.design_object_mass` at c = 0.

    If the whole object moves (`moving_fraction` 1) and there is no carrier, the moving mass has the inertia of the box,
    as in the reference plant. Otherwise the moving mass is a solid ball and the fixed rest is the box.
    """
    drones, fraction = plant.drones, plant.moving_fraction
    box = box_inertia_per_mass(plant.object_size)
    boxed = fraction == 1 and plant.carrier_mass == 0
    ball = box if boxed else np.full(3, fraction * ROLLING_INERTIA * plant.ball_radius**2)
    nothing = AttitudeGains(np.zeros(3), np.zeros(3))
    found = PlantParameters(
        drone_mass=np.array([drone.mass for drone in drones]),
        own_inertia=np.array([drone.inertia for drone in drones]),
        mounts=np.array([drone.mount for drone in drones]),
        yaw=np.array([drone.yaw for drone in drones]),
        arm=np.array(plant.of_drones("arm")),
        yaw_per_thrust=np.array(plant.of_drones("yaw_per_thrust")),
        rotor_force_max=np.array(plant.of_drones("rotor_force_max")),
        rotor_lag=np.array(plant.of_drones("rotor_lag")),
        known_mass=np.array(plant.known_masses),
        load_share=np.array(plant.load_shares),
        gains=nothing,
        carrier_mass=np.array(plant.carrier_mass),
        carrier_inertia=np.array(plant.carrier_inertia),
        moving_fraction=np.array(fraction),
        shell_inertia_per_mass=(1 - fraction) * box,
        ball_inertia_per_mass=ball,
        ball_limit=np.array(ball_limit(plant)),
        gravity=np.array(plant.gravity),
        blocked=blocked_shares(plant),
    )
    inertia = np.diag(found.drone_inertia) + attitude.design_object_mass * found.object_inertia_per_mass
    gains = design_gains(inertia, attitude.natural_frequency, attitude.damping, plant.count)
    return found._replace(gains=AttitudeGains(np.array(gains.kp), np.array(gains.kd)))
