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


def blocked_shares(plant: Plant) -> Float[np.ndarray, "drones 4"]:
    """Share of each rotor's wake that falls on the object, a box or disc centred at O below the rotors (ours)."""
    far, angle = np.sqrt((np.arange(16) + 0.5) / 16), 2 * np.pi * (np.arange(32) + 0.5) / 32  # equal areas
    points = (far[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    half, shares = np.array(plant.object_size[:2]) / 2, np.empty((plant.count, 4))
    for number, (drone, arm) in enumerate(zip(plant.drones, plant.of_drones("arm"), strict=True)):
        c, s = np.cos(drone.yaw), np.sin(drone.yaw)
        own = lever(arm, plant.layout) * np.array(PLACES[plant.layout], dtype=float) @ [[c, s], [-s, c]]
        hit = np.array(drone.mount[:2]) + own[:, None] + WAKE * RADIUS * arm * points
        on = np.hypot(*(hit / half).T).T <= 1 if plant.is_disc else (np.abs(hit) <= half).all(axis=-1)
        shares[number] = on.mean(axis=-1)
    return shares
