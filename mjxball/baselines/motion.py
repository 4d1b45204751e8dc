"""Linear model of an assembly with ideal attitude loops, and the Kalman filter and position gains made from it.

One model serves pairs and teams: errors of O and their rates, both tilts with the torques of rotors and load, and the
lift. A controller filters the states that it names. Body axes, or axes turned about z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mjxball.baselines.assembly_model import AssemblyModel
from mjxball.baselines.linear import Filter, continuous_regulator, discretise, kalman
from mjxball.control.observation import OBSERVATION_SIZE

# Indices in the state. Along x: error [m], its rate [m/s], pitch [rad], its rate [rad/s], torque of the rotors [N m],
# of the load [N m], and its rate [N m/s]; along y the same about roll.
EX, VX, PITCH, PITCH_RATE, TORQUE, LOAD, LOAD_RATE = range(7)
EY, VY, ROLL, ROLL_RATE, ROLLING = range(7, 12)
# Error of the height [m], its rate [m/s], lift, and error of the lift [m/s2], which was not commanded.
EZ, VZ, LIFT, LIFT_ERROR = range(12, 16)
ROLL_LOAD, ROLL_LOAD_RATE = range(16, 18)  # as LOAD and LOAD_RATE, about roll
STATES = 18
AXES = (  # of roll and pitch, in the order of the first seven states
    (EY, VY, ROLL, ROLL_RATE, ROLLING, ROLL_LOAD, ROLL_LOAD_RATE),
    (EX, VX, PITCH, PITCH_RATE, TORQUE, LOAD, LOAD_RATE),
)
HEIGHT = VZ, LIFT, LIFT_ERROR
# Index in an observation.
SHOWN = {EX: 12, VX: 15, PITCH: 4, PITCH_RATE: 10, EY: 13, VY: 16, ROLL: 3, ROLL_RATE: 9, EZ: 14, VZ: 17}
TILT, VERTICAL = 0.15, 1.0  # values with a cost of 1 [rad], [m/s2]
PAIR_INERTIA = 0.0644  # of the pair about pitch, to which values of torque_walk refer [kg m2]


def noise(error: float = 3e-3, velocity: float = 2e-2, angle: float = 2e-3, rate: float = 2e-2) -> dict[int, float]:
    """Standard deviations of the measurements by index of the state: [m], [m/s], [rad], [rad/s]."""
    along, across = (dict(zip(axis, (error, velocity, angle, rate), strict=False)) for axis in reversed(AXES))
    return along | across | {EZ: error, VZ: velocity}


class Tuning(NamedTuple):
    """Parameters of a controller: costs, process noise of the states, time constants, limits."""

    position: float  # error with a cost of 1 [m]
    velocity: float  # with a cost of 1 [m/s]
    height: float  # error with a cost of 1 [m]
    climb: float  # with a cost of 1 [m/s]
    torque_walk: float  # noise intensity of the rate of the load's torque [(N m/s)2/s]
    lift_walk: float = 0.0  # of the error of the lift [(m/s2)2/s]
    acceleration_walk: float = 0.0  # of every velocity [(m/s)2/s]
    turn_walk: float = 0.0  # of roll and pitch rate [(rad/s)2/s]
    load_time: float = math.inf  # time constant with which the filter forgets the load's torque [s]
    rate_time: float = math.inf  # and its rate [s]
    lift_time: float = math.inf  # and the error of the lift [s]
    forecast_time: float = math.inf  # decay time of the rate of the load's torque in a plan [s]
    tilt_limit: float = 0.3  # of the tilt that position and velocity ask for [rad]
    lift_limit: float = 2.0  # likewise [m/s2]

    def walks(self, scale: tuple[float, float] = (1.0, 1.0)) -> dict[int, float]:
        """Noise intensities by index of the state; those of the load's torques times the squares of `scale`."""
        found = {LIFT_ERROR: self.lift_walk}
        for axis, (_, velocity, _, rate, _, _, growth) in enumerate(AXES):
            found[growth] = self.torque_walk * scale[axis] ** 2
            found[velocity], found[rate] = self.acceleration_walk, self.turn_walk
        return found | {VZ: self.acceleration_walk}


