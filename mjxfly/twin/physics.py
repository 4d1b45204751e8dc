"""`SimplePair`, a simple model of a pair without MuJoCo, and the choice of the model for a policy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.control import motors, rotations
from mjxball.errors import InputError
from mjxfly.packets import Setpoint, angles
from mjxfly.policy_setup import config_of, is_crazyflie
from mjxfly.setpoints import ForceCurve
from mjxfly.twin.conditions import COUPLED_ONLY, DELIVERED, QUIET, Conditions, DroneKind, Surroundings
from mjxfly.twin.pair import RUNNING, Pair, PairState, Report, SupervisorOutputs, remembered

CURVE = ForceCurve()
# Standard deviations of the reported states: the flight's checks take a stream that repeats exactly for a frozen one.
VELOCITY_NOISE, RATE_NOISE = 1e-3, 5e-3  # [m/s], [rad/s]
FASTEST = 30.0  # [rad/s] bound on the body rates; the second-order attitude model is not valid beyond it


@dataclass(frozen=True)
class SimplePlant:
    """Parameters of `SimplePair`."""

    mass: float = 0.07  # total [kg]
    mounts: tuple[tuple[float, float, float], tuple[float, float, float]] = ((0.0, -0.15, 0.0), (0.0, 0.15, 0.0))  # [m]
    inertia: float = 1.5e-3  # about the axes across the stick [kg m2]
    frequency: float = 9.0  # natural frequency of the attitude with both drones' motors on [rad/s]
    damping: float = 0.9  # its damping ratio
    motor_lag: float = 0.05  # [s]
    curve: ForceCurve = CURVE
    gravity: float = 9.81  # [m/s2]
    full: float = 4.1  # battery without load [V]
    sag: float = 0.35  # at full thrust [V]
    drain: float = 0.0008  # at full thrust [V/s]


class SimplePair:
    """Implements `Pair` by one rigid body with second-order attitude dynamics, thrust lag and batteries.

    Its motors are those of `SimplePlant`, whatever the `kind`. Raises InputError for `surroundings` that it does not
    simulate.
    """

    cg_offset = math.nan
    rotor_force = np.zeros((2, 4))  # not modelled

    def __init__(
        self,
        plant: SimplePlant = SimplePlant(),
        kind: DroneKind = DELIVERED,
        surroundings: Surroundings = QUIET,
    ):
        for name in COUPLED_ONLY:
            if getattr(surroundings, name) != getattr(QUIET, name):
                raise InputError(f"the twin of other plants than Crazyflies does not simulate surroundings.{name}")
        self.plant, self.kind, self.surroundings = plant, kind, surroundings
        self._mounts = np.array(plant.mounts)
        self._random = np.random.default_rng(surroundings.seed)
        self._span = self._mounts[1] - self._mounts[0]
        self.start()

    def start(self) -> PairState:
        """See `Pair.start`."""
        self._position, self._velocity = np.zeros(3), np.zeros(3)
        self._quaternion, self._rates = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        self._thrust = np.zeros(2)  # of each drone [N]
        self._charge = np.full(2, self.plant.full)
        self._commands, self._poses = np.zeros(2), np.zeros((2, 7))
        return self._state(np.zeros(3), np.zeros(3))

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """Do nothing: the model has no gains."""

    def receive_pose(self, drone: int, position: np.ndarray, quaternion: np.ndarray | None) -> None:
        """Report the pose; there is no estimator that could use it."""
        self._poses[drone] = remembered(self._poses[drone], position, quaternion)

    def disturb(self, drone: int, what: str, value: float) -> None:
        """See `Pair.disturb`; InputError for all but "battery"."""
        if what != "battery":
            raise InputError(f"the twin of other plants than Crazyflies simulates the fault 'battery', not {what!r}")
        self._charge[drone] = value

    def advance(self, setpoints: np.ndarray, dt: float, modes: SupervisorOutputs = RUNNING) -> PairState:
        """See `Pair.advance`; a drone whose stabilizer hangs keeps its thrust and levels out."""
        plant = self.plant
        held = np.array(modes.held)[:, None]
        setpoints = np.where(held, np.array([[0.0, 0.0, 0.0, thrust] for thrust in self._commands]), setpoints)
        setpoints = setpoints * np.array(modes.run)[:, None]
        self._commands = setpoints[:, 3].copy()
        target = np.array([plant.curve.force(float(np.clip(row[3], 0, 60000))) for row in setpoints])
        self._thrust += (target - self._thrust) * -np.expm1(-dt / plant.motor_lag)
        self._charge = self._charge - dt * plant.drain * self._thrust / plant.curve.force(65535)
        matrix = rotations.matrix_from_quaternion(self._quaternion)
        force = self._thrust.sum() * matrix[:, 2] / plant.mass - np.array([0.0, 0.0, plant.gravity])
        turning = self._turning(setpoints, matrix)
        self._rates = np.clip(self._rates + dt * turning, -FASTEST, FASTEST)
        self._quaternion = rotations.integrate_quaternion(self._quaternion, dt * self._rates)
        self._velocity = self._velocity + dt * force
        self._position = self._position + dt * self._velocity
        if self._position[2] <= 0:
            force, turning = self._touch_ground(force), np.zeros(3)
        return self._state(force, turning)

    def _turning(self, setpoints: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """Angular acceleration (3,) [rad/s2]: both drones' attitude loops, and the moment of unequal thrusts."""
        plant, euler = self.plant, rotations.euler_from_matrix(matrix)
        turning = np.zeros(3)
        on = self._thrust > 0.01
        for row, running in zip(setpoints, on, strict=True):
            if running:
                roll, pitch, yaw_rate = angles(Setpoint(float(row[0]), float(row[1]), float(row[2]), 0))
                tilt = plant.frequency**2 * (np.array([roll, pitch]) - euler[:2])
                turning += 0.5 * np.append(tilt, 5.0 * (yaw_rate - self._rates[2]))
        turning[:2] -= on.mean() * 2 * plant.damping * plant.frequency * self._rates[:2]
        lifts = self._mounts[:, :2] * self._thrust[:, None]
        moment = np.array([lifts[:, 1].sum(), -lifts[:, 0].sum()])
        turning[:2] += moment / plant.inertia
        return turning

    def _touch_ground(self, force: np.ndarray) -> np.ndarray:
        """Ground contact: stop the pair and level the stick; return the acceleration (3,), 0 unless it lifts off."""
        lifting = force[2] > 0
        self._position = np.append(self._position[:2], 0.0)
        self._velocity = np.array([0.0, 0.0, max(self._velocity[2], 0.0) if lifting else 0.0])
        matrix = rotations.matrix_from_quaternion(self._quaternion)
        if matrix[2, 2] > 0:  # else it lies on its back
            yaw = rotations.euler_from_matrix(matrix)[2]
            self._quaternion = rotations.quaternion_from_euler(np.array([0.0, 0.0, yaw]))
        self._rates = np.zeros(3)
        return force if lifting else np.zeros(3)

    def _state(self, acceleration: np.ndarray, turning: np.ndarray) -> PairState:
        """Return the state; O's `acceleration` (3,) in the world [m/s2], angular one `turning` (3,), body [rad/s2]."""
        plant, matrix = self.plant, rotations.matrix_from_quaternion(self._quaternion)
        arms = self._mounts @ matrix.T
        swing = rotations.cross(self._rates, self._mounts) @ matrix.T
        load = self._thrust / plant.curve.force(65535)
        centripetal = rotations.cross(self._rates, rotations.cross(self._rates, self._mounts))
        at_origin = matrix.T @ (acceleration + np.array([0.0, 0.0, plant.gravity]))
        force = at_origin + rotations.cross(turning, self._mounts) + centripetal
        battery = self._charge - plant.sag * load
        pwm = np.stack([motors.compensated(motors.MOTORS["2.1"], self._commands, battery)] * 4, axis=1)
        position, velocity = self._position + arms, self._velocity + swing
        quaternion, rates = (np.stack([one] * 2) for one in (self._quaternion, self._rates))
        noise = self._random.standard_normal((2, 2, 3))
        reported = velocity + VELOCITY_NOISE * noise[0], quaternion, rates + RATE_NOISE * noise[1]
        drive = pwm, pwm, self._commands
        return PairState(
            position=position,
            velocity=velocity,
            quaternion=quaternion,
            rates=rates,
            specific_force=force,
            battery=battery,
            report=Report(position, *reported, force, np.full((2, 9), 1e-5), (2, 2), *drive, self._poses.copy()),
        )


def make_pair(
    metadata: Mapping[str, Any] | None = None, kind: DroneKind = DELIVERED, surroundings: Surroundings = QUIET
) -> Pair:
    """Return the physics of the rig in a policy's `metadata`; without it, the default `SimplePair`."""
    return (
        SimplePair(kind=kind, surroundings=surroundings)
        if metadata is None
        else pair_of(config_of(metadata), kind, surroundings)
    )


def pair_of(
    config: Config,
    kind: DroneKind = DELIVERED,
    surroundings: Surroundings = QUIET,
    conditions: Conditions | None = None,
) -> Pair:
    """Return the physics of the rig of `config`: `CoupledPair` for Crazyflies, else `SimplePair`.

    MuJoCo is imported only if needed. Raises InputError if it is not installed.
    """
    if not is_crazyflie(config):
        leader, follower = config.plant.pair
        mounts = (leader.mount, follower.mount)
        return SimplePair(SimplePlant(mounts=mounts), kind, surroundings)
    try:
        from mjxfly.twin.coupled import CoupledPair
    except ModuleNotFoundError as error:
        raise InputError(f"the twin of a Crazyflie pair needs {error.name}; pip install 'mjxball[fly]'") from None
    return CoupledPair(config, conditions, kind, surroundings)
