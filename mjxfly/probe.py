"""The first second of a flight on motion capture: low, turning about the stick to and fro, to show the axes. Pure.

A world that is mirrored or turned passes every check of a pair that stands. It shows when the pair turns: the measured
turn is not the gyroscope's (`measured.ImuWatch`). About its other axes a pair turns by itself as it lifts; about the
stick nothing turns it, and an error there would grow unseen until it is high and fast.
"""

from __future__ import annotations

import math

import numpy as np

TIME = 1.0  # [s]
LIFTED = 0.025  # [m] at which the laws take over, still climbing: axes are to be shown below 5 cm
HEIGHT = 0.04  # [m] of the goal meanwhile
TILT = math.radians(4)  # amplitude of roll or pitch
BEGIN, PERIOD = 0.3, 0.6  # [s] one cosine, which leaves neither speed nor offset behind


def command(elapsed: float, span: np.ndarray) -> np.ndarray:
    """What is added to both drones' commands (3,), roll, pitch [rad] and 0, `elapsed` [s] after the laws took over.

    `span` (3,) [m] is leader from follower.
    """
    phase = (elapsed - BEGIN) / PERIOD
    size = TILT * math.cos(2 * math.pi * phase) if 0 <= phase <= 1 else 0.0
    along = np.abs(span[:2]) / np.linalg.norm(span[:2])
    return np.array([size * along[0], size * along[1], 0.0])
