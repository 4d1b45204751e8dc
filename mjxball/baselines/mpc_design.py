"""What model-predictive control is built from: the pair's motion, its filter and its LQR, as matrices (ours)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from mjxball.baselines.assembly_model import AssemblyModel, pair_model
from mjxball.baselines.lqg_design import RATE_NOISE, TILT, VERTICAL, discretise, steady_gain
from mjxball.config import Config
from mjxball.control import mixer
from mjxball.plant import plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

Array = Any
NAME = "mpc"
STATES = 16
# Places in the state. Along x: error [m], its rate [m/s], pitch [rad], its rate [rad/s], torque of the rotors [N m], of
# the load [N m], and its rate [N m/s]; along y the same about roll, without a load.
EX, VX, PITCH, PITCH_RATE, TORQUE, LOAD, LOAD_RATE = range(7)
EY, VY, ROLL, ROLL_RATE, ROLLING = range(7, 12)
# Error of the height [m], its rate [m/s], lift and error of the lift [m/s2].
EZ, VZ, LIFT, LIFT_ERROR = range(12, STATES)
ERROR_NOISE, VELOCITY_NOISE, ANGLE_NOISE = 3e-3, 1.4e-2, 5e-3  # deviations of a measurement [m], [m/s], [rad]
MEASURED = {  # deviation of what is measured, by its place
    **{EX: ERROR_NOISE, VX: VELOCITY_NOISE, PITCH: ANGLE_NOISE, PITCH_RATE: RATE_NOISE},
    **{EY: ERROR_NOISE, VY: VELOCITY_NOISE, ROLL: ANGLE_NOISE, ROLL_RATE: RATE_NOISE},
    **{EZ: ERROR_NOISE, VZ: VELOCITY_NOISE},
}
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


class Design(NamedTuple):
    """The law for an object of one mass: x <- A x + B u of the follower's command u, the leader's law in A."""

    transition: Float[Array, "16 16"]  # A of the filter
    forecast: Float[Array, "16 16"]  # A of the plan
    drive: Float[Array, "16 3"]  # B
    torque_drive: Float[Array, "16 2"]  # of a roll and a pitch torque of the rotors [N m]
    gain: Float[Array, "16 10"]  # of the filter, on what is `MEASURED`
    feedback: Float[Array, "3 16"]  # F of u = F x + E v
    correction: Float[Array, "3 3"]  # E, on a correction v of the mean of both drones' commands
    cost: Float[Array, " 3"]  # of the square of v
    led: Float[Array, "3 16"]  # the leader's command
    far: Float[Array, "3 16"]  # part of the mean command that errors and their rates ask for
    far_limit: Float[Array, " 3"]  # roll and pitch [rad] and lift [m/s2] of the assembly, at most


class Limits(NamedTuple):
    """What commands and rotors of the follower may be, and what its attitude loop makes of a command."""

    command: Float[np.ndarray, " 3"]  # roll, pitch [rad], vertical acceleration [m/s2]
    rotor_force: float  # largest, less what is spared [N]
    rotors: Float[np.ndarray, "4 3"]  # rotor forces per lift [N], roll and pitch torque [N m]
    kp: Float[np.ndarray, " 2"]  # about roll and pitch [N m/rad]
    kd: Float[np.ndarray, " 2"]  # [N m s/rad]
    own_mass: float  # that it lifts besides its share of the object [kg]
    share: float
    torque_per_force: float  # [m]


def design(config: Config, tuning: MpcTuning, mass: float) -> Design:
    """The law for the pair of `config` with an object of `mass` [kg].

    Raises InputError unless the pair is free, along x and has ideal attitude loops.
    """
    pair = pair_model(config, NAME)
    lever = 0.5 * float(pair.mounts[0, 0] - pair.mounts[1, 0]) * float(pair.known_mass[0] + pair.share[0] * mass)
    a, b = _motion(config, pair, mass, lever)
    filtering, planning = a.copy(), a.copy()
    filtering[LOAD_RATE, LOAD_RATE], planning[LOAD_RATE, LOAD_RATE] = (
        -1.0 / tuning.load_time,
        -1.0 / tuning.forecast_time,
    )
    (open_loop, drive), (planned, _) = (discretise(each, b, pair.period) for each in (filtering, planning))
    led = _leaders_command(config)
    transition = open_loop + drive[:, :3] @ led
    mean, cost = _regulators(open_loop, drive[:, :3] + drive[:, 3:6], tuning)
    far = np.zeros((3, STATES))
    for row, states in enumerate(([EY, VY], [EX, VX], [EZ, VZ])):
        far[row, states] = mean[row, states]
    # About the target: the rotors' torque less what holds the load's, the lift less its error.
    mean[1, LOAD] += mean[1, TORQUE] - 0.5 / pair.kp[1]
    mean[1, LOAD_RATE] -= 0.5 * (pair.lag + 0.5 * pair.period) / pair.kp[1]
    mean[2, LIFT_ERROR] += mean[2, LIFT] - 1.0
    feedback, correction = 2.0 * mean - led, 2.0 * np.eye(3)
    uneven = lever / pair.kp[1]  # pitch command against the torque of vertical commands that differ by 1 m/s2
    feedback[1] += uneven * (led[2] - feedback[2])
    correction[1] -= uneven * correction[2]
    walks = {LOAD_RATE: tuning.torque_walk, LIFT_ERROR: tuning.lift_walk}
    walks |= dict.fromkeys((VX, VY, VZ), tuning.acceleration_walk)
    walks |= dict.fromkeys((PITCH_RATE, ROLL_RATE), tuning.turn_walk)
    return Design(
        transition=transition,
        forecast=planned + drive[:, :3] @ led,
        drive=drive[:, 3:6],
        torque_drive=drive[:, 6:],
        gain=steady_gain(transition, pair.period, walks, MEASURED),
        feedback=feedback,
        correction=correction,
        cost=cost,
        led=led,
        far=far,
        far_limit=np.array([tuning.tilt_limit, tuning.tilt_limit, tuning.lift_limit]),
    )


def _motion(config: Config, pair: AssemblyModel, mass: float, lever: float) -> tuple[np.ndarray, np.ndarray]:
    """(a (16, 16), b (16, 8)) of x' = a x + b (leader's command, follower's, roll and pitch torque).

    `lever`: torque per vertical acceleration of one drone [N m s2/m]. The rate of the load's torque stays as it is.
    """
    a, b = np.zeros((STATES, STATES)), np.zeros((STATES, 8))
    more = (mass - config.plant.object_mass) * plant_parameters(config.plant, config.attitude).object_inertia_per_mass
    for axis, sign, (error, velocity, angle, rate, torque) in (
        (0, 1.0, (EY, VY, ROLL, ROLL_RATE, ROLLING)),
        (1, -1.0, (EX, VX, PITCH, PITCH_RATE, TORQUE)),
    ):
        a[error, velocity] = a[angle, rate] = 1.0
        a[velocity, angle], a[rate, torque] = sign * pair.gravity, 1.0 / (pair.inertia[axis] + more[axis])
        a[torque, [angle, rate, torque]] = np.array([-2.0 * pair.kp[axis], -2.0 * pair.kd[axis], -1.0]) / pair.lag
        b[torque, [axis, 3 + axis, 6 + axis]] = np.array([pair.kp[axis], pair.kp[axis], 1.0]) / pair.lag
    a[PITCH_RATE, LOAD], a[LOAD, LOAD_RATE] = a[PITCH_RATE, TORQUE], 1.0
    a[EZ, VZ], a[VZ, [LIFT, LIFT_ERROR]], a[LIFT, LIFT] = 1.0, -1.0, -1.0 / pair.lag
    b[LIFT, [2, 5]], b[TORQUE, [2, 5]] = 0.5 / pair.lag, np.array([-lever, lever]) / pair.lag
    return a, b


def _leaders_command(config: Config) -> np.ndarray:
    """(3, 16) what the leader's PD law commands."""
    led, g = np.zeros((3, STATES)), config.plant.gravity
    kp, kd = (np.broadcast_to(gain, 3) for gain in (config.leader.kp, config.leader.kd))
    led[0, [EY, VY]], led[1, [EX, VX]] = np.array([-kp[1], -kd[1]]) / g, np.array([kp[0], kd[0]]) / g
    led[2, [EZ, VZ]] = kp[2], kd[2]
    return led


