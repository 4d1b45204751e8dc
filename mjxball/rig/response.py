"""The pair turning under the real cascade: 500 Hz, integral limits, mixing, saturation, motor curve and lag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.control import crazyflie, mixer, rotations
from mjxball.control.hover import hover
from mjxball.rig.axis import inertia_about_o

UPSET = 90.0  # attitude beyond which a case counts as diverged and is frozen [deg]


@dataclass(frozen=True)
class Trial:
    """One thing to try: a step of the commanded attitude or of an outer torque at time 0, on some plant."""

    step: tuple[float, float, float] = (0.0, 0.0, 0.0)  # roll, pitch [deg]; yaw is not commanded
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [N m]
    lag: float = 0.05  # of the motors [s]
    inertia: float = 1.0  # factor
    delay: float = 0.0  # of the motor commands, whole ticks of 2 ms [s]
    yaw: float = 0.0  # at the start, to be held at 0 [deg]


def turn(config: Config, autopilot: Autopilot, trials: Sequence[Trial], seconds: float = 4.0) -> np.ndarray:
    """Roll, pitch, yaw (ticks + 1, trials, 3) [deg] of the hovering pair, both drones sent the same."""
    plant, body = config.plant, inertia_about_o(config)
    return _turn(autopilot, trials, seconds, body, hover(config)[0], plant.arm, plant.yaw_per_thrust, 2)


def turn_alone(
    autopilot: Autopilot,
    trials: Sequence[Trial],
    inertia: tuple[float, float, float],
    mass: float,
    seconds: float = 3.0,
) -> np.ndarray:
    """The same of one drone by itself, `mass` [kg], principal `inertia` [kg m2]."""
    command = float(crazyflie.motor_command(autopilot.motor_curve, np.array(mass * 9.81 / 4)))
    return _turn(autopilot, trials, seconds, np.array(inertia), command, 0.046, 0.006, 1)


def _turn(
    autopilot: Autopilot,
    trials: Sequence[Trial],
    seconds: float,
    inertia: np.ndarray,
    command: float,
    arm: float,
    yaw_per_thrust: float,
    drones: int,
) -> np.ndarray:
    h, count = crazyflie.PERIOD, len(trials)
    inertia = np.outer([trial.inertia for trial in trials], inertia)
    keep = np.exp(-h / np.array([trial.lag for trial in trials]))[:, None]
    outer = np.array([trial.torque for trial in trials])
    wait = np.array([round(trial.delay / h) for trial in trials])
    setpoint = np.array([[t.step[0], -t.step[1], 0.0, round(command)] for t in trials])
    quaternion = rotations.quaternion_from_euler(np.radians([[0.0, 0.0, trial.yaw] for trial in trials]))
    rates = np.zeros((count, 3))
    level = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion * 0 + [1.0, 0, 0, 0]))
    loops = crazyflie.start_loops(level, rates)
    force = np.full((count, 4), float(crazyflie.motor_force(autopilot.motor_curve, np.array(round(command)))))
    sent = [np.full((count, 4), float(round(command)))] * (int(wait.max()) + 1)  # newest first
    seen = [np.array([[0.0, 0.0, trial.yaw] for trial in trials])]
    for _ in range(round(seconds / h)):
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))
        loops, motors = crazyflie.cascade(autopilot, loops, setpoint, euler, rates)
        sent = [motors, *sent[:-1]]
        late = np.stack(sent)[wait, np.arange(count)]
        target = crazyflie.motor_force(autopilot.motor_curve, late)
        force = target + keep * (force - target)
        torque = outer + drones * mixer.wrench_from_rotors(force, arm, yaw_per_thrust, "x")[:, 1:]
        upset = (np.abs(seen[-1][:, :2]) > UPSET).any(-1)[:, None]
        turned = rates + h * (torque - np.cross(rates, inertia * rates)) / inertia
        rates = np.where(upset, 0.0, turned)
        quaternion = rotations.integrate_quaternion(quaternion, h * rates)
        now = np.degrees(rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion)))
        seen.append(np.where(upset, seen[-1], now))
    return np.stack(seen)


def rise_and_overshoot(angle: np.ndarray, wanted: float) -> tuple[float, float]:
    """(time to 63 % [s], overshoot [%]) of an attitude (ticks + 1,) [deg] that was told to go to `wanted`."""
    share = angle / wanted
    return float(np.argmax(share >= 0.632)) * crazyflie.PERIOD, 100 * float(share.max() - 1)
