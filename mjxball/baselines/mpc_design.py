"""What model-predictive control is built from: the assembly's motion, its filter and its LQR, as matrices (ours).

Body axes. All N - 1 followers are taken to send the command of the one that plans.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import AssemblyModel, ideal_model, pair_model
from mjxball.baselines.lqg_design import RATE_NOISE, TILT, VERTICAL, discretise, steady_gain
from mjxball.config import Config
from mjxball.control import mixer
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

NAME = "mpc"
STATES, TEAM_STATES = 16, 18
# Places in the state. Along x: error [m], its rate [m/s], pitch [rad], its rate [rad/s], torque of the rotors [N m], of
# the load [N m], and its rate [N m/s]; along y the same about roll, without a load.
EX, VX, PITCH, PITCH_RATE, TORQUE, LOAD, LOAD_RATE = range(7)
EY, VY, ROLL, ROLL_RATE, ROLLING = range(7, 12)
# Error of the height [m], its rate [m/s], lift and error of the lift [m/s2].
EZ, VZ, LIFT, LIFT_ERROR = range(12, STATES)
ROLL_LOAD, ROLL_LOAD_RATE = range(STATES, TEAM_STATES)  # of teams: as LOAD and LOAD_RATE, about roll
ERROR_NOISE, VELOCITY_NOISE, ANGLE_NOISE = 3e-3, 1.4e-2, 5e-3  # deviations of a measurement [m], [m/s], [rad]
MEASURED = {  # deviation of what is measured, by its place
    **{EX: ERROR_NOISE, VX: VELOCITY_NOISE, PITCH: ANGLE_NOISE, PITCH_RATE: RATE_NOISE},
    **{EY: ERROR_NOISE, VY: VELOCITY_NOISE, ROLL: ANGLE_NOISE, ROLL_RATE: RATE_NOISE},
    **{EZ: ERROR_NOISE, VZ: VELOCITY_NOISE},
}
PAIR_INERTIA = 0.0644  # of the pair about pitch, for which `MpcTuning.torque_walk` is [kg m2]
# Axis, torque of the rotors, of the load and its rate.
LOADS = ((1, TORQUE, LOAD, LOAD_RATE), (0, ROLLING, ROLL_LOAD, ROLL_LOAD_RATE))
MEMORY = 10.0  # in which one of several followers forgets the load's torque and the error of the lift [s]
ALIKE = 1e-6  # by which drones of a team may differ
SPARE = 0.04  # share of a rotor's largest force that is left to yaw and to what is not linear


class MpcTuning(NamedTuple):
    """What is chosen of `mpc`; intensities are of the white noise that drives a state."""

    position: float = 0.161  # that costs 1 [m]
    velocity: float = 0.481  # that costs 1 [m/s]
    height: float = 0.225  # that costs 1 [m]
    climb: float = 0.604  # that costs 1 [m/s]
    torque_walk: float = 0.931  # of the rate of the load's torque [(N m/s)2/s]
    lift_walk: float = 0.011  # of the error of the lift [(m/s2)2/s]
    acceleration_walk: float = 0.007  # of every velocity [(m/s)2/s]
    turn_walk: float = 0.014  # of roll and pitch rate [(rad/s)2/s]
    load_time: float = 0.687  # in which the filter forgets the rate of the load's torque [s]
    forecast_time: float = 0.26  # in which that rate dies out in the plan [s]
    tilt_limit: float = 0.18  # of the assembly, as planned [rad]
    lift_limit: float = 2.894  # likewise [m/s2]


TEAM = MpcTuning(
    position=0.183,
    velocity=0.605,
    height=0.174,
    climb=0.433,
    torque_walk=1.632,
    lift_walk=0.01,
    acceleration_walk=0.007,
    turn_walk=0.013,
    load_time=0.233,
    forecast_time=0.217,
    tilt_limit=0.175,
    lift_limit=3.569,
)


class Design(NamedTuple):
    """The law for an object of one mass: x <- A x + B u of the followers' command u, the leader's law in A."""

    transition: Float[Array, "n n"]  # A of the filter; n = 16, of a team 18
    forecast: Float[Array, "n n"]  # A of the plan
    drive: Float[Array, "n 3"]  # B
    torque_drive: Float[Array, "n 2"]  # of a roll and a pitch torque of the rotors [N m]
    gain: Float[Array, "n 10"]  # of the filter, on what is `MEASURED`
    feedback: Float[Array, "3 n"]  # F of u = F x + E v
    correction: Float[Array, "3 3"]  # E, on a correction v of the mean of all drones' commands
    cost: Float[Array, " 3"]  # of the square of v
    led: Float[Array, "3 n"]  # the leader's command
    far: Float[Array, "3 n"]  # part of the mean command that errors and their rates ask for
    far_limit: Float[Array, " 3"]  # roll and pitch [rad] and lift [m/s2] of the assembly, at most


class Limits(NamedTuple):
    """What commands and rotors of a follower may be, and what its attitude loop makes of a command."""

    command: Float[np.ndarray, " 3"]  # roll, pitch [rad], vertical acceleration [m/s2]
    rotor_force: float  # largest, less what is spared [N]
    rotors: Float[np.ndarray, "4 3"]  # rotor forces per lift [N], roll and pitch torque [N m]
    kp: Float[np.ndarray, " 2"]  # about roll and pitch [N m/rad]
    kd: Float[np.ndarray, " 2"]  # [N m s/rad]
    own_mass: float  # that it lifts besides its share of the object [kg]
    load_share: float
    torque_per_force: float  # [m]


def known_model(config: Config) -> AssemblyModel:
    """The assembly; InputError unless `config` is a free pair along x, or a free team of drones that are alike."""
    if not config.plant.is_team:
        return pair_model(config, NAME)
    model, numbers = ideal_model(config, NAME), plant_parameters(config.plant, config.attitude)
    own = numbers.known_mass, numbers.load_share, numbers.arm, numbers.rotor_force_max, numbers.rotor_lag, numbers.yaw
    if max(float(np.ptp(part)) for part in own) > ALIKE:
        raise InputError(f"follower {NAME!r} flies teams of drones that are alike, with one plan for all; these differ")
    return model


def design(config: Config, tuning: MpcTuning, mass: float) -> Design:
    """The law for the plant of `config` with an object of `mass` [kg]; InputError as of `known_model`."""
    model, levers = known_model(config), _levers(known_model(config), mass)
    size, scales = (TEAM_STATES, model.inertia) if config.plant.is_team else (STATES, (0.0, PAIR_INERTIA))
    # The motion shows the sum alone of what followers estimate: what each kept for good would drift apart.
    forgets = 1.0 / MEMORY if model.followers > 1 else 0.0
    a, b = _motion(config, model, mass, levers)
    filtering, planning = a.copy(), a.copy()
    filtering[LIFT_ERROR, LIFT_ERROR] = -forgets
    walks = {LIFT_ERROR: tuning.lift_walk}
    for axis, _, load, rate in LOADS:
        filtering[load, load], filtering[rate, rate] = -forgets, -1.0 / tuning.load_time
        planning[rate, rate] = -1.0 / tuning.forecast_time
        walks[rate] = tuning.torque_walk * (scales[axis] / PAIR_INERTIA) ** 2
    walks |= dict.fromkeys((VX, VY, VZ), tuning.acceleration_walk)
    walks |= dict.fromkeys((PITCH_RATE, ROLL_RATE), tuning.turn_walk)
    (open_loop, drive), (planned, _) = (discretise(each, b, model.period) for each in (filtering, planning))
    led = _leaders_command(config)
    transition = (open_loop + drive[:, :3] @ led)[:size, :size]
    mean, cost = _regulators(open_loop, drive[:, :3] + drive[:, 3:6], tuning)
    far = np.zeros((3, TEAM_STATES))
    for row, states in enumerate(([EY, VY], [EX, VX], [EZ, VZ])):
        far[row, states] = mean[row, states]
    feedback, correction = _followers_command(model, _about_target(model, mean, forgets), led, levers)
    return Design(
        transition=transition,
        forecast=(planned + drive[:, :3] @ led)[:size, :size],
        drive=drive[:size, 3:6],
        torque_drive=drive[:size, 6:],
        gain=steady_gain(transition, model.period, {k: v for k, v in walks.items() if k < size}, MEASURED),
        feedback=feedback[:, :size],
        correction=correction,
        cost=cost,
        led=led[:, :size],
        far=far[:, :size],
        far_limit=np.array([tuning.tilt_limit, tuning.tilt_limit, tuning.lift_limit]),
    )


def _levers(model: AssemblyModel, mass: float) -> np.ndarray:
    """(2, 2) roll and pitch torque that the leader, that all followers make by lifting 1 m/s2 more [N m s2/m]."""
    each = model.lever_torque(np.diag(model.carried(np.array(mass))))
    return np.stack([each[model.leader], each.sum(axis=0) - each[model.leader]])


def _about_target(model: AssemblyModel, mean: np.ndarray, forgets: float) -> np.ndarray:
    """`mean` (3, 18) about the target: the rotors' torque less what holds the load's, the lift less its error.

    Both as the filter expects them to be once rotors have followed. Else the lag would make more of an estimate than
    the filter forgets, and the followers' estimates drift apart.
    """
    mean, ahead = mean.copy(), model.lag + 0.5 * model.period
    for axis, torque, load, rate in LOADS:
        held = 1.0 / len(model.own_mass) / model.kp[axis]
        mean[axis, load] += mean[axis, torque] - held * (1.0 - forgets * ahead)
        mean[axis, rate] -= held * ahead
    mean[2, LIFT_ERROR] += mean[2, LIFT] - (1.0 - forgets * ahead)
    return mean


def _followers_command(
    model: AssemblyModel, mean: np.ndarray, led: np.ndarray, levers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(F (3, 18), E (3, 3)) of `Design`: all followers' command for a `mean` (3, 18) with the leader's `led`."""
    count, others = len(model.own_mass), model.followers
    feedback, correction = (count * mean - led) / others, count / others * np.eye(3)
    for axis in (0, 1):  # less what uneven lifts turn
        of_leader, of_followers = levers[:, axis] / others / model.kp[axis]
        feedback[axis] -= of_leader * led[2] + of_followers * feedback[2]
        correction[axis] -= of_followers * correction[2]
    return feedback, correction


