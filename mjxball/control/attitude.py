"""The attitude loop of one drone: thrust and PD torques from a (roll, pitch, vertical acceleration) command (ours)."""

from __future__ import annotations

from mjxball.arrays import Array, clipped, joined
from mjxball.control import mixer
from mjxball.plant.parameters import AttitudeGains


def scaled_gains(gains: AttitudeGains, scale: Array) -> AttitudeGains:
    """`gains` for `scale` (...) times the natural frequency and the same damping: Kp s^2, Kd s, (..., 1, 3)."""
    kp, kd = (scale.__array_namespace__().asarray(gain, dtype=scale.dtype) for gain in gains)
    factor = scale[..., None, None]
    return AttitudeGains(factor * factor * kp, factor * kd)


def rotor_commands(
    command: Array,
    euler: Array,
    rates: Array,
    carried_mass: Array,
    gains: AttitudeGains,
    gravity: float,
    arm: Array | float,
    yaw_per_thrust: Array | float,
    rotor_force_max: Array | float,
    layout: str = "plus",
    yaw: Array | float = 0.0,
) -> Array:
    """Clipped rotor forces (..., 4) [N] for `command` = (roll, pitch [rad], vertical acceleration [m/s2]) (..., 3).

    `euler` = (phi, theta, psi) (..., 3) [rad] and body `rates` (..., 3) [rad/s] are the carrier's; `carried_mass` (...)
    is the drone's own mass plus its share of the believed object mass [kg]. Desired yaw is 0 (paper). `arm`,
    `yaw_per_thrust`, `rotor_force_max` and `yaw`, the drone's heading relative to the carrier [rad], are (...) or a
    float. T = m (g + az) / (cos phi cos theta); tau = Kp (desired - euler) - Kd rates.
    """
    xp = command.__array_namespace__()
    kp, kd = (xp.asarray(gain, dtype=euler.dtype) for gain in gains)
    level = xp.cos(euler[..., 0]) * xp.cos(euler[..., 1])
    thrust = carried_mass * (gravity + command[..., 2]) / level
    desired = joined([command[..., 0], command[..., 1], xp.zeros_like(command[..., 0])])
    torque = kp * (desired - euler) - kd * rates
    wrench = mixer.turned(xp.concat([thrust[..., None], torque], axis=-1), -yaw)
    rotors = mixer.rotors_from_wrench(wrench, arm, yaw_per_thrust, layout)
    return clipped(rotors, 0.0, xp.asarray(rotor_force_max, dtype=rotors.dtype)[..., None])
