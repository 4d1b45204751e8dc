"""Identification of the pair: Gauss-Newton least squares on roll, roll rate and climb over windows of a log (ours).

`RigParameters` are common to all windows. Every window has its initial state and an unmeasured moment and force.
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
from mjxfly.policy_setup import motor_of
from mjxfly.rig.log import Log

Array = np.ndarray
WINDOW = 1.0  # [s]
FEWEST_WINDOWS, MOST_WINDOWS = 5, 40
NOISE = np.array([0.005, 0.02, 0.02])  # assumed measurement noise: roll [rad], roll rate [rad/s], climb [m/s]
LOWEST_THRUST = 15000.0  # [thrust units] a usable window keeps both drones above it
ROUNDS, STEPS = 3, 4  # replays of the log; Gauss-Newton steps after each
# The common unknowns: log thrust, log inertia, log lag, log unevenness, delay [s]. Steps of the difference quotients
# (small where the effects of two unknowns are nearly collinear), prior standard deviations, largest change in one step.
DIFFERENCE = np.array([0.001, 0.002, 0.005, 0.001, 0.0004])
PRIOR = np.array([0.3, 0.7, 0.7, 0.05, 0.02])
LARGEST_CHANGE = np.array([0.2, 0.4, 0.4, 0.05, 0.01])
START_DIFFERENCE = np.array([0.0005, 0.002, 0.002, 0.02, 0.04, 0.08, 0.002])
COMMON, PER_WINDOW = len(DIFFERENCE), len(START_DIFFERENCE)  # numbers of unknowns
UNKNOWN_LIFT = 0.1  # [m/s2] standard deviation of `WindowStart.lift` from window to window
SHORTEST_LAG, LONGEST_DELAY = 0.005, 0.06  # [s]


class RigParameters(NamedTuple):
    """The identified parameters, n candidates at once; each (n,)."""

    thrust: Array  # factor on the force of every motor
    inertia: Array  # roll inertia about O [kg m2]
    lag: Array  # motors' time constant [s]
    uneven: Array  # log of the leader's force factor over `thrust`; the follower's is the negative
    delay: Array  # from sending a setpoint to its effect in the logged state, without the motors' lag [s]

    @property
    def factors(self) -> Array:
        """(n, 2, 1) on the motor forces of leader and follower."""
        return (self.thrust[:, None] * np.exp(self.uneven[:, None] * np.array([1.0, -1.0])))[..., None]


class WindowStart(NamedTuple):
    """Initial state of a window, and its unmeasured moment and force; each (n,)."""

    roll: Array  # [rad]
    rate: Array  # [rad/s]
    climb: Array  # [m/s]
    turning: Array  # unmodelled angular acceleration, such as that of the ball's moment, at the start [rad/s2]
    growing: Array  # its first time derivative [rad/s3]
    bending: Array  # half its second time derivative [rad/s4]
    lift: Array  # unmodelled vertical acceleration, such as that of the battery's charge [m/s2]


class CascadeHistory(NamedTuple):
    """Cascade states and motor forces of both drones at the K ticks of the log."""

    loops: Array  # (K, 2, 13)
    force: Array  # (K, 2, 4) by the nominal motor curve [N]


class MotorModel(NamedTuple):
    """Map from the cascade's mixed thrust commands to the motors' steady force."""

    compensate: Callable[[Array], Array] | None  # battery compensation, an argument of `crazyflie.cascade`
    force: Callable[[Array], Array]  # [N] as a function of the cascade's output


def motor_model(config: Config, log: Log) -> MotorModel:
    """Return the motor model of the firmware that flew; battery compensation uses `log.volts` or a usual voltage."""
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
    """Run both drones' cascades and motors on the logged attitude, rates and setpoints, with one candidate (n = 1)."""
    autopilot, motor = config.autopilot, motor_model(config, log)
    both = np.stack([log.euler] * 2, axis=1), np.stack([log.rates] * 2, axis=1)
    loops = crazyflie.start_loops(both[0][0], both[1][0])
    lag, late = parameters.lag[0], round(float(parameters.delay[0]) / crazyflie.PERIOD)
    force = np.stack([crazyflie.motor_force(autopilot.motor_curve, log.setpoints[0, :, 3])] * 4, axis=-1)
    keep = math.exp(-crazyflie.PERIOD / lag)
    shares = crazyflie.integral_shares(np, autopilot, float)
    loops_history, force_history = [], []
    for tick in range(len(log.euler)):
        loops_history.append(loops)
        force_history.append(force)
        sent = log.setpoints[max(tick - late, 0)]
        measured = both[0][tick], both[1][tick]
        loops, command = crazyflie.cascade(autopilot, loops, sent, *measured, shares, motor.compensate)
        target = motor.force(command)
        force = target + keep * (force - target)
    return CascadeHistory(np.stack(loops_history), np.stack(force_history))


