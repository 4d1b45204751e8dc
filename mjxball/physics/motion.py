"""Prescribed motions of the object's centre of gravity along the body x axis."""

from __future__ import annotations

from typing import Any, NamedTuple

Array = Any


class CgState(NamedTuple):
    """CG offset from O along body x, with consistent derivatives."""

    offset: Array  # (...) [m]
    rate: Array  # (...) [m/s]
    acceleration: Array  # (...) [m/s2]


def sine(time: Array, amplitude: Array, speed: Array, phase: Array) -> CgState:
    """c = A sin(Omega t + phase) and its two derivatives; `speed` is Omega [rad/s] (design section 4)."""
    angle = speed * time + phase
    xp = angle.__array_namespace__()
    offset = amplitude * xp.sin(angle)
    return CgState(offset, amplitude * speed * xp.cos(angle), -speed * speed * offset)
