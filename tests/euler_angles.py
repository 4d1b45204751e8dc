"""The attitude of Euler angles, written out: what the package's quaternions are compared with."""

from __future__ import annotations

from mjxball.arrays import Array


def matrix_from_euler(euler: Array) -> Array:
    """R = Rz(psi) Rx(phi) Ry(theta) from `euler` = (phi, theta, psi) (..., 3) [rad] -> (..., 3, 3).

    The paper's Z-X-Y convention.
    """
    xp = euler.__array_namespace__()
    cf, ct, cp = (xp.cos(euler[..., i]) for i in range(3))
    sf, st, sp = (xp.sin(euler[..., i]) for i in range(3))
    rows = [
        xp.stack([cp * ct - sp * sf * st, -sp * cf, cp * st + sp * sf * ct], axis=-1),
        xp.stack([sp * ct + cp * sf * st, cp * cf, sp * st - cp * sf * ct], axis=-1),
        xp.stack([-cf * st, sf, cf * ct], axis=-1),
    ]
    return xp.stack(rows, axis=-2)