def simulate_windows(
    config: Config,
    log: Log,
    history: CascadeHistory,
    begins: Array,
    ticks: int,
    parameters: RigParameters,
    start: WindowStart,
) -> Array:
    """Simulate n windows of `ticks` ticks that begin at ticks `begins` (n,).

    Returns roll [rad], roll rate [rad/s], climb [m/s] (ticks / log.every, n, 3). Pitch and yaw are the log's.
    """
    autopilot, plant, h, motor = config.autopilot, config.plant, crazyflie.PERIOD, motor_model(config, log)
    mass, lever = pair_mass(config), np.array([drone.mount[1] for drone in plant.pair])
    keep = np.exp(-h / parameters.lag)[:, None, None]
    shares = crazyflie.integral_shares(np, autopilot, float)
    mean = (parameters.lag[:, None, None] / h) * (1 - keep)
    roll, rate, climb = start.roll, start.rate, start.climb
    loops, force = _initial_loops(log, history, begins, roll, rate)
    # The initial moment of uneven thrust belongs to `turning`: the fit could hardly separate the two.
    excess = (parameters.factors - parameters.thrust[:, None, None]) * force
    offset = (excess.sum(axis=-1) * lever).sum(axis=1)
    force = parameters.factors * force
    simulated = []
    for tick in range(ticks):
        if tick % log.every == 0:
            simulated.append(np.stack([roll, rate, climb], axis=-1))
        now = begins + tick
        euler, rates = log.euler[now].copy(), log.rates[now].copy()
        euler[:, 0], rates[:, 0] = roll, rate
        sent = _delayed(log.setpoints, now, parameters.delay / h)
        measured = [np.stack([v, v], axis=1) for v in (euler, rates)]
        loops, command = crazyflie.cascade(autopilot, loops, sent, measured[0], measured[1], shares, motor.compensate)
        target = parameters.factors * motor.force(command)
        acting = target + mean * (force - target)
        force = target + keep * (force - target)
        wrench = mixer.wrench_from_rotors(acting, plant.arm, plant.yaw_per_thrust, plant.layout)
        torque = (wrench[..., 1] + lever * wrench[..., 0]).sum(axis=1)
        level = np.cos(roll) * np.cos(euler[:, 1])
        climb = climb + h * (wrench[..., 0].sum(axis=1) * level / mass - plant.gravity + start.lift)
        unknown = start.turning + (start.growing + start.bending * (tick * h)) * (tick * h)
        rate = rate + h * ((torque - offset) / parameters.inertia + unknown)
        roll = roll + h * rate
    return np.stack(simulated)


def pair_mass(config: Config) -> float:
    """Mass of both drones and the object [kg]."""
    constants = plant_parameters(config.plant, config.attitude)
    return float(constants.drone_mass.sum()) + config.plant.object_mass


def _initial_loops(log: Log, history: CascadeHistory, begins: Array, roll: Array, rate: Array) -> tuple[Array, Array]:
    """Cascade states (n, 2, 13), last measurement replaced by `roll`, `rate` (n,); motor forces (n, 2, 4) [N]."""
    euler, rates = log.euler[begins].copy(), log.rates[begins].copy()
    euler[:, 0], rates[:, 0] = roll, rate
    measured = np.concatenate([crazyflie.to_firmware(euler), crazyflie.to_firmware(rates)], axis=-1)
    loops = history.loops[begins].copy()
    loops[..., 6:12] = measured[:, None]
    return loops, history.force[begins]


def _delayed(setpoints: Array, now: Array, ticks: Array) -> Array:
    """Setpoints (n, 2, 4) `ticks` (n,) before `now` (n,), interpolated linearly between two ticks."""
    when = np.maximum(now - ticks, 0.0)
    low = np.floor(when).astype(int)
    share = (when - low)[:, None, None]
    return (1 - share) * setpoints[low] + share * setpoints[np.minimum(low + 1, len(setpoints) - 1)]


class Estimate(NamedTuple):
    """Identified parameters with the standard deviations that the fit estimates."""

    thrust: float  # factor on the force of every motor
    inertia: float  # [kg m2]
    lag: float  # [s]
    delay: float  # [s]
    spread: tuple[float, float, float, float]  # standard deviations of thrust, inertia, lag (relative) and delay [s]
    misfit: float  # root mean square of the residuals, in units of the assumed noise
    windows: int
    uneven: float = 0.0  # log of the leader's force factor over `thrust`; the follower's is the negative
    uneven_spread: float = 1.0  # standard deviation of `uneven`


