"""Mixers: rotor forces of one drone <-> its wrench, for rotors on the body axes (plus) or between them (x)."""

from __future__ import annotations

from typing import Any

from mjxball.arrays import Array, joined
from mjxball.plant.rotors import lever


def wrench_from_rotors(force: Array, arm: Array | float, yaw_per_thrust: Array | float, layout: str = "plus") -> Array:
    """(T, tau_x, tau_y, tau_z) (..., 4) [N, N m] of rotor forces F1..F4 (..., 4) [N], about the drone's centre."""
    f1, f2, f3, f4 = (force[..., i] for i in range(4))
    thrust, side = f1 + f2 + f3 + f4, lever(arm, layout)
    if layout == "plus":
        return joined([thrust, side * (f2 - f4), side * (f3 - f1), yaw_per_thrust * (f1 - f2 + f3 - f4)])
    roll, pitch, yaw = f3 + f4 - f1 - f2, f2 + f3 - f1 - f4, f2 + f4 - f1 - f3
    return joined([thrust, side * roll, side * pitch, yaw_per_thrust * yaw])


def turned(wrench: Array, yaw: Array | float) -> Array:
    """`wrench` = (T, tau_x, tau_y, tau_z) (..., 4) in axes that are turned by -`yaw` (...) about z [rad].

    The wrench of a drone that is turned by `yaw`, in the carrier's axes.
    """
    if isinstance(yaw, float) and yaw == 0.0:
        return wrench
    xp = wrench.__array_namespace__()
    yaw = xp.asarray(yaw, dtype=wrench.dtype)
    c, s = xp.cos(yaw), xp.sin(yaw)
    thrust, x, y, z = (wrench[..., i] for i in range(4))
    return joined([thrust, c * x - s * y, s * x + c * y, z])


def rotors_from_wrench(wrench: Array, arm: Array | float, yaw_per_thrust: Array | float, layout: str = "plus") -> Array:
    """Rotor forces F1..F4 (..., 4) [N] that give `wrench` = (T, tau_x, tau_y, tau_z) (..., 4); the exact inverse."""
    thrust, tx, ty, tz = (wrench[..., i] / 4 for i in range(4))
    side = lever(arm, layout)
    if layout == "plus":
        roll, pitch, yaw = 2 * tx / side, 2 * ty / side, tz / yaw_per_thrust
        return joined([thrust - pitch + yaw, thrust + roll - yaw, thrust + pitch + yaw, thrust - roll - yaw])
    roll, pitch, yaw = tx / side, ty / side, tz / yaw_per_thrust
    rotors = [thrust - roll - pitch - yaw, thrust - roll + pitch + yaw]
    return joined([*rotors, thrust + roll + pitch - yaw, thrust + roll - pitch + yaw])


def torque_per_force(arm: Any, layout: str) -> Any:
    """Roll or pitch torque per force [m] that a drone has: times (F_max - T / 4) it is the largest at thrust T."""
    return (2 if layout == "plus" else 4) * lever(arm, layout)
