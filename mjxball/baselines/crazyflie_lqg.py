"""LQG for two Crazyflies on a stick along y, from a linear model with their cascades and the leader's PID (ours).

All quantities are deviations from the level hover at the goal; angles and torques are about body x.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import CopiedPid, assembly_model
from mjxball.baselines.linear import Filter, discretise, kalman, regulator, times
from mjxball.config import Config, ball_limit
from mjxball.control.constants import drone_loop, thrust_slopes
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.errors import InputError

# Values with a cost of 1: states and commands of the follower in their units, and the rates of its commands.
COSTS = {"y": 0.1, "vy": 0.5, "height": 0.1, "climb": 0.5, "rate": 3.0}
LOAD_COST = 1e-2  # of a rolling ball's torque [N m]
THRUST_DIFFERENCE, TILT = 0.05, 0.5  # thrust difference [N], roll command [rad]
CHANGES = (2.0, 20.0)  # [rad/s], [m/s3]
# Process noise of a state, as its standard deviation after one second.
PROCESS_NOISE = {"load_rate": 0.2, "load": 1e-3, "lift": 0.02, "rate": 0.1, "vy": 0.1, "climb": 0.1}
ROLLING_NOISE = 2e-3  # of `load_rate` if the model includes a rolling ball
# Measured states: index in an observation, sign, standard deviation of the noise.
MEASURED = {
    "y": (13, -1.0, 3e-3),
    "vy": (16, -1.0, 2e-2),
    "roll": (3, 1.0, 5e-3),
    "rate": (9, 1.0, 2e-2),
    "height": (14, -1.0, 3e-3),
    "climb": (17, -1.0, 2e-2),
}
ERROR_LIMIT = 0.1  # largest error that the feedback acts on [m]
DELAY = 0.03  # of the sensors, added to the rotors' lag [s]
STATES = (
    "y",  # of O [m]
    "vy",  # [m/s]
    "roll",  # [rad]
    "rate",  # [rad/s]
    "torque",  # of all rotors about their own drone [N m]
    "rate_integral",  # of the leader's rate loop [rad]
    "height",  # of O [m]
    "climb",  # [m/s]
    "leader_thrust",  # [N]
    "follower_thrust",  # [N]
    "leader_integral",  # integral of the leader's height error [m s]
    "load",  # disturbance torque: the ball, unequal rotors [N m]
    "load_rate",  # its rate [N m/s]
    "lift",  # disturbance force: errors of mass and thrust [N]
)
LATERAL = ("y", "vy")  # states that a stand locks
LOAD_DECAY, LOAD_RATE_DECAY = 0.02, 1.0  # assumed decay of a load or lift, and of a load's rate [1/s]
ROLLING = 5 / 7  # acceleration of a rolling ball over that of a sliding one


class LinearModel(NamedTuple):
    """x' = a x + b (follower's roll [rad], vertical acceleration [m/s2])."""

    a: np.ndarray  # (n, n)
    b: np.ndarray  # (n, 2)
    names: tuple[str, ...]  # n of `STATES`
    rate_integral_limit: float  # [rad]
    load_limit: float  # [N m]

    def indices(self, names: Iterable[str]) -> list[int]:
        """Indices in x of those `names` that the model has."""
        return [self.names.index(name) for name in names if name in self.names]


def linear_model(config: Config, delay: float) -> LinearModel:
    """The model for the plant of `config`; `delay` [s] of the sensors is added to the rotors' lag."""
    plant, leader = config.plant, config.leader
    assembly, loop = assembly_model(config, "lqg"), drone_loop(config, 0)
    lag, half = plant.rotor_lag + delay, 0.5 * float(assembly.mounts[0, 1] - assembly.mounts[1, 1])
    n, at = len(STATES), {name: place for place, name in enumerate(STATES)}
    eye = np.eye(n)
    row = {name: eye[place] for name, place in at.items()}
    a, b = np.zeros((n, n)), np.zeros((n, 2))
    free = float(plant.stand == "free")
    tilt = half if leader.error == "own" else 0.0  # the leader measures its own height
    leader_height, leader_climb = row["height"] + tilt * row["roll"], row["climb"] + tilt * row["rate"]
    leader_roll = free * (leader.kp[1] * row["y"] + leader.kd[1] * row["vy"]) / plant.gravity
    leader_vertical = leader.ki[2] * row["leader_integral"] - leader.kp[2] * leader_height - leader.kd[2] * leader_climb

    a[at["y"]], a[at["vy"]] = row["vy"], -plant.gravity * row["roll"]
    a[at["roll"]] = row["rate"]
    thrust_torque = half * (row["leader_thrust"] - row["follower_thrust"])
    a[at["rate"]] = (row["torque"] + thrust_torque + row["load"]) / assembly.inertia[0]
    commanded = loop.kp * (leader_roll - 2 * row["roll"]) - 2 * loop.kd * row["rate"] - 2 * loop.kdd * a[at["rate"]]
    a[at["torque"]] = (commanded + loop.integral_gain * row["rate_integral"] - row["torque"]) / lag
    b[at["torque"], 0] = loop.kp / lag
    a[at["rate_integral"]] = loop.stiffness * (leader_roll - row["roll"]) - row["rate"]

    a[at["height"]] = row["climb"]
    total = float(assembly.known_mass.sum()) + plant.object_mass
    a[at["climb"]] = (row["leader_thrust"] + row["follower_thrust"] + row["lift"]) / total
    leader_slope, follower_slope = thrust_slopes(config)
    a[at["leader_thrust"]] = (leader_slope * leader_vertical - row["leader_thrust"]) / lag
    a[at["follower_thrust"]] = -row["follower_thrust"] / lag
    b[at["follower_thrust"], 1] = follower_slope / lag
    a[at["leader_integral"]] = -leader_height

    a[at["load"]] = row["load_rate"] - LOAD_DECAY * row["load"]
    a[at["lift"]] = -LOAD_DECAY * row["lift"]
    ball = plant.moving_fraction * plant.object_mass
    if config.motion.kind == "rolling":
        a[at["load_rate"]] = ROLLING * ball * plant.gravity**2 * row["roll"]
    else:
        a[at["load_rate"]] = -LOAD_RATE_DECAY * row["load_rate"]
    names = [name for name in STATES if free or name not in LATERAL]
    indices = [at[name] for name in names]
    limit = ball * plant.gravity * ball_limit(plant) if config.motion.kind == "rolling" else math.inf
    return LinearModel(a[np.ix_(indices, indices)], b[indices], tuple(names), loop.integral_limit, limit)


