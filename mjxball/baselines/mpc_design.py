"""Matrices of model-predictive control: the assembly's motion, its filter and its LQR (ours).

Body axes. All N - 1 followers are assumed to send the same command.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import AssemblyModel, ideal_model, pair_model
from mjxball.baselines.linear import discretise, kalman, regulator
from mjxball.baselines.motion import (
    AXES,
    EX,
    EY,
    EZ,
    LIFT,
    LIFT_ERROR,
    PAIR_INERTIA,
    STATES,
    TILT,
    VERTICAL,
    VX,
    VY,
    VZ,
    Tuning,
    motion,
    noise,
)
from mjxball.config import Config
from mjxball.control import mixer
from mjxball.control.followers import copy_gains
from mjxball.control.observation import ERROR, OBSERVATION_SIZE, copy_command
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

NAME = "mpc"
PAIR_STATES = STATES - 2  # without a load about roll
MEASURED = noise(velocity=1.4e-2, angle=5e-3)
MEMORY = 10.0  # time constant with which a team's follower forgets load torque and lift error [s]
ALIKE = 1e-6  # largest difference of a team's drones
SPARE = 0.04  # share of a rotor's largest force reserved for yaw and nonlinearities


PAIR = Tuning(
    position=0.161,
    velocity=0.481,
    height=0.225,
    climb=0.604,
    torque_walk=0.931,
    lift_walk=0.011,
    acceleration_walk=0.007,
    turn_walk=0.014,
    rate_time=0.687,
    forecast_time=0.26,
    tilt_limit=0.18,
    lift_limit=2.894,
)
TEAM = Tuning(
    position=0.183,
    velocity=0.605,
    height=0.174,
    climb=0.433,
    torque_walk=1.632,
    lift_walk=0.01,
    acceleration_walk=0.007,
    turn_walk=0.013,
    rate_time=0.233,
    forecast_time=0.217,
    tilt_limit=0.175,
    lift_limit=3.569,
)


class MpcDesign(NamedTuple):
    """The controller for one mass of the object: x <- A x + B u of the followers' command u, with the leader in A."""

    transition: Float[Array, "n n"]  # A of the filter; n = 16, of a team 18
    forecast: Float[Array, "n n"]  # A of the plan
    drive: Float[Array, "n 3"]  # B
    torque_drive: Float[Array, "n 2"]  # of additional roll and pitch torques of the rotors [N m]
    gain: Float[Array, "n 10"]  # of the filter, on the measurements `MEASURED`
    feedback: Float[Array, "3 n"]  # F of u = F x + E v
    correction: Float[Array, "3 3"]  # E, on a correction v of the mean of all drones' commands
    cost: Float[Array, " 3"]  # of the square of v
    led: Float[Array, "3 n"]  # the leader's command
    far: Float[Array, "3 n"]  # part of the mean command for errors and their rates
    far_limit: Float[Array, " 3"]  # limits of the assembly's roll and pitch [rad] and lift [m/s2]


class Limits(NamedTuple):
    """Limits of a follower's commands and rotors, and its attitude loop."""

    command: Float[np.ndarray, " 3"]  # roll, pitch [rad], vertical acceleration [m/s2]
    rotor_force: float  # largest, without the reserve `SPARE` [N]
    rotors: Float[np.ndarray, "4 3"]  # rotor forces per lift [N], roll and pitch torque [N m]
    kp: Float[np.ndarray, " 2"]  # about roll and pitch [N m/rad]
    kd: Float[np.ndarray, " 2"]  # [N m s/rad]
    own_mass: float  # mass that it lifts besides its share of the object [kg]
    load_share: float
    torque_per_force: float  # [m]


def known_model(config: Config) -> AssemblyModel:
    """Model of the assembly; InputError unless `config` is a free pair along x or a free team of equal drones."""
    if not config.plant.is_team:
        return pair_model(config, NAME)
    model, params = ideal_model(config, NAME), plant_parameters(config.plant, config.attitude)
    own = params.known_mass, params.load_share, params.arm, params.rotor_force_max, params.rotor_lag, params.yaw
    if max(float(np.ptp(part)) for part in own) > ALIKE:
        raise InputError(f"follower {NAME!r} flies teams of drones that are alike, with one plan for all; these differ")
    return model


def design(config: Config, tuning: Tuning, mass: float) -> MpcDesign:
    """The controller for the plant of `config` with an object of `mass` [kg]; InputError as from `known_model`."""
    nominal = known_model(config)
    model, levers = _with_object(config, nominal, mass), _levers(nominal, mass)
    roll, pitch = nominal.inertia
    team = config.plant.is_team
    scale, size = ((roll / PAIR_INERTIA, pitch / PAIR_INERTIA), STATES) if team else ((0.0, 1.0), PAIR_STATES)
    # Only the sum of the followers' estimates shows in the motion: without forgetting they would drift apart.
    memory = MEMORY if model.followers > 1 else math.inf
    filtering = motion(model, tuning._replace(load_time=memory, lift_time=memory))
    planning = motion(model, tuning._replace(rate_time=tuning.forecast_time))
    (open_loop, drive), (planned, _) = (discretise(*each, model.period) for each in (filtering, planning))
    of_leader, of_followers = (drive @ asked for asked in _asked(model, levers))
    led = _leaders_command(config)
    transition = (open_loop + of_leader @ led)[:size, :size]
    mean, cost = _regulators(open_loop, of_leader + of_followers, tuning)
    far = np.zeros((3, STATES))
    for row, states in enumerate(([EY, VY], [EX, VX], [EZ, VZ])):
        far[row, states] = mean[row, states]
    feedback, correction = _followers_command(model, _about_target(model, mean, 1.0 / memory), led, levers)
    walks = {state: walk for state, walk in tuning.walks(scale).items() if state < size}
    return MpcDesign(
        transition=transition,
        forecast=(planned + of_leader @ led)[:size, :size],
        drive=of_followers[:size],
        torque_drive=drive[:size, :2],
        gain=kalman(transition, of_followers[:size], model.period, walks, MEASURED).gain,
        feedback=feedback[:, :size],
        correction=correction,
        cost=cost,
        led=led[:, :size],
        far=far[:, :size],
        far_limit=np.array([tuning.tilt_limit, tuning.tilt_limit, tuning.lift_limit]),
    )


