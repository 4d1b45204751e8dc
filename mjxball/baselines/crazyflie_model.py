"""Linear model of two Crazyflies on a stick along y, with their cascades and the leader's PID (ours).

Every quantity is a deviation from the level hover at the goal; angles and torques are about body x.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mjxball.baselines.load_axis import load_axis
from mjxball.config import Config, ball_limit
from mjxball.control.constants import drone_loop, thrust_slopes

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
    "load",  # torque disturbance: the ball, unequal rotors [N m]
    "load_rate",  # its rate [N m/s]
    "lift",  # disturbance force: weight and rotors other than believed [N]
)
MEASURED = ("y", "vy", "roll", "rate", "height", "climb")
LATERAL = ("y", "vy")  # what a stand locks
LOAD_DECAY, LOAD_RATE_DECAY = 0.02, 1.0  # assumed decay of a load or lift, and of a load's rate [1/s]
ROLLING = 5 / 7  # acceleration of a rolling ball over that of a sliding one


class LinearModel(NamedTuple):
    """x' = a x + b (follower's roll [rad], vertical acceleration [m/s2])."""

    a: np.ndarray  # (n, n)
    b: np.ndarray  # (n, 2)
    names: tuple[str, ...]  # n of `STATES`
    rate_integral_limit: float  # [rad]
    load_limit: float  # [N m]

    def indices(self, names: tuple[str, ...]) -> list[int]:
        """Indices in x of those of `names` that the model has."""
        return [self.names.index(name) for name in names if name in self.names]


def linear_model(config: Config, delay: float) -> LinearModel:
    """The model for the nominal plant of `config`; `delay` [s] of the sensors is added to the rotors' lag."""
    plant, law = config.plant, config.leader
    pair, loop = load_axis(config, "lqg"), drone_loop(config, 0)
    lag, half = plant.rotor_lag + delay, pair.half_length
    n, at = len(STATES), {name: place for place, name in enumerate(STATES)}
    eye = np.eye(n)
    row = {name: eye[place] for name, place in at.items()}
    a, b = np.zeros((n, n)), np.zeros((n, 2))
    free = float(plant.stand == "free")
    tilt = half if law.error == "own" else 0.0  # the leader sees its own height
    leader_height, leader_climb = row["height"] + tilt * row["roll"], row["climb"] + tilt * row["rate"]
    leader_roll = free * (law.kp[1] * row["y"] + law.kd[1] * row["vy"]) / plant.gravity
    leader_vertical = law.ki[2] * row["leader_integral"] - law.kp[2] * leader_height - law.kd[2] * leader_climb

    a[at["y"]], a[at["vy"]] = row["vy"], -plant.gravity * row["roll"]
    a[at["roll"]] = row["rate"]
    thrust_torque = half * (row["leader_thrust"] - row["follower_thrust"])
    a[at["rate"]] = (row["torque"] + thrust_torque + row["load"]) / pair.inertia
    commanded = loop.kp * (leader_roll - 2 * row["roll"]) - 2 * loop.kd * row["rate"] - 2 * loop.kdd * a[at["rate"]]
    a[at["torque"]] = (commanded + loop.slow * row["rate_integral"] - row["torque"]) / lag
    b[at["torque"], 0] = loop.kp / lag
    a[at["rate_integral"]] = loop.stiffness * (leader_roll - row["roll"]) - row["rate"]

    a[at["height"]] = row["climb"]
    total = sum(pair.drone_mass) + plant.object_mass
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
