"""Interface `Pair` of the physics of two drones and their object, and the states that it returns."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from mjxfly.twin.conditions import DroneKind, Surroundings


class Report(NamedTuple):
    """Estimates and commands in both drones' computers, leader first: the values that they log. SI units."""

    position: np.ndarray  # (2, 3) [m]
    velocity: np.ndarray  # (2, 3) in the world [m/s]
    quaternion: np.ndarray  # (2, 4) body -> world (w, x, y, z)
    rates: np.ndarray  # (2, 3) filtered gyroscopes [rad/s]
    acceleration: np.ndarray  # (2, 3) filtered accelerometers [m/s2]
    variance: np.ndarray  # (2, 9) of the Kalman filter: position, velocity, attitude; 0 if it never ran
    estimator: tuple[int, int]  # 1 complementary, 2 Kalman
    pwm: np.ndarray  # (2, 4) of the motors
    requested: np.ndarray  # (2, 4) PWM before clipping
    thrust: np.ndarray  # (2,) command of the controller [thrust units]
    pose: np.ndarray  # (2, 7) newest pose from outside: x, y, z [m], quaternion (x, y, z, w); 0 before the first


def remembered(before: np.ndarray, position: np.ndarray, quaternion: np.ndarray | None) -> np.ndarray:
    """Return the row `before` (7,) of `Report.pose` with a new `position` and, if given, `quaternion` (w, x, y, z)."""
    attitude = before[3:] if quaternion is None else np.roll(quaternion, -1)
    return np.concatenate([position, attitude])


class PairState(NamedTuple):
    """True state of both drones, leader first. World axes X forward, Y left, Z up; SI units."""

    position: np.ndarray  # (2, 3) of each drone's centre [m]
    velocity: np.ndarray  # (2, 3) [m/s]
    quaternion: np.ndarray  # (2, 4) body -> world (w, x, y, z)
    rates: np.ndarray  # (2, 3) about the body axes [rad/s]
    specific_force: np.ndarray  # (2, 3) noise-free accelerometer readings, body axes [m/s2]
    battery: np.ndarray  # (2,) [V]
    report: Report


class SupervisorOutputs(NamedTuple):
    """Outputs of the firmware's supervisors of leader and follower."""

    run: tuple[bool, bool] = (True, True)  # motors turn, at idle at least; else their PWM is 0
    held: tuple[bool, bool] = (False, False)  # the stabilizer hangs: PWM and estimate are frozen
    flying: tuple[bool, bool] = (True, True)


RUNNING = SupervisorOutputs()


class Pair(Protocol):
    """Physics of two drones and their object, with motors, and each firmware's estimator and cascade.

    The firmware's commander and supervisor are not part of it: setpoints have passed thrust lock, watchdog and stops.
    """

    kind: DroneKind
    surroundings: Surroundings

    @property
    def cg_offset(self) -> float:
        """CG offset from O along the stick [m]; NaN if the model has none."""
        ...

    @property
    def rotor_force(self) -> np.ndarray:
        """(2, 4) rotor forces of leader and follower [N]."""
        ...

    def start(self) -> PairState:
        """Reset everything to rest on the ground (stand: at its lowest position) and return that state."""
        ...

    def advance(self, setpoints: np.ndarray, dt: float, modes: SupervisorOutputs = RUNNING) -> PairState:
        """Simulate `dt` [s] under `setpoints` (2, 4) and return the new state.

        A row is (roll [deg], pitch [deg], yaw rate [deg/s], thrust 0 .. 65535) as decoded from the wire: negative
        pitch moves toward +x, positive yaw rate turns clockwise from above. Thrust 0 means motors off, or at idle.
        """
        ...

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """Apply a written parameter of `drone` (0 leader, 1 follower), "pid_attitude.roll_kp" say; ignore others."""

    def receive_pose(self, drone: int, position: np.ndarray, quaternion: np.ndarray | None) -> None:
        """Handle a pose that the laptop sent: `position` (3,) [m] and, if known, `quaternion` (4,) (w, x, y, z)."""

    def disturb(self, drone: int, what: str, value: float) -> None:
        """Inject a fault of the body of `drone`, see `BodyFault`; InputError for one that is not simulated."""