def _regulators(open_loop: np.ndarray, drive: np.ndarray, tuning: MpcTuning) -> tuple[np.ndarray, np.ndarray]:
    """(mean commands (3, 16) of the LQRs of roll, pitch and height, what a correction of each costs (3,)).

    `drive` (16, 3) of the mean of both drones' commands.
    """
    mean, cost = np.zeros((3, STATES)), np.zeros(3)
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
    """Of the follower of the pair of `config`."""
    pair, numbers, command = pair_model(config, NAME), plant_parameters(config.plant, config.attitude), config.command
    arm, most, layout = float(numbers.arm[1]), float(numbers.rotor_force_max[1]), config.plant.layout
    unit = mixer.turned(np.eye(4)[:3], -numbers.yaw[1])
    return Limits(
        command=np.array([command.tilt_limit, command.tilt_limit, command.vertical_limit]),
        rotor_force=(1.0 - SPARE) * most,
        rotors=mixer.rotors_from_wrench(unit, arm, float(numbers.yaw_per_thrust[1]), layout).T,
        kp=np.array(pair.kp),
        kd=np.array(pair.kd),
        own_mass=float(pair.known_mass[1]),
        share=float(pair.share[1]),
        torque_per_force=float(mixer.torque_per_force(arm, layout)),
    )
