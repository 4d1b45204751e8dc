"""Identification of the pair: its roll and climb over windows of a log fitted by least squares, all windows at once.

What is estimated is common to the windows; each has its own initial state and unmeasured moment and force.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie, mixer, motors
from mjxball.control.axes import inertia_about_o
from mjxball.control.crazyflie import PERIOD
from mjxball.errors import InputError
from mjxball.plant import plant_parameters
from mjxfly.card import motor_of
from mjxfly.rig.log import Log

Array = np.ndarray
WINDOW = 1.0  # [s]
FEWEST_WINDOWS, MOST_WINDOWS = 5, 40
NOISE = np.array([0.005, 0.02, 0.02])  # of roll [rad], its rate [rad/s], climb [m/s]
LOWEST_THRUST = 15000.0  # of both drones in a window that counts
ROUNDS, STEPS = 3, 4
# Logarithms of thrust, inertia, lag and of how uneven the thrust is, then the delay [s]; steps of differences, which
# must be small where two unknowns nearly do the same; prior widths; largest change.
DIFFERENCE = np.array([0.001, 0.002, 0.005, 0.001, 0.0004])
PRIOR = np.array([0.3, 0.7, 0.7, 0.05, 0.02])
LARGEST = np.array([0.2, 0.4, 0.4, 0.05, 0.01])
START_DIFFERENCE = np.array([0.0005, 0.002, 0.002, 0.02, 0.04, 0.08, 0.002])
COMMON, OWN = len(DIFFERENCE), len(START_DIFFERENCE)
UNKNOWN_LIFT = 0.1  # [m/s2] standard deviation of `WindowStart.lift` from window to window
SHORTEST_LAG, LONGEST_DELAY = 0.005, 0.06  # [s]


class RigParameters(NamedTuple):
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


class WindowStart(NamedTuple):
    """How a window begins, and the moment and the force in it that nobody measured; each (n,)."""

    roll: Array  # [rad]
    rate: Array  # [rad/s]
    climb: Array  # [m/s]
    turning: Array  # angular acceleration by the ball and what else is not modelled, at the start [rad/s2]
    growing: Array  # its change with time [rad/s3]
    bending: Array  # half its second derivative [rad/s4]
    lift: Array  # vertical acceleration by what is not modelled, such as the battery's charge [m/s2]


class CascadeHistory(NamedTuple):
    """What the loops and motors of the log went through, on all of its ticks."""

    loops: Array  # (K, 2, 13)
    force: Array  # (K, 2, 4) of motors on the motor curve itself [N]


class MotorModel(NamedTuple):
    """From what a cascade mixes to the motors' steady force."""

    compensate: Callable[[Array], Array] | None  # as for `crazyflie.cascade`
    force: Callable[[Array], Array]  # [N] of what the cascade returns


def motor_model(config: Config, log: Log) -> MotorModel:
    """That of the firmware that flew. One that compensates for the battery reaches full power at its voltage only."""
    curve, motor = config.autopilot.motor_curve, motor_of(config)
    if curve[0] > 0:
        return MotorModel(None, lambda command: crazyflie.motor_force(curve, command))
    volts = np.float64(motors.USUAL_BATTERY if log.volts is None else log.volts)
    share = curve[1] / motor.max_force
    return MotorModel(
        lambda thrust: motors.compensated(motor, thrust, volts),
        lambda pwm: share * motors.force(motor, pwm, volts),
    )


def replay(config: Config, log: Log, parameters: RigParameters) -> CascadeHistory:
    """Run both drones' cascades and motors through the log's own measurements, on one plant, `parameters` each (1,)."""
    law, motor = config.autopilot, motor_model(config, log)
    both = np.stack([log.euler] * 2, axis=1), np.stack([log.rates] * 2, axis=1)
    loops = crazyflie.start_loops(both[0][0], both[1][0])
    lag, late = parameters.lag[0], round(float(parameters.delay[0]) / crazyflie.PERIOD)
    force = np.stack([crazyflie.motor_force(law.motor_curve, log.setpoints[0, :, 3])] * 4, axis=-1)
    keep = math.exp(-crazyflie.PERIOD / lag)
    shares = crazyflie.integral_shares(np, law, float)
    kept_loops, kept_force = [], []
    for tick in range(len(log.euler)):
        kept_loops.append(loops)
        kept_force.append(force)
        sent = log.setpoints[max(tick - late, 0)]
        seen = both[0][tick], both[1][tick]
        loops, turned = crazyflie.cascade(law, loops, sent, *seen, shares, motor.compensate)
        target = motor.force(turned)
        force = target + keep * (force - target)
    return CascadeHistory(np.stack(kept_loops), np.stack(kept_force))


