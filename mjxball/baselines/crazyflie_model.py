"""Linear model of two Crazyflies on a stick along y, with their cascades and the leader's PID (ours).

All quantities are deviations from the level hover at the goal; angles and torques are about body x.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.baselines.assembly_model import assembly_model
from mjxball.config import Config, ball_limit
from mjxball.control.constants import drone_loop, thrust_slopes

if TYPE_CHECKING:
    from jaxtyping import Float

# Measured states: index in an observation, sign.
MEASURED = {
    "y": (13, -1.0),
    "vy": (16, -1.0),
    "roll": (3, 1.0),
    "rate": (9, 1.0),
    "height": (14, -1.0),
    "climb": (17, -1.0),
}
STATES = (
    "y",  # of the CG of all [m]
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
    "wind",  # disturbance acceleration along y [m/s2]
)
LATERAL = ("y", "vy", "wind")  # states that a stand locks
ROLLING = 5 / 7  # acceleration of a rolling ball over that of a sliding one


class Decay(NamedTuple):
    """Time constants with which disturbances are assumed to decay [s]."""

    load_rate: float = 1.0
    load: float = 50.0
    lift: float = 50.0
    wind: float = 50.0


class LinearModel(NamedTuple):
    """x' = a x + b (follower's roll [rad], vertical acceleration [m/s2])."""

    a: Float[np.ndarray, "n n"]
    b: Float[np.ndarray, "n 2"]
    measured: Float[np.ndarray, "k n"]  # of O, those of `MEASURED` that the model has
    names: tuple[str, ...]  # n of `STATES`
    rate_integral_limit: float  # [rad]
    load_limit: float  # [N m]

    def indices(self, names: Iterable[str]) -> list[int]:
        """Indices in x of those `names` that the model has."""
        return [self.names.index(name) for name in names if name in self.names]

    @property
    def shown(self) -> list[str]:
        """Names of the measurements."""
        return [name for name in MEASURED if name in self.names]


def linear_model(config: Config, decay: Decay) -> LinearModel:
    """The model for the plant of `config`, with disturbances that decay."""
    plant, leader = config.plant, config.leader
    assembly, loop = assembly_model(config, "lqg"), drone_loop(config, 0)
    lag, half = plant.rotor_lag, 0.5 * float(assembly.mounts[0, 1] - assembly.mounts[1, 1])
    n, at = len(STATES), {name: place for place, name in enumerate(STATES)}
    eye = np.eye(n)
    row = {name: eye[place] for name, place in at.items()}
    a, b = np.zeros((n, n)), np.zeros((n, 2))
    free = float(plant.stand == "free")
    tilt = half if leader.error == "own" else 0.0  # the leader measures its own height
    leader_height, leader_climb = row["height"] + tilt * row["roll"], row["climb"] + tilt * row["rate"]
    leader_vertical = leader.ki[2] * row["leader_integral"] - leader.kp[2] * leader_height - leader.kd[2] * leader_climb

    total = float(assembly.known_mass.sum()) + plant.object_mass
    reaction = 1.0 / (plant.gravity * total)  # O is where the CG is, minus m c / M; the load's torque is -g m c
    y, vy = row["y"] + reaction * row["load"], row["vy"] + reaction * row["load_rate"]
    leader_roll = free * (leader.kp[1] * y + leader.kd[1] * vy) / plant.gravity
    a[at["y"]], a[at["vy"]] = row["vy"], row["wind"] - plant.gravity * row["roll"]
    a[at["roll"]] = row["rate"]
    thrust_torque = half * (row["leader_thrust"] - row["follower_thrust"])
    a[at["rate"]] = (row["torque"] + thrust_torque + row["load"]) / assembly.inertia[0]
    commanded = loop.kp * (leader_roll - 2 * row["roll"]) - 2 * loop.kd * row["rate"] - 2 * loop.kdd * a[at["rate"]]
    a[at["torque"]] = (commanded + loop.integral_gain * row["rate_integral"] - row["torque"]) / lag
    b[at["torque"], 0] = loop.kp / lag
    a[at["rate_integral"]] = loop.stiffness * (leader_roll - row["roll"]) - row["rate"]

    a[at["height"]] = row["climb"]
    a[at["climb"]] = (row["leader_thrust"] + row["follower_thrust"] + row["lift"]) / total
    leader_slope, follower_slope = thrust_slopes(config)
    a[at["leader_thrust"]] = (leader_slope * leader_vertical - row["leader_thrust"]) / lag
    a[at["follower_thrust"]] = -row["follower_thrust"] / lag
    b[at["follower_thrust"], 1] = follower_slope / lag
    # The integral is of the error and its rate, `integral_lead_time` ahead.
    a[at["leader_integral"]] = -leader_height - leader.integral_lead_time * leader_climb

    a[at["load"]] = row["load_rate"] - row["load"] / decay.load
    a[at["lift"]], a[at["wind"]] = -row["lift"] / decay.lift, -row["wind"] / decay.wind
    ball = plant.moving_fraction * plant.object_mass
    if config.motion.kind == "rolling":
        a[at["load_rate"]] = ROLLING * ball * plant.gravity**2 * row["roll"]
    else:
        a[at["load_rate"]] = -row["load_rate"] / decay.load_rate
    names = [name for name in STATES if free or name not in LATERAL]
    indices = [at[name] for name in names]
    limit = ball * plant.gravity * ball_limit(plant) if config.motion.kind == "rolling" else math.inf
    outputs = row | {"y": y, "vy": vy}
    measured = np.array([outputs[name] for name in MEASURED if name in names])[:, indices]
    return LinearModel(a[np.ix_(indices, indices)], b[indices], measured, tuple(names), loop.integral_limit, limit)
