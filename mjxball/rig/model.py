"""Roll and climb of the pair over short windows of a log: the cascade closed around a plant that is sought."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie, mixer, motors
from mjxball.control.constants import plant_constants
from mjxball.fly.card import motor_of
from mjxball.rig.log import Log

Array = np.ndarray
USUAL_BATTERY = 3.7  # [V] in hover, where none was measured


class Sought(NamedTuple):
    """What is identified; each (n,)."""

    thrust: Array  # factor on the force of every motor
    inertia: Array  # about the axis across the stick [kg m2]
    lag: Array  # of the motors [s]
    uneven: Array  # logarithm of the leader's force over what both drones' mean factor gives; minus the follower's
    delay: Array  # from sending a setpoint to its part in what the state shows, without the motors' lag [s]

    @property
    def factors(self) -> Array:
        """(n, 2, 1) on the motor forces of leader and follower."""
        return (self.thrust[:, None] * np.exp(self.uneven[:, None] * np.array([1.0, -1.0])))[..., None]


class Start(NamedTuple):
    """How a window begins, and the moment and the force in it that nobody measured; each (n,)."""

    roll: Array  # [rad]
    rate: Array  # [rad/s]
    climb: Array  # [m/s]
    turning: Array  # angular acceleration by the ball and what else is not modelled, at the start [rad/s2]
    growing: Array  # its change with time [rad/s3]
    bending: Array  # half its second derivative [rad/s4]
    lift: Array  # vertical acceleration by what is not modelled, such as the battery's charge [m/s2]


class Passed(NamedTuple):
    """What the loops and motors of the log went through, on all of its ticks."""

    loops: Array  # (K, 2, 13)
    force: Array  # (K, 2, 4) of motors on the motor curve itself [N]


class Drive(NamedTuple):
    """From what a cascade mixes to the motors' steady force."""

    compensate: Callable[[Array], Array] | None  # as for `crazyflie.cascade`
    force: Callable[[Array], Array]  # [N] of what the cascade returns


def drive_of(config: Config, log: Log) -> Drive:
    """That of the firmware that flew. One that compensates for the battery reaches full power at its voltage only."""
    curve, motor = config.autopilot.motor_curve, motor_of(config)
    if curve[0] > 0:
        return Drive(None, lambda command: crazyflie.motor_force(curve, command))
    volts = np.float64(USUAL_BATTERY if log.volts is None else log.volts)
    share = curve[1] / motor.most
    return Drive(
        lambda thrust: motors.compensated(motor, thrust, volts),
        lambda pwm: share * motors.force(motor, pwm, volts),
    )


def replay(config: Config, log: Log, sought: Sought) -> Passed:
    """Run both drones' cascades and motors through the log's own measurements; `sought` holds one plant, each (1,)."""
    law, drive = config.autopilot, drive_of(config, log)
    both = np.stack([log.euler] * 2, axis=1), np.stack([log.rates] * 2, axis=1)
    loops = crazyflie.start_loops(both[0][0], both[1][0])
    lag, late = sought.lag[0], round(float(sought.delay[0]) / crazyflie.PERIOD)
    force = np.stack([crazyflie.motor_force(law.motor_curve, log.setpoints[0, :, 3])] * 4, axis=-1)
    keep = math.exp(-crazyflie.PERIOD / lag)
    shares = crazyflie.integral_shares(np, law, float)
    kept_loops, kept_force = [], []
    for tick in range(len(log.euler)):
        kept_loops.append(loops)
        kept_force.append(force)
        sent = log.setpoints[max(tick - late, 0)]
        seen = both[0][tick], both[1][tick]
        loops, turned = crazyflie.cascade(law, loops, sent, *seen, shares, drive.compensate)
        target = drive.force(turned)
        force = target + keep * (force - target)
    return Passed(np.stack(kept_loops), np.stack(kept_force))


def fly_windows(
    config: Config, log: Log, passed: Passed, begins: Array, ticks: int, sought: Sought, start: Start
) -> Array:
    """Roll, roll rate, climb (ticks / every, n, 3) of n windows that begin at ticks `begins` (n,).

    Pitch and yaw are the log's.
    """
    law, plant, h, drive = config.autopilot, config.plant, crazyflie.PERIOD, drive_of(config, log)
    mass, lever = pair_mass(config), np.array([plant.leader_mount[1], plant.follower_mount[1]])
    keep = np.exp(-h / sought.lag)[:, None, None]
    shares = crazyflie.integral_shares(np, law, float)
    mean = (sought.lag[:, None, None] / h) * (1 - keep)
    roll, rate, climb = start.roll, start.rate, start.climb
    loops, force = _begin(log, passed, begins, roll, rate)
    # What uneven thrust does at the start is part of `turning`, or the two could hardly be told apart.
    excess = (sought.factors - sought.thrust[:, None, None]) * force
    known = (excess.sum(axis=-1) * lever).sum(axis=1)
    force = sought.factors * force
    flown = []
    for tick in range(ticks):
        if tick % log.every == 0:
            flown.append(np.stack([roll, rate, climb], axis=-1))
        now = begins + tick
        euler, rates = log.euler[now].copy(), log.rates[now].copy()
        euler[:, 0], rates[:, 0] = roll, rate
        sent = _delayed(log.setpoints, now, sought.delay / h)
        seen = [np.stack([v, v], axis=1) for v in (euler, rates)]
        loops, turned = crazyflie.cascade(law, loops, sent, seen[0], seen[1], shares, drive.compensate)
        target = sought.factors * drive.force(turned)
        acting = target + mean * (force - target)
        force = target + keep * (force - target)
        wrench = mixer.wrench_from_rotors(acting, plant.arm, plant.yaw_per_thrust, plant.layout)
        torque = (wrench[..., 1] + lever * wrench[..., 0]).sum(axis=1)
        level = np.cos(roll) * np.cos(euler[:, 1])
        climb = climb + h * (wrench[..., 0].sum(axis=1) * level / mass - plant.gravity + start.lift)
        unknown = start.turning + (start.growing + start.bending * (tick * h)) * (tick * h)
        rate = rate + h * ((torque - known) / sought.inertia + unknown)
        roll = roll + h * rate
    return np.stack(flown)


def pair_mass(config: Config) -> float:
    """All that flies [kg]."""
    constants = plant_constants(config.plant, config.attitude)
    return float(constants.drone_mass.sum()) + config.plant.object_mass


def _begin(log: Log, passed: Passed, begins: Array, roll: Array, rate: Array) -> tuple[Array, Array]:
    """(loops, forces) of the windows' first ticks; what was last measured is where the window starts."""
    euler, rates = log.euler[begins].copy(), log.rates[begins].copy()
    euler[:, 0], rates[:, 0] = roll, rate
    measured = np.concatenate([crazyflie.to_firmware(euler), crazyflie.to_firmware(rates)], axis=-1)
    loops = passed.loops[begins].copy()
    loops[..., 6:12] = measured[:, None]
    return loops, passed.force[begins]


def _delayed(setpoints: Array, now: Array, ticks: Array) -> Array:
    """Setpoints (n, 2, 4) as they were `ticks` (n,) before `now` (n,), between two ticks the mean by share."""
    when = np.maximum(now - ticks, 0.0)
    low = np.floor(when).astype(int)
    share = (when - low)[:, None, None]
    return (1 - share) * setpoints[low] + share * setpoints[np.minimum(low + 1, len(setpoints) - 1)]