def fly_windows(
    config: Config,
    log: Log,
    history: CascadeHistory,
    begins: Array,
    ticks: int,
    parameters: RigParameters,
    start: WindowStart,
) -> Array:
    """Roll, roll rate, climb (ticks / every, n, 3) of n windows that begin at ticks `begins` (n,).

    Pitch and yaw are the log's.
    """
    law, plant, h, motor = config.autopilot, config.plant, crazyflie.PERIOD, motor_model(config, log)
    mass, lever = pair_mass(config), np.array([drone.mount[1] for drone in plant.pair])
    keep = np.exp(-h / parameters.lag)[:, None, None]
    shares = crazyflie.integral_shares(np, law, float)
    mean = (parameters.lag[:, None, None] / h) * (1 - keep)
    roll, rate, climb = start.roll, start.rate, start.climb
    loops, force = _begin(log, history, begins, roll, rate)
    # What uneven thrust does at the start is part of `turning`, or the two could hardly be told apart.
    excess = (parameters.factors - parameters.thrust[:, None, None]) * force
    known = (excess.sum(axis=-1) * lever).sum(axis=1)
    force = parameters.factors * force
    flown = []
    for tick in range(ticks):
        if tick % log.every == 0:
            flown.append(np.stack([roll, rate, climb], axis=-1))
        now = begins + tick
        euler, rates = log.euler[now].copy(), log.rates[now].copy()
        euler[:, 0], rates[:, 0] = roll, rate
        sent = _delayed(log.setpoints, now, parameters.delay / h)
        seen = [np.stack([v, v], axis=1) for v in (euler, rates)]
        loops, turned = crazyflie.cascade(law, loops, sent, seen[0], seen[1], shares, motor.compensate)
        target = parameters.factors * motor.force(turned)
        acting = target + mean * (force - target)
        force = target + keep * (force - target)
        wrench = mixer.wrench_from_rotors(acting, plant.arm, plant.yaw_per_thrust, plant.layout)
        torque = (wrench[..., 1] + lever * wrench[..., 0]).sum(axis=1)
        level = np.cos(roll) * np.cos(euler[:, 1])
        climb = climb + h * (wrench[..., 0].sum(axis=1) * level / mass - plant.gravity + start.lift)
        unknown = start.turning + (start.growing + start.bending * (tick * h)) * (tick * h)
        rate = rate + h * ((torque - known) / parameters.inertia + unknown)
        roll = roll + h * rate
    return np.stack(flown)


def pair_mass(config: Config) -> float:
    """All that flies [kg]."""
    constants = plant_parameters(config.plant, config.attitude)
    return float(constants.drone_mass.sum()) + config.plant.object_mass


def _begin(log: Log, history: CascadeHistory, begins: Array, roll: Array, rate: Array) -> tuple[Array, Array]:
    """(loops, forces) of the windows' first ticks; what was last measured is where the window starts."""
    euler, rates = log.euler[begins].copy(), log.rates[begins].copy()
    euler[:, 0], rates[:, 0] = roll, rate
    measured = np.concatenate([crazyflie.to_firmware(euler), crazyflie.to_firmware(rates)], axis=-1)
    loops = history.loops[begins].copy()
    loops[..., 6:12] = measured[:, None]
    return loops, history.force[begins]


def _delayed(setpoints: Array, now: Array, ticks: Array) -> Array:
    """Setpoints (n, 2, 4) as they were `ticks` (n,) before `now` (n,), between two ticks the mean by share."""
    when = np.maximum(now - ticks, 0.0)
    low = np.floor(when).astype(int)
    share = (when - low)[:, None, None]
    return (1 - share) * setpoints[low] + share * setpoints[np.minimum(low + 1, len(setpoints) - 1)]


class Estimate(NamedTuple):
    """What was identified, with one standard deviation of each by the fit's own account."""

    thrust: float  # factor on the force of every motor
    inertia: float  # [kg m2]
    lag: float  # [s]
    delay: float  # [s]
    spread: tuple[float, float, float, float]  # of thrust, inertia, lag (shares) and delay [s]
    misfit: float  # root mean square of what is left, in units of the assumed noise
    windows: int
    uneven: float = 0.0  # share by which the leader's force is above, and the follower's below, the factor `thrust`
    uneven_spread: float = 1.0


def identify(config: Config, log: Log) -> Estimate:
    """Fit the plant of `config` to `log`. Raises InputError if there is too little of it."""
    begins, ticks = _windows(log)
    nominal = np.array([0.0, np.log(inertia_about_o(config)[0]), np.log(config.plant.rotor_lag), 0.0, 0.01])
    common, own = nominal.copy(), _starts(log, begins)
    left = spread = np.zeros(COMMON)
    for _ in range(ROUNDS):
        history = replay(config, log, _parameters(common[None]))
        for _ in range(STEPS):
            common, own, left, spread = _step(config, log, history, begins, ticks, common, own, nominal)
    misfit = float(np.sqrt(np.mean(left**2)))
    spread = spread * max(misfit, 1.0)
    thrust, inertia, lag = map(float, np.exp(common[:3]))
    uneven, delay = map(float, common[3:])
    deviations = (float(spread[0]), float(spread[1]), float(spread[2]), float(spread[4]))
    return Estimate(thrust, inertia, lag, delay, deviations, misfit, len(begins), uneven, float(spread[3]))


