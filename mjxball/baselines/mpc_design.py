"""Matrices of model-predictive control: the filter and the LQR of `lqg`, and one command for all followers (ours).

Body axes. All N - 1 followers are assumed to send the same command.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import AssemblyModel, ideal_model, pair_model
from mjxball.baselines.hover_model import hover_model
from mjxball.baselines.lqg import feedback, filter_gain, regulated
from mjxball.baselines.lqg_tuning import Tuning
from mjxball.config import Config
from mjxball.control import mixer
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

NAME = "mpc"
ALIKE = 1e-6  # largest difference of a team's drones
SPARE = 0.04  # share of a rotor's largest force reserved for yaw and nonlinearities
# Both were found by `benchmarks/tuning.py`, for both conditions of the benchmark: of pairs, and of rings of drones.
PAIR = Tuning(
    position=0.0508,
    velocity=0.233,
    height=0.0817,
    climb=0.267,
    error_limit=0.206,
    tilt_limit=0.195,
    height_limit=0.173,
    climb_limit=5.94,
    load_walk=933,
    load_frequency=2.77,
    load_damping=0.246,
    load_time=13.5,
    wind_walk=0.132,
    wind_time=111,
    lift_walk=0.00458,
    lift_time=128,
    acceleration_walk=0.0112,
    turn_walk=0.128,
    velocity_noise=0.0233,
    angle_noise=0.00654,
    rate_noise=0.00474,
    loop_scale=0.938,
    delay=0.684,
)
TEAM = Tuning(
    position=0.0383,
    velocity=0.628,
    height=0.0654,
    climb=0.224,
    error_limit=0.0847,
    tilt_limit=0.143,
    height_limit=0.41,
    climb_limit=7.95,
    load_walk=1430,
    load_frequency=9.07,
    load_damping=0.377,
    load_time=1.48,
    wind_walk=0.0032,
    wind_time=4.21,
    lift_walk=0.00495,
    lift_time=7.55,
    acceleration_walk=0.00135,
    turn_walk=0.635,
    velocity_noise=0.0154,
    angle_noise=0.000481,
    rate_noise=0.018,
    loop_scale=0.914,
    delay=0.899,
)


class MpcDesign(NamedTuple):
    """The controller for one mass of the object: x <- A x + B u of the followers' command u, with the leader in A."""

    transition: Float[Array, "22 22"]  # A
    drive: Float[Array, "22 3"]  # B
    torque_drive: Float[Array, "22 2"]  # of additional roll and pitch torques of the rotors [N m]
    gain: Float[Array, "22 10"]  # of the filter
    measured: Float[Array, "10 22"]
    feedback: Float[Array, "3 22"]  # F of u = F x + E v
    correction: Float[Array, "3 3"]  # E, on a correction v of the mean of all drones' commands
    cost: Float[Array, " 3"]  # of the square of v
    led: Float[Array, "3 22"]  # the leader's command
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
    assembly = known_model(config)
    model = hover_model(config, assembly, tuning.load, object_mass=mass)
    found = feedback(model, tuning.costs, assembly.gravity)
    mean, led = found.position @ model.error + found.rows[3:6] + found.rows[6:9], model.led
    # What one command of all followers asks for: that of all drones minus the leader's.
    asked = model.commanded - model.led_drive
    to_followers = np.linalg.inv(asked)
    return MpcDesign(
        transition=model.with_leader,
        drive=model.drive @ asked,
        torque_drive=model.drive[:, :2] @ np.linalg.inv(model.inertia),
        gain=filter_gain(model, tuning, assembly.period),
        measured=model.measured,
        feedback=to_followers @ (model.commanded @ mean - model.led_drive @ led),
        correction=to_followers @ model.commanded,
        cost=np.diag(regulated(model, tuning.costs, assembly.gravity)[1]),
        led=led,
        far_limit=found.limit,
    )


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