def _with_object(config: Config, model: AssemblyModel, mass: float) -> AssemblyModel:
    """`model` with an object of `mass` [kg] in place of the plant's."""
    per_mass = plant_parameters(config.plant, config.attitude).object_inertia_per_mass
    roll, pitch = np.array(model.inertia) + (mass - config.plant.object_mass) * np.asarray(per_mass)[:2]
    return model._replace(inertia=(float(roll), float(pitch)))


def _asked(model: AssemblyModel, levers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices (3, 3) from the leader's command and from all followers' to u of `motion`; `levers` from `_levers`.

    Unequal lift gives a torque, too.
    """
    count, found = len(model.own_mass), []
    for drones, lever in zip((1, count - 1), levers, strict=True):
        asked = drones * np.diag([*model.kp, 1.0 / count])
        asked[:2, 2] = lever
        found.append(asked)
    return found[0], found[1]


def _levers(model: AssemblyModel, mass: float) -> np.ndarray:
    """(2, 2) roll and pitch torque per 1 m/s2 more lift of the leader, and of all followers [N m s2/m]."""
    each = model.lever_torque(np.diag(model.carried(np.array(mass))))
    return np.stack([each[model.leader], each.sum(axis=0) - each[model.leader]])


def _about_target(model: AssemblyModel, mean: np.ndarray, forgets: float) -> np.ndarray:
    """`mean` (3, 18) about the target: rotor torque minus what holds the load's torque, lift minus its error.

    Both are taken as the filter predicts them once the rotors have followed. Otherwise the lag would amplify an
    estimate more than the filter forgets, and the followers' estimates would drift apart.
    """
    mean, ahead = mean.copy(), model.lag + 0.5 * model.period
    for axis, (*_, torque, load, rate) in enumerate(AXES):
        held = 1.0 / len(model.own_mass) / model.kp[axis]
        mean[axis, load] += mean[axis, torque] - held * (1.0 - forgets * ahead)
        mean[axis, rate] -= held * ahead
    mean[2, LIFT_ERROR] += mean[2, LIFT] - (1.0 - forgets * ahead)
    return mean


def _followers_command(
    model: AssemblyModel, mean: np.ndarray, led: np.ndarray, levers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(F (3, 18), E (3, 3)) of `MpcDesign`: the followers' command for the gains `mean` and the leader's `led`."""
    count, others = len(model.own_mass), model.followers
    feedback, correction = (count * mean - led) / others, count / others * np.eye(3)
    for axis in (0, 1):  # minus the torque of unequal lifts
        of_leader, of_followers = levers[:, axis] / others / model.kp[axis]
        feedback[axis] -= of_leader * led[2] + of_followers * feedback[2]
        correction[axis] -= of_followers * correction[2]
    return feedback, correction


def _leaders_command(config: Config) -> np.ndarray:
    """(3, 18) gains of the leader's PD controller on the state."""
    kp, kd, gravity, *_ = copy_gains(config)
    led, units = np.zeros((3, STATES)), np.eye(OBSERVATION_SIZE)[ERROR.start :]  # of each error and rate
    led[:, [EX, EY, EZ, VX, VY, VZ]] = copy_command(units, kp, kd, gravity, math.inf, math.inf).T
    return led


def _regulators(open_loop: np.ndarray, drive: np.ndarray, tuning: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """(gains (3, 18) of the mean command by LQRs of roll, pitch and height, cost (3,) of a correction of each).

    `drive` (18, 3) is that of the mean of all drones' commands.
    """
    mean, cost = np.zeros((3, STATES)), np.zeros(3)
    tilt, height = (tuning.position, tuning.velocity), (tuning.height, tuning.climb)
    axes = [(axis[:5], tilt, TILT) for axis in AXES]
    for row, (states, weights, scale) in enumerate([*axes, ((EZ, VZ, LIFT), height, VERTICAL)]):
        q = np.zeros(len(states))
        q[:2] = np.array(weights) ** -2.0
        gains, price = regulator(
            open_loop[np.ix_(states, states)], drive[states, row][:, None], np.diag(q), np.array([[scale**-2]])
        )
        mean[row, states], cost[row] = -gains[0], price.item()
    return mean, cost


def limits_of(config: Config) -> Limits:
    """Limits of each follower of `config`."""
    model, params, command = known_model(config), plant_parameters(config.plant, config.attitude), config.command
    one, layout = config.plant.followers[0], config.plant.layout
    arm, unit = float(params.arm[one]), mixer.turned(np.eye(4)[:3], -params.yaw[one])
    return Limits(
        command=np.array([command.tilt_limit, command.tilt_limit, command.vertical_limit]),
        rotor_force=(1.0 - SPARE) * float(params.rotor_force_max[one]),
        rotors=mixer.rotors_from_wrench(unit, arm, float(params.yaw_per_thrust[one]), layout).T,
        kp=np.array(model.kp),
        kd=np.array(model.kd),
        own_mass=float(model.known_mass[one]),
        load_share=float(model.load_share[one]),
        torque_per_force=float(mixer.torque_per_force(arm, layout)),
    )