def _windows(log: Log) -> tuple[Array, int]:
    """(n,) ticks at which windows begin, one after the other wherever the log can be used, and their length."""
    ticks, begins = round(WINDOW / PERIOD), []
    usable = log.usable & (log.setpoints[..., 3].min(axis=1) > LOWEST_THRUST)
    unusable = np.append(np.flatnonzero(~usable), len(usable))
    begin = log.every
    while begin + ticks < len(usable):
        next_unusable = unusable[np.searchsorted(unusable, begin)]
        if begin + ticks <= next_unusable:
            begins.append(begin)
            begin += ticks
        else:
            begin = int(next_unusable) + 1
    if len(begins) < FEWEST_WINDOWS:
        raise InputError(
            f"the log holds {len(begins)} s of flight that can be used; "
            f"{FEWEST_WINDOWS} s or more are needed, 20 s with steps are good"
        )
    chosen = np.array(begins, int)
    if len(chosen) > MOST_WINDOWS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_WINDOWS).astype(int)]
    return chosen, ticks


def _starts(log: Log, begins: Array) -> Array:
    """(n, OWN) first guesses of `WindowStart`."""
    found = np.zeros((len(begins), OWN))
    found[:, 0], found[:, 1], found[:, 2] = log.euler[begins, 0], log.rates[begins, 0], log.climb[begins]
    return found


def _parameters(common: Array) -> RigParameters:
    thrust, inertia, lag = np.exp(common[:, :3]).T
    uneven, delay = common[:, 3:].T
    return RigParameters(thrust, inertia, np.maximum(lag, SHORTEST_LAG), uneven, np.clip(delay, 0.0, LONGEST_DELAY))


def _step(
    config: Config,
    log: Log,
    history: CascadeHistory,
    begins: Array,
    ticks: int,
    common: Array,
    own: Array,
    nominal: Array,
) -> tuple[Array, Array, Array, Array]:
    """One Gauss-Newton step: (common, own, residuals before it, standard deviations of `common`).

    The windows' own unknowns are eliminated.
    """
    left, slopes = _slopes(config, log, history, begins, ticks, common, own)
    lifts = np.zeros(COMMON + OWN)
    lifts[-1] = 1 / UNKNOWN_LIFT
    normal, right = np.diag(1 / PRIOR**2), (nominal - common) / PRIOR**2
    eliminated = []
    for window, mine in enumerate(own):
        known = np.vstack([slopes[:, window].T, lifts])
        rest = np.append(left[window], -mine[-1] / UNKNOWN_LIFT)
        a, b = known[:, :COMMON], known[:, COMMON:]
        inverse = np.linalg.pinv(b)
        eliminated.append((inverse, a, rest))
        across = a - b @ (inverse @ a)
        normal = normal + across.T @ across
        right = right + across.T @ rest
    change = np.clip(np.linalg.solve(normal, right), -LARGEST, LARGEST)
    moved = np.stack([inverse @ (rest - a @ change) for inverse, a, rest in eliminated])
    after = common + change
    after[-1] = np.clip(after[-1], 0.0, LONGEST_DELAY)
    return after, own + moved, left, np.sqrt(np.diag(np.linalg.inv(normal)))


def _slopes(
    config: Config, log: Log, history: CascadeHistory, begins: Array, ticks: int, common: Array, own: Array
) -> tuple[Array, Array]:
    """Residuals (n, rows) and the slopes (COMMON + OWN, n, rows) of what is flown, both in units of `NOISE`.

    All difference quotients of all windows are flown together.
    """
    count, width = len(begins), 1 + COMMON + OWN
    commons = np.broadcast_to(common, (width, COMMON)).copy()
    commons[1 : 1 + COMMON] += np.diag(DIFFERENCE)
    owns = np.broadcast_to(own, (width, count, OWN)).copy()
    owns[1 + COMMON :] += np.diag(START_DIFFERENCE)[:, None, :]
    parameters, start = _parameters(np.repeat(commons, count, axis=0)), WindowStart(*owns.reshape(-1, OWN).T)
    flown = fly_windows(config, log, history, np.tile(begins, width), ticks, parameters, start)
    flown = flown.reshape(len(flown), width, count, 3).transpose(1, 2, 0, 3)  # (width, n, rows, 3)
    when = begins[:, None] + np.arange(0, ticks, log.every)
    seen = np.stack([log.euler[when, 0], log.rates[when, 0], log.climb[when]], axis=-1)
    slopes = ((flown[1:] - flown[0]) / NOISE).reshape(width - 1, count, -1)
    slopes /= np.concatenate([DIFFERENCE, START_DIFFERENCE])[:, None, None]
    return ((seen - flown[0]) / NOISE).reshape(count, -1), slopes
