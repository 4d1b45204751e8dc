"""The firmware's cascade around the attitude of a body alone: `simulate` flies steps and lasting torques."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.control import crazyflie, mixer, rotations
from mjxball.control.axes import inertia_about_o
from mjxball.control.constants import hover

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


class Body(NamedTuple):
    """What the cascade turns."""

    inertia: np.ndarray  # (3,) principal, about the axes that it turns about [kg m2]
    hover: float  # motor command in hover
    arm: float  # [m]
    yaw_per_thrust: float  # [m]
    drones: int  # that turn it, all sent the same


def pair(config: Config) -> Body:
    """The two drones of `config` and their object, turning about O."""
    plant = config.plant
    return Body(inertia_about_o(config), hover(config)[0], plant.arm, plant.yaw_per_thrust, 2)


def simulate(body: Body, autopilot: Autopilot, trials: Sequence[Trial], seconds: float = 4.0) -> np.ndarray:
    """Roll, pitch, yaw (ticks + 1, trials, 3) [deg] of the hovering `body`."""
    h, count = crazyflie.PERIOD, len(trials)
    inertia = np.outer([trial.inertia for trial in trials], body.inertia)
    keep = np.exp(-h / np.array([trial.lag for trial in trials]))[:, None]
    outer = np.array([trial.torque for trial in trials])
    wait = np.array([round(trial.delay / h) for trial in trials])
    setpoint = np.array([[t.step[0], -t.step[1], 0.0, round(body.hover)] for t in trials])
    quaternion = rotations.quaternion_from_euler(np.radians([[0.0, 0.0, trial.yaw] for trial in trials]))
    rates = np.zeros((count, 3))
    level = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion * 0 + [1.0, 0, 0, 0]))
    loops = crazyflie.start_loops(level, rates)
    force = np.full((count, 4), float(crazyflie.motor_force(autopilot.motor_curve, np.array(round(body.hover)))))
    sent = [np.full((count, 4), float(round(body.hover)))] * (int(wait.max()) + 1)  # newest first
    seen = [np.array([[0.0, 0.0, trial.yaw] for trial in trials])]
    for _ in range(round(seconds / h)):
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))
        loops, motors = crazyflie.cascade(autopilot, loops, setpoint, euler, rates)
        sent = [motors, *sent[:-1]]
        late = np.stack(sent)[wait, np.arange(count)]
        target = crazyflie.motor_force(autopilot.motor_curve, late)
        force = target + keep * (force - target)
        torque = outer + body.drones * mixer.wrench_from_rotors(force, body.arm, body.yaw_per_thrust, "x")[:, 1:]
        upset = (np.abs(seen[-1][:, :2]) > UPSET).any(-1)[:, None]
        turned = rates + h * (torque - np.cross(rates, inertia * rates)) / inertia
        rates = np.where(upset, 0.0, turned)
        quaternion = rotations.integrate_quaternion(quaternion, h * rates)
        now = np.degrees(rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion)))
        seen.append(np.where(upset, seen[-1], now))
    return np.stack(seen)
