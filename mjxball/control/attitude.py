"""The attitude loop of one drone: thrust and PD torques from a (roll, pitch, vertical acceleration) command (ours)."""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.control import mixer

Array = Any


class AttitudeGains(NamedTuple):
    """PD gains of one drone on (roll, pitch, yaw)."""

    kp: tuple[float, ...]  # (3,) [N m/rad]
    kd: tuple[float, ...]  # (3,) [N m s/rad]


def design_gains(inertia: Array, natural_frequency: Array, damping: float) -> AttitudeGains:
    """Gains of one of two equal drones for the assembly's inertia about O (3,) [kg m2]: each takes half.

    Kp = J wn^2 / 2, Kd = J zeta wn (ours).
    """
    kp = tuple(0.5 * j * w * w for j, w in zip(inertia, natural_frequency, strict=True))
    kd = tuple(j * damping * w for j, w in zip(inertia, natural_frequency, strict=True))
    return AttitudeGains(kp, kd)


def rotor_commands(
    command: Array,
    euler: Array,
    rates: Array,
    carried_mass: Array,
    gains: AttitudeGains,
    gravity: float,
    arm: float,
    yaw_per_thrust: float,
    rotor_force_max: float,
    layout: str = "plus",
) -> Array:
    """Clipped rotor forces (..., 4) [N] for `command` = (roll, pitch [rad], vertical acceleration [m/s2]) (..., 3).

    `euler` = (phi, theta, psi) (..., 3) [rad], body `rates` (..., 3) [rad/s]; `carried_mass` (...) is the drone's
    own mass plus its share of the believed object mass [kg]. Desired yaw is 0 (paper).
    T = m (g + az) / (cos phi cos theta); tau = Kp (desired - euler) - Kd rates.
    """
    xp = command.__array_namespace__()
    kp, kd = (xp.asarray(gain, dtype=euler.dtype) for gain in gains)
    level = xp.cos(euler[..., 0]) * xp.cos(euler[..., 1])
    thrust = carried_mass * (gravity + command[..., 2]) / level
    desired = xp.stack([command[..., 0], command[..., 1], xp.zeros_like(command[..., 0])], axis=-1)
    torque = kp * (desired - euler) - kd * rates
    rotors = mixer.rotors_from_wrench(xp.concat([thrust[..., None], torque], axis=-1), arm, yaw_per_thrust, layout)
    return xp.clip(rotors, 0.0, rotor_force_max)
