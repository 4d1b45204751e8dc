"""Places of one drone's rotors, how they spin, and what of their wakes falls on the object."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mjxball.config import Plant

if TYPE_CHECKING:
    from jaxtyping import Float

# Rotors 1..4 along x and y, times `lever`: plus (paper eq. 2), and x as on a Crazyflie, front right first.
PLACES = {"plus": ((1, 0), (0, 1), (-1, 0), (0, -1)), "x": ((1, -1), (-1, -1), (-1, 1), (1, 1))}
SPIN = {"plus": (1, -1, 1, -1), "x": (-1, 1, -1, 1)}  # sign of the yaw moment of a positive force
RADIUS = 0.5  # of a rotor over the arm: a Crazyflie's 23 mm over 46 mm, a 5 inch propeller's over 0.12 m
WAKE = 0.5**0.5  # radius of a rotor's wake, fully contracted, over its own (momentum theory)


def lever(arm: Any, layout: str) -> Any:
    """Lever of a rotor about the body axes [m]; `arm` is its distance from the drone's centre."""
    return arm if layout == "plus" else arm / math.sqrt(2)


def lag_weights(lag: Any, scale: Any, h: float) -> tuple[Any, Any]:
    """Weights of the old rotor force after a step of `h` [s] and in its mean over the step.

    `lag` is a number or (..., N) [s], `scale` (...) a factor on it, or None.
    """
    if scale is None and isinstance(lag, float):
        keep = math.exp(-h / lag)
        return keep, lag / h * (1 - keep)
    each = lag if scale is None else lag * scale[..., None]
    scaled = each[..., None]
    left = scaled.__array_namespace__().exp(-h / scaled)
    return left, scaled / h * (1 - left)


def blocked_shares(plant: Plant) -> Float[np.ndarray, "drones 4"]:
    """Share of each rotor's wake that falls on the object of `plant`, see `shares_on_object`."""
    mounts, yaw = np.array([drone.mount for drone in plant.drones]), np.array([drone.yaw for drone in plant.drones])
    half = np.array(plant.object_size[:2]) / 2
    return shares_on_object(mounts, yaw, np.array(plant.of_drones("arm")), plant.layout, half, plant.is_disc)


def shares_on_object(
    mounts: np.ndarray, yaw: np.ndarray, arm: np.ndarray, layout: str, half: np.ndarray, is_disc: bool
) -> Float[np.ndarray, "... drones 4"]:
    """Share of each rotor's wake that falls on an object centred at O below the rotors (ours).

    `mounts` (..., N, 3) [m], `yaw` (..., N) [rad], `arm` (..., N) [m]; the object is a box of half edges or an ellipse
    of half axes `half` (..., 2) [m].
    """
    far, angle = np.sqrt((np.arange(6) + 0.5) / 6), 2 * np.pi * (np.arange(16) + 0.5) / 16  # equal areas
    points = WAKE * RADIUS * (far[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    c, s, found = np.cos(yaw), np.sin(yaw), []
    for x, y in lever(1.0, layout) * np.array(PLACES[layout], dtype=float):
        rotor = mounts[..., :2] + arm[..., None] * np.stack([c * x - s * y, s * x + c * y], axis=-1)
        hit = (rotor[..., None, :] + arm[..., None, None] * points) / half[..., None, None, :]
        on = (hit * hit).sum(axis=-1) <= 1 if is_disc else (np.abs(hit) <= 1).all(axis=-1)
        found.append(on.mean(axis=-1))
    return np.stack(found, axis=-1)