def identify(config: Config, log: Log) -> Estimate:
    """Fit the plant of `config` to `log`. Raises InputError for fewer than `FEWEST_WINDOWS` usable windows."""
    begins, ticks = _windows(log)
    nominal = np.array([0.0, np.log(inertia_about_o(config)[0]), np.log(config.plant.rotor_lag), 0.0, 0.01])
    common, starts = nominal.copy(), _starts(log, begins)
    residuals = spread = np.zeros(COMMON)
    for _ in range(ROUNDS):
        history = replay(config, log, _parameters(common[None]))
        for _ in range(STEPS):
            common, starts, residuals, spread = _step(config, log, history, begins, ticks, common, starts, nominal)
    misfit = float(np.sqrt(np.mean(residuals**2)))
    spread = spread * max(misfit, 1.0)
    thrust, inertia, lag = map(float, np.exp(common[:3]))
    uneven, delay = map(float, common[3:])
    deviations = (float(spread[0]), float(spread[1]), float(spread[2]), float(spread[4]))
    return Estimate(thrust, inertia, lag, delay, deviations, misfit, len(begins), uneven, float(spread[3]))


def _windows(log: Log) -> tuple[Array, int]:
    """Return the first ticks (n,) of consecutive windows over the usable parts of the log, and their length [ticks]."""
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
    """Initial guesses of `WindowStart`, (n, PER_WINDOW): the measured state, no unknown moment or force."""
    guess = np.zeros((len(begins), PER_WINDOW))
    guess[:, 0], guess[:, 1], guess[:, 2] = log.euler[begins, 0], log.rates[begins, 0], log.climb[begins]
    return guess


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
    starts: Array,
    nominal: Array,
) -> tuple[Array, Array, Array, Array]:
    """One Gauss-Newton step: (common, starts, residuals before it, standard deviations of `common`).

    The unknowns of single windows are eliminated from the normal equations (Schur complement).
    """
    residuals, jacobian = _linearize(config, log, history, begins, ticks, common, starts)
    lifts = np.zeros(COMMON + PER_WINDOW)
    lifts[-1] = 1 / UNKNOWN_LIFT
    normal, right = np.diag(1 / PRIOR**2), (nominal - common) / PRIOR**2
    eliminated = []
    for window, start in enumerate(starts):
        known = np.vstack([jacobian[:, window].T, lifts])
        rest = np.append(residuals[window], -start[-1] / UNKNOWN_LIFT)
        a, b = known[:, :COMMON], known[:, COMMON:]
        inverse = np.linalg.pinv(b)
        eliminated.append((inverse, a, rest))
        across = a - b @ (inverse @ a)
        normal = normal + across.T @ across
        right = right + across.T @ rest
    change = np.clip(np.linalg.solve(normal, right), -LARGEST_CHANGE, LARGEST_CHANGE)
    moved = np.stack([inverse @ (rest - a @ change) for inverse, a, rest in eliminated])
    after = common + change
    after[-1] = np.clip(after[-1], 0.0, LONGEST_DELAY)
    return after, starts + moved, residuals, np.sqrt(np.diag(np.linalg.inv(normal)))


def _linearize(
    config: Config, log: Log, history: CascadeHistory, begins: Array, ticks: int, common: Array, starts: Array
) -> tuple[Array, Array]:
    """Residuals (n, rows) and Jacobian (COMMON + PER_WINDOW, n, rows) of the simulation, in units of `NOISE`.

    The Jacobian's forward differences of all windows are simulated as one batch.
    """
    count, width = len(begins), 1 + COMMON + PER_WINDOW
    all_common = np.broadcast_to(common, (width, COMMON)).copy()
    all_common[1 : 1 + COMMON] += np.diag(DIFFERENCE)
    all_starts = np.broadcast_to(starts, (width, count, PER_WINDOW)).copy()
    all_starts[1 + COMMON :] += np.diag(START_DIFFERENCE)[:, None, :]
    parameters = _parameters(np.repeat(all_common, count, axis=0))
    start = WindowStart(*all_starts.reshape(-1, PER_WINDOW).T)
    simulated = simulate_windows(config, log, history, np.tile(begins, width), ticks, parameters, start)
    simulated = simulated.reshape(len(simulated), width, count, 3).transpose(1, 2, 0, 3)  # (width, n, rows, 3)
    when = begins[:, None] + np.arange(0, ticks, log.every)
    measured = np.stack([log.euler[when, 0], log.rates[when, 0], log.climb[when]], axis=-1)
    jacobian = ((simulated[1:] - simulated[0]) / NOISE).reshape(width - 1, count, -1)
    jacobian /= np.concatenate([DIFFERENCE, START_DIFFERENCE])[:, None, None]
    return ((measured - simulated[0]) / NOISE).reshape(count, -1), jacobian
