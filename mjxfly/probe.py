"""First second of a flight on motion capture: low, rocking about the stick, to verify the measured axes. Pure.

A mirrored or rotated frame passes all checks of a standing pair. It shows when the pair rotates: the measured rotation
then differs from the gyroscope's (`measured.ImuWatch`). Take-off rotates the pair about its other axes, but nothing
rotates it about the stick, where an error would grow unnoticed until the pair is high and fast.
"""

from __future__ import annotations

import math

import numpy as np

TIME = 1.0  # [s]
LIFTED = 0.025  # [m] height of O at which the controllers take over, climbing: axes are verified below 5 cm
HEIGHT = 0.04  # [m] largest height of the goal meanwhile
TILT = math.radians(4)  # amplitude of roll or pitch
BEGIN, PERIOD = 0.3, 0.6  # [s] of one cosine, which leaves neither velocity nor offset


def command(elapsed: float, span: np.ndarray) -> np.ndarray:
    """Increment of both drones' commands (3,), (roll, pitch [rad], 0), `elapsed` [s] after the controllers took over.

    `span` (3,) [m] is the leader's position relative to the follower.
    """
    phase = (elapsed - BEGIN) / PERIOD
    size = TILT * math.cos(2 * math.pi * phase) if 0 <= phase <= 1 else 0.0
    along = np.abs(span[:2]) / np.linalg.norm(span[:2])
    return np.array([size * along[0], size * along[1], 0.0])