def motion(model: AssemblyModel, tuning: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """(a (18, 18), b (18, 3)) of x' = a x + b u; u is the sum of what all drones' commands ask for.

    u is roll and pitch torque [N m] and the mean vertical acceleration [m/s2]. a includes attitude loops and rotors.
    """
    a, b = np.zeros((STATES, STATES)), np.zeros((STATES, 3))
    for axis, (error, velocity, angle, rate, torque, load, growth) in enumerate(AXES):
        stiffness, damping = (len(model.own_mass) * gain[axis] for gain in (model.kp, model.kd))
        a[error, velocity] = a[angle, rate] = a[load, growth] = 1.0
        a[velocity, angle] = (1.0, -1.0)[axis] * model.gravity
        a[rate, [torque, load]] = 1.0 / model.inertia[axis]
        a[torque, [angle, rate, torque]] = np.array([-stiffness, -damping, -1.0]) / model.lag
        b[torque, axis] = 1.0 / model.lag
        a[load, load], a[growth, growth] = -1.0 / tuning.load_time, -1.0 / tuning.rate_time
    a[EZ, VZ], a[VZ, [LIFT, LIFT_ERROR]], a[LIFT, LIFT] = 1.0, -1.0, -1.0 / model.lag
    a[LIFT_ERROR, LIFT_ERROR], b[LIFT, 2] = -1.0 / tuning.lift_time, 1.0 / model.lag
    return a, b


def disturbance_filter(
    model: AssemblyModel,
    axes: tuple[int, ...],
    tuning: Tuning,
    deviations: Mapping[int, float],
    scale: tuple[float, float] = (1.0, 1.0),
) -> tuple[Filter, np.ndarray]:
    """(filter of the tilts and their torques, and of the lift if its error walks; (k, 18) its y from an observation).

    States: for each of `axes` angle, rate, torque of the rotors, of the load, its rate; then climb downwards, lift,
    error of the lift. Its u is that of `motion`; `deviations` as from `noise`, `scale` as for `Tuning.walks`.
    """
    states = [state for axis in axes for state in AXES[axis][2:]] + list(HEIGHT) * (tuning.lift_walk > 0.0)
    walks, measured = (
        {states.index(state): value for state, value in values.items() if state in states}
        for values in (tuning.walks(scale), deviations)
    )
    a, b = motion(model, tuning)
    sampled = discretise(a[np.ix_(states, states)], b[states], model.period)
    return kalman(*sampled, model.period, walks, measured), np.eye(OBSERVATION_SIZE)[
        [SHOWN[states[place]] for place in measured]
    ]


def position_gains(model: AssemblyModel, tuning: Tuning) -> np.ndarray:
    """Gains (2, 3, 18) of roll, pitch and vertical acceleration on an observation: for errors and rates, and for tilts.

    From LQRs of both tilts about their closed loops, and of the height.
    """
    tilt_cost = np.diag([tuning.position**-2, tuning.velocity**-2, 0.0, 0.0])
    height_cost = np.diag([tuning.height**-2, tuning.climb**-2])
    found = np.zeros((2, 3, OBSERVATION_SIZE))
    for axis, frequency in enumerate(model.natural_frequency):
        a = np.zeros((4, 4))
        a[0, 1] = a[2, 3] = 1.0
        a[1, 2] = (-1.0, 1.0)[axis] * model.gravity
        a[3, 2], a[3, 3] = -(frequency**2), -2.0 * model.damping * frequency
        b = np.array([[0.0], [0.0], [0.0], [frequency**2]])
        gains = continuous_regulator(a, b, tilt_cost, np.array([[TILT**-2]]))[0]
        places = [SHOWN[state] for state in AXES[axis][:4]]
        found[0, axis, places[:2]], found[1, axis, places[2:]] = gains[:2], -gains[2:]
    a, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    found[0, 2, [SHOWN[EZ], SHOWN[VZ]]] = continuous_regulator(a, b, height_cost, np.array([[VERTICAL**-2]]))[0]
    return found
