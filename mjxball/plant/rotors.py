"""Places of one drone's rotors and how they spin: on the body axes (plus) or between them (x)."""

from __future__ import annotations

import math
from typing import Any

# Rotors 1..4 along x and y, times `lever`: plus (paper eq. 2), and x as on a Crazyflie, front right first.
PLACES = {"plus": ((1, 0), (0, 1), (-1, 0), (0, -1)), "x": ((1, -1), (-1, -1), (-1, 1), (1, 1))}
SPIN = {"plus": (1, -1, 1, -1), "x": (-1, 1, -1, 1)}  # sign of the yaw moment of a positive force


def lever(arm: Any, layout: str) -> Any:
    """Lever of a rotor about the body axes [m]; `arm` is its distance from the drone's centre."""
    return arm if layout == "plus" else arm / math.sqrt(2)