class LqgState(NamedTuple):
    """State of the controller between control steps."""

    expected: Array  # (..., n) states of the model, see `Filter`
    command: Array  # (..., 2) last roll [rad] and vertical acceleration [m/s2]
    integral: Any  # (..., 3) see `CopiedPid`


class CrazyflieLqg:
    """Kalman filter and LQR of the pair's roll and height; pitch, which the load does not move, copies the leader."""

    name = "lqg"
    needs_privileged = False

    def __init__(self, config: Config):
        if config.plant.cg_axis != "y" or config.plant.stand == "pivot":
            raise InputError("follower 'lqg' flies two Crazyflies along y, free or on the stand with height free")
        self._assembly = assembly_model(config, self.name)
        self._model = linear_model(config, DELAY)
        self._filter, self._change = design(self._model, config.timing.control_period)
        self._pid = CopiedPid(config)
        places = [MEASURED[name][:2] for name in MEASURED if name in self._model.names]
        self._measurement = np.array([sign * np.eye(OBSERVATION_SIZE)[place] for place, sign in places])  # (k, 18)
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        limits = self._model.rate_integral_limit, self._model.load_limit
        self._state_bounds = self._bounds(("rate_integral", "load"), limits)
        self._error_bounds = self._bounds(("y", "height"), ERROR_LIMIT)

    def start(self, observation: Array) -> LqgState:
        """See `Controller.start`."""
        zero = observation.__array_namespace__().zeros_like(observation[..., :2])
        return LqgState(self._filter.start(times(self._measurement, observation)), zero, self._pid.start(observation))

    def step(self, state: LqgState, observation: Array, privileged: PrivilegedInfo) -> tuple[LqgState, Array]:
        """See `Controller.step`."""
        xp = observation.__array_namespace__()
        estimate = self._filter.corrected(state.expected, times(self._measurement, observation))
        estimate = _clip(estimate, self._state_bounds)
        near = _clip(estimate, self._error_bounds)  # the motors have too little thrust to spare for large errors
        change = times(self._change, xp.concat([near, state.command], axis=-1))
        command = _clip(state.command - change, self._limits)
        integral, copied = self._pid.step(state.integral, observation)
        vertical = self._assembly.without_extra_lift(command[..., 1], self._assembly.on_axes(command[..., :1]))
        vertical = _clip(vertical, self._limits[1])
        sent = xp.stack([command[..., 0], copied[..., 1], vertical], axis=-1)
        return LqgState(self._filter.moved(estimate, command), command, integral), sent

    def _bounds(self, names: tuple[str, ...], limits: Any) -> np.ndarray:
        """Bounds (n,): `limits` for the states `names` that the model has, infinity for the others."""
        bounds = np.full(len(self._model.names), np.inf)
        bounds[self._model.indices(names)] = limits
        return bounds


def _clip(array: Array, limit: Any) -> Array:
    xp = array.__array_namespace__()
    bound = xp.asarray(limit, dtype=array.dtype)
    return xp.clip(array, -bound, bound)


def design(model: LinearModel, period: float) -> tuple[Filter, np.ndarray]:
    """(filter, gain (2, n + 2) K of the command's change -K (x, u)) for the control `period` [s]."""
    n, names = len(model.names), model.names
    transition, drive = discretise(model.a, model.b, period)
    rolls = bool(np.isfinite(model.load_limit))
    deviations = PROCESS_NOISE | ({"load_rate": ROLLING_NOISE} if rolls else {})
    walks = {place: deviations.get(name, 0.0) ** 2 for place, name in enumerate(names)}
    noise = {place: MEASURED[names[place]][2] for place in model.indices(MEASURED)}

    a, b = np.eye(n + 2), np.zeros((n + 2, 2))
    a[:n, :n], a[:n, n:] = transition, drive
    b[:n], b[n:] = a[:n, n:], np.eye(2)
    unit = np.eye(n + 2)
    weights = {name: 1 / COSTS[name] for name in names if name in COSTS} | ({"load": 1 / LOAD_COST} if rolls else {})
    outputs = [weight * unit[names.index(name)] for name, weight in weights.items()]
    outputs.append((unit[names.index("leader_thrust")] - unit[names.index("follower_thrust")]) / THRUST_DIFFERENCE)
    outputs.append(unit[n] / TILT)
    cost = np.array(outputs).T @ np.array(outputs)
    change, _ = regulator(a, b, cost, np.diag([(limit * period) ** -2 for limit in CHANGES]))
    return kalman(transition, drive, period, walks, noise), change
