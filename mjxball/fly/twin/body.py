"""The interface between the twin's firmware and the physics of the coupled pair."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class PairState(NamedTuple):
    """Both drones, leader first. World axes X forward, Y left, Z up; SI units."""

    position: np.ndarray  # (2, 3) of each drone's centre [m]
    velocity: np.ndarray  # (2, 3) [m/s]
    quaternion: np.ndarray  # (2, 4) body -> world (w, x, y, z)
    rates: np.ndarray  # (2, 3) about the body axes [rad/s]
    specific_force: np.ndarray  # (2, 3) what each accelerometer reads, body axes [m/s2]
    battery: np.ndarray  # (2,) [V]


class Pair(Protocol):
    """Physics of two drones and what they carry, motors and the firmware's attitude cascade included.

    The firmware's supervisor is not part of it: setpoints come after thrust lock, watchdog and stops.
    """

    def start(self) -> PairState:
        """Put everything back to rest on the ground (stand: at its lowest) and return that state."""
        ...

    def advance(self, setpoints: np.ndarray, dt: float) -> PairState:
        """Move `dt` [s] on, under `setpoints` (2, 4), and return the new state.

        A row is (roll [deg], pitch [deg], yaw rate [deg/s], thrust 0 .. 65535) as decoded from the wire: negative
        pitch moves toward +x, positive yaw rate turns clockwise from above. Thrust 0 means motors off.
        """
        ...

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """Parameter `name`, "pid_attitude.roll_kp", of `drone` (0 leader, 1 follower) was written; ignore others."""
