"""The leader's controller: PID on the object's error (paper eq. 5), then roll and pitch by the linearised dynamics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from mjxball.arrays import Array, clipped, joined


def pid_command(error: Array, error_rate: Array, integral: Array, gains: Sequence[Any], *limits: float) -> Array:
    """`command` at yaw 0 for kp e + kd de/dt + ki int(e) [m/s2] (paper eq. 5), all (..., 3).

    `gains`: kp, kd, ki, each (3,) or a number; `limits`: the gravity and the limits that `command` takes.
    """
    xp = error.__array_namespace__()
    kp, kd, ki = (xp.asarray(gain, dtype=error.dtype) for gain in gains)
    return command(kp * error + kd * error_rate + ki * integral, 0.0, *limits)


def command(acceleration: Array, yaw: Array | float, gravity: float, tilt_limit: float, vertical_limit: float) -> Array:
    """(roll, pitch [rad], vertical acceleration [m/s2]) (..., 3) for a desired `acceleration` (..., 3).

    phi = (ax sin psi - ay cos psi) / g, theta = (ax cos psi + ay sin psi) / g at the desired `yaw`
    (the paper's equations after eq. 5; both drones fly at psi = 0), clipped to the limits.
    """
    ax, ay, az = (acceleration[..., i] for i in range(3))
    functions = math if isinstance(yaw, float) else yaw.__array_namespace__()
    cosine, sine = functions.cos(yaw), functions.sin(yaw)
    roll, pitch = (ax * sine - ay * cosine) / gravity, (ax * cosine + ay * sine) / gravity
    return clip_command(joined([roll, pitch, az]), tilt_limit, vertical_limit)


def clip_command(value: Array, tilt_limit: float, vertical_limit: float) -> Array:
    """Clip (roll, pitch, vertical acceleration) (..., 3) to +-(tilt_limit, tilt_limit, vertical_limit)."""
    xp = value.__array_namespace__()
    limit = xp.asarray([tilt_limit, tilt_limit, vertical_limit], dtype=value.dtype)
    return clipped(value, -limit, limit)