def _motion(config: Config, model: AssemblyModel, mass: float, levers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(a (18, 18), b (18, 8)) of x' = a x + b (leader's command, followers', roll and pitch torque).

    `levers` as of `_levers`. The rates of the load's torques stay as they are.
    """
    a, b, count = np.zeros((TEAM_STATES, TEAM_STATES)), np.zeros((TEAM_STATES, 8)), len(model.own_mass)
    more = (mass - config.plant.object_mass) * plant_parameters(config.plant, config.attitude).object_inertia_per_mass
    for axis, sign, (error, velocity, angle, rate, torque), (load, growth) in (
        (0, 1.0, (EY, VY, ROLL, ROLL_RATE, ROLLING), (ROLL_LOAD, ROLL_LOAD_RATE)),
        (1, -1.0, (EX, VX, PITCH, PITCH_RATE, TORQUE), (LOAD, LOAD_RATE)),
    ):
        kp, kd = model.kp[axis], model.kd[axis]
        a[error, velocity] = a[angle, rate] = a[load, growth] = 1.0
        a[velocity, angle] = sign * model.gravity
        a[rate, [torque, load]] = 1.0, 1.0
        a[rate] /= model.inertia[axis] + more[axis]
        a[torque, [angle, rate, torque]] = np.array([-count * kp, -count * kd, -1.0]) / model.lag
        b[torque, [axis, 3 + axis, 6 + axis]] = np.array([kp, (count - 1) * kp, 1.0]) / model.lag
        b[torque, [2, 5]] = levers[:, axis] / model.lag
    a[EZ, VZ], a[VZ, [LIFT, LIFT_ERROR]], a[LIFT, LIFT] = 1.0, -1.0, -1.0 / model.lag
    b[LIFT, [2, 5]] = np.array([1, count - 1]) / count / model.lag
    return a, b


def _leaders_command(config: Config) -> np.ndarray:
    """(3, 18) what the leader's PD law commands."""
    led, g = np.zeros((3, TEAM_STATES)), config.plant.gravity
    kp, kd = (np.broadcast_to(gain, 3) for gain in (config.leader.kp, config.leader.kd))
    led[0, [EY, VY]], led[1, [EX, VX]] = np.array([-kp[1], -kd[1]]) / g, np.array([kp[0], kd[0]]) / g
    led[2, [EZ, VZ]] = kp[2], kd[2]
    return led


def _regulators(open_loop: np.ndarray, drive: np.ndarray, tuning: MpcTuning) -> tuple[np.ndarray, np.ndarray]:
    """(mean commands (3, 18) of the LQRs of roll, pitch and height, what a correction of each costs (3,)).

    `drive` (18, 3) of the mean of all drones' commands.
    """
    mean, cost = np.zeros((3, TEAM_STATES)), np.zeros(3)
    tilt, height = (tuning.position, tuning.velocity), (tuning.height, tuning.climb)
    for row, states, weights, most in (
        (0, [EY, VY, ROLL, ROLL_RATE, ROLLING], tilt, TILT),
        (1, [EX, VX, PITCH, PITCH_RATE, TORQUE], tilt, TILT),
        (2, [EZ, VZ, LIFT], height, VERTICAL),
    ):
        a, b, q = open_loop[np.ix_(states, states)], drive[states, row][:, None], np.zeros(len(states))
        q[:2] = np.array(weights) ** -2.0
        ahead = solve_discrete_are(a, b, np.diag(q), [[most**-2]])
        cost[row] = most**-2 + (b.T @ ahead @ b).item()
        mean[row, states] = -(b.T @ ahead @ a)[0] / cost[row]
    return mean, cost


def limits_of(config: Config) -> Limits:
    """Of each follower of `config`."""
    model, numbers, command = known_model(config), plant_parameters(config.plant, config.attitude), config.command
    one, layout = config.plant.followers[0], config.plant.layout
    arm, unit = float(numbers.arm[one]), mixer.turned(np.eye(4)[:3], -numbers.yaw[one])
    return Limits(
        command=np.array([command.tilt_limit, command.tilt_limit, command.vertical_limit]),
        rotor_force=(1.0 - SPARE) * float(numbers.rotor_force_max[one]),
        rotors=mixer.rotors_from_wrench(unit, arm, float(numbers.yaw_per_thrust[one]), layout).T,
        kp=np.array(model.kp),
        kd=np.array(model.kd),
        own_mass=float(model.known_mass[one]),
        load_share=float(model.load_share[one]),
        torque_per_force=float(mixer.torque_per_force(arm, layout)),
    )
