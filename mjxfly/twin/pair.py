"""Physics of two drones and what they carry: the interface that the twin's computers know it by."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from mjxfly.twin.conditions import DroneKind, Surroundings


class Report(NamedTuple):
    """What both drones' own computers hold, leader first: what they log, not the truth. SI units."""

    position: np.ndarray  # (2, 3) [m]
    velocity: np.ndarray  # (2, 3) in the world [m/s]
    quaternion: np.ndarray  # (2, 4) body -> world (w, x, y, z)
    rates: np.ndarray  # (2, 3) filtered gyroscopes [rad/s]
    acceleration: np.ndarray  # (2, 3) filtered accelerometers [m/s2]
    variance: np.ndarray  # (2, 9) of the Kalman filter: position, velocity, attitude; 0 if it never ran
    estimator: tuple[int, int]  # 1 complementary, 2 Kalman
    pwm: np.ndarray  # (2, 4) of the motors
    requested: np.ndarray  # (2, 4) the same before its bounds
    thrust: np.ndarray  # (2,) command of the controller [thrust units]
    pose: np.ndarray  # (2, 7) newest pose from outside: x, y, z [m], quaternion (x, y, z, w); 0 before the first


def remembered(before: np.ndarray, position: np.ndarray, quaternion: np.ndarray | None) -> np.ndarray:
    """The row `before` of `Report.pose` after one more pose; without a `quaternion` (w, x, y, z) the old one stays."""
    turned = before[3:] if quaternion is None else np.roll(quaternion, -1)
    return np.concatenate([position, turned])


class PairState(NamedTuple):
    """Both drones, leader first. World axes X forward, Y left, Z up; SI units."""

    position: np.ndarray  # (2, 3) of each drone's centre [m]
    velocity: np.ndarray  # (2, 3) [m/s]
    quaternion: np.ndarray  # (2, 4) body -> world (w, x, y, z)
    rates: np.ndarray  # (2, 3) about the body axes [rad/s]
    specific_force: np.ndarray  # (2, 3) what each accelerometer would read without noise, body axes [m/s2]
    battery: np.ndarray  # (2,) [V]
    report: Report  # what the drones make of it


class Modes(NamedTuple):
    """What the supervisors say of leader and follower."""

    run: tuple[bool, bool] = (True, True)  # motors turn, if only at idle; else their PWM is 0
    held: tuple[bool, bool] = (False, False)  # the stabilizer hangs: PWM and estimate stay as they are
    flying: tuple[bool, bool] = (True, True)


RUNNING = Modes()


class Pair(Protocol):
    """Physics of two drones and what they carry, with motors and each firmware's estimator and cascade.

    The firmware's supervisor is not part of it: setpoints come after thrust lock, watchdog and stops.
    """

    kind: DroneKind
    surroundings: Surroundings

    @property
    def cg_offset(self) -> float:
        """Where the CG is, from O along the stick [m]; NaN if there is none that moves."""
        ...

    @property
    def rotor_force(self) -> np.ndarray:
        """(2, 4) of leader and follower [N]."""
        ...

    def start(self) -> PairState:
        """Put everything back to rest on the ground (stand: at its lowest) and return that state."""
        ...

    def advance(self, setpoints: np.ndarray, dt: float, modes: Modes = RUNNING) -> PairState:
        """Move `dt` [s] on, under `setpoints` (2, 4), and return the new state.

        A row is (roll [deg], pitch [deg], yaw rate [deg/s], thrust 0 .. 65535) as decoded from the wire: negative
        pitch moves toward +x, positive yaw rate turns clockwise from above. Thrust 0 means motors off, or at idle.
        """
        ...

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """Parameter `name`, "pid_attitude.roll_kp", of `drone` (0 leader, 1 follower) was written; ignore others."""

    def receive_pose(self, drone: int, position: np.ndarray, quaternion: np.ndarray | None) -> None:
        """The laptop sent `drone` its pose: `position` (3,) [m] and, if known, `quaternion` (4,) (w, x, y, z)."""

    def disturb(self, drone: int, what: str, value: float) -> None:
        """A fault of the body of `drone`: "pose" frozen, lost or jumping, "battery", "gain"; see `BodyFault`."""
