"""Discrete-time linear model of an assembly with ideal attitude loops about its level hover at the goal (ours).

The state is that of the combined centre of gravity, because a force on O acts there: v' = R T e3 / M - g holds whatever
the load does, and O follows by p_O = p_CG - R (S + m c) / M, the reaction to the CG's motion included. Body axes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm

from mjxball.baselines.assembly_model import AssemblyModel
from mjxball.config import Config
from mjxball.control.followers import copy_gains
from mjxball.control.observation import ERROR, OBSERVATION_SIZE, copy_command
from mjxball.plant import plant_parameters
from mjxball.plant.parameters import point_inertia, rigid_mass, rigid_moment
from mjxball.plant.rotors import lag_weights

if TYPE_CHECKING:
    from jaxtyping import Float

# The state: error of the CG [m] and its rate [m/s] (x, y, z); roll, pitch [rad], their rates [rad/s], and the rotors'
# torques about the CG over the inertia [rad/s2]; the lift over the mass [m/s2]; torques of the load over the inertia
# [rad/s2] with two derivatives; acceleration by wind (x, y) and by errors of mass and thrust (z) [m/s2].
ERRORS, RATES, TILT, TURN, TORQUE, LIFT = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 8),
    slice(8, 10),
    slice(10, 12),
    slice(12, 13),
)
LOAD, LOAD_RATE, LOAD_CURVE, WIND, LIFT_ERROR = (
    slice(13, 15),
    slice(15, 17),
    slice(17, 19),
    slice(19, 21),
    slice(21, 22),
)
STATES = 22
ACROSS = np.array([[0.0, 1.0], [-1.0, 0.0]])  # from (roll, pitch) to (x, y): of an acceleration over g, or of m c g
# Indices in an observation of the measurements: error of O and its rate, roll, pitch and their rates.
MEASURED = (12, 13, 14, 15, 16, 17, 3, 4, 9, 10)


class LoadModel(NamedTuple):
    """How disturbances are assumed to change: d''' = -w^2 d' - 2 zeta w d'' about a slowly varying torque d."""

    frequency: float = 1.5  # w [rad/s]
    damping: float = 0.05  # zeta
    load_time: float = np.inf  # time constants with which torque, wind and error of the lift decay [s]
    wind_time: float = np.inf
    lift_time: float = np.inf


class HoverModel(NamedTuple):
    """x <- A x + B u every control period, for u = what all drones' commands ask for: torques over J, lift over M."""

    transition: Float[np.ndarray, "22 22"]  # A, attitude loops included
    drive: Float[np.ndarray, "22 3"]  # B
    commanded: Float[np.ndarray, "3 3"]  # u for the mean command (roll, pitch, vertical acceleration) of all drones
    error: Float[np.ndarray, "3 22"]  # error of O
    error_rate: Float[np.ndarray, "3 22"]
    rest: Float[np.ndarray, "2 22"]  # tilt command at which an attitude loop asks for no torque
    led: Float[np.ndarray, "3 22"]  # the leader's command
    led_drive: Float[np.ndarray, "3 3"]  # u for the leader's command
    inertia: Float[np.ndarray, "2 2"]  # J about the CG, roll and pitch, load at O [kg m2]
    mass: float  # M [kg]
    moment: Float[np.ndarray, " 2"]  # S of the drones [kg m]

    @property
    def measured(self) -> Float[np.ndarray, "10 22"]:
        """Measurements `MEASURED` of the state."""
        return np.vstack([self.error, self.error_rate, np.eye(STATES)[[*range(6, 10)]]])

    @property
    def with_leader(self) -> Float[np.ndarray, "22 22"]:
        """A with the leader's PD controller in the loop."""
        return self.transition + self.drive @ self.led_drive @ self.led


def hover_model(
    config: Config, assembly: AssemblyModel, load: LoadModel, loop_scale: float = 1.0, object_mass: float | None = None
) -> HoverModel:
    """The model for the plant of `config`, of the same integrator as `physics.step`.

    `loop_scale` is a factor on the attitude loops' natural frequency; `object_mass` [kg] that of the plant if None.
    """
    params, count = plant_parameters(config.plant, config.attitude), config.plant.count
    object_mass = config.plant.object_mass if object_mass is None else object_mass
    mass, moment = float(rigid_mass(params) + object_mass), rigid_moment(params)
    own = np.diag(object_mass * np.asarray(params.object_inertia_per_mass))
    inertia = (params.drone_inertia + own - point_inertia(moment) / mass)[:2, :2]
    over_inertia, place = np.linalg.inv(inertia), moment[:2] / mass
    kp, kd = np.array(assembly.kp) * loop_scale**2, np.array(assembly.kd) * loop_scale

    steps, h = config.timing.physics_steps, config.physics_step
    keep, mean = lag_weights(assembly.lag, None, h)
    eye = np.eye(STATES)
    drift = drift_of(load, h / 2)
    asked = np.zeros((3, STATES))  # rotor targets over inertia and mass
    asked[:2, TILT], asked[:2, TURN] = -over_inertia @ np.diag(count * kp), -over_inertia @ np.diag(count * kd)
    rotors = np.vstack([eye[TORQUE], eye[LIFT]])
    acting = asked + mean * (rotors - asked)
    kicked = drift.copy()
    kicked[3:5] += h * (-assembly.gravity * ACROSS @ drift[TILT] - drift[19:21])
    kicked[5:6] += h * (-acting[2:] - drift[21:22])
    kicked[TURN] += h * (acting[:2] + drift[LOAD])
    kicked[10:13] = asked + keep * (rotors - asked)
    driven = np.zeros((STATES, 3))
    driven[5, 2], driven[TURN, :2] = -h * (1.0 - mean), h * (1.0 - mean) * np.eye(2)
    driven[10:13] = (1.0 - keep) * np.eye(3)
    step, push = drift @ kicked, drift @ driven
    transition, drive = eye, np.zeros((STATES, 3))
    for _ in range(steps):
        transition, drive = step @ transition, step @ drive + push

    # e_O = e_CG + R (S + m c) / M, whose m c is that of a torque g m c about pitch and -g m c about roll.
    error, rate = eye[ERRORS].copy(), eye[RATES].copy()
    reaction = ACROSS @ inertia / (assembly.gravity * mass)
    error[:2, LOAD], rate[:2, LOAD_RATE] = reaction, reaction
    error[2, TILT] = rate[2, TURN] = np.array([place[1], -place[0]])
    led = leader_gains(config) @ np.vstack([error, rate])
    carried = assembly.carried(np.array(object_mass))
    lever = (assembly.mounts - place) @ ACROSS.T
    lead = assembly.leader
    led_drive = np.zeros((3, 3))
    led_drive[:2, :2] = over_inertia @ np.diag(kp)
    led_drive[:2, 2] = over_inertia @ (carried[lead] * lever[lead])
    led_drive[2, 2] = carried[lead] / carried.sum()
    return HoverModel(
        transition=transition,
        drive=drive,
        commanded=block_diag(over_inertia @ np.diag(count * kp), 1.0),
        error=error,
        error_rate=rate,
        rest=eye[TILT] + np.diag(kd / kp) @ eye[TURN],
        led=led,
        led_drive=led_drive,
        inertia=inertia,
        mass=mass,
        moment=moment[:2],
    )


def drift_of(load: LoadModel, seconds: float) -> np.ndarray:
    """(22, 22) the state `seconds` later with constant velocities; disturbances move on by themselves."""
    drift = np.eye(STATES)
    drift[ERRORS, RATES] = seconds * np.eye(3)
    drift[TILT, TURN] = seconds * np.eye(2)
    spring, damping = -(load.frequency**2), -2.0 * load.damping * load.frequency
    own = expm(seconds * np.array([[-1.0 / load.load_time, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, spring, damping]]))
    parts = (LOAD, LOAD_RATE, LOAD_CURVE)
    for row, values in zip(parts, own, strict=True):
        for column, value in zip(parts, values, strict=True):
            drift[row, column] = value * np.eye(2)
    left = -seconds / np.array([load.wind_time, load.wind_time, load.lift_time])
    drift[19:22, 19:22] = np.diag(np.exp(left))
    return drift


def leader_gains(config: Config) -> np.ndarray:
    """(3, 6) gains of the leader's PD controller on the error of O and its rate, without its limits."""
    kp, kd, gravity, *_ = copy_gains(config)
    return copy_command(np.eye(OBSERVATION_SIZE)[ERROR.start :], kp, kd, gravity, np.inf, np.inf).T
