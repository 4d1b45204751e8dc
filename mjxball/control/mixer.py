"""Plus-layout mixer: rotors 1 at +x, 2 at +y, 3 at -x, 4 at -y (paper eq. 2)."""

from __future__ import annotations

from typing import Any

Array = Any


def wrench_from_rotors(force: Array, arm: float, yaw_per_thrust: float) -> Array:
    """(T, tau_x, tau_y, tau_z) (..., 4) [N, N m] of rotor forces F1..F4 (..., 4) [N], about the drone's centre."""
    xp = force.__array_namespace__()
    f1, f2, f3, f4 = (force[..., i] for i in range(4))
    return xp.stack(
        [f1 + f2 + f3 + f4, arm * (f2 - f4), arm * (f3 - f1), yaw_per_thrust * (f1 - f2 + f3 - f4)], axis=-1
    )


def rotors_from_wrench(wrench: Array, arm: float, yaw_per_thrust: float) -> Array:
    """Rotor forces F1..F4 (..., 4) [N] that give `wrench` = (T, tau_x, tau_y, tau_z) (..., 4); the exact inverse."""
    xp = wrench.__array_namespace__()
    thrust, tx, ty, tz = (wrench[..., i] / 4 for i in range(4))
    roll, pitch, yaw = 2 * tx / arm, 2 * ty / arm, tz / yaw_per_thrust
    return xp.stack([thrust - pitch + yaw, thrust + roll - yaw, thrust + pitch + yaw, thrust - roll - yaw], axis=-1)
