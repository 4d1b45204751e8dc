"""Linear model of two Crazyflies on a stick along y, their cascades and the leader's PID included, seen by a follower.

Every quantity is a deviation from the level hover at the goal; angles and torques about body x (ours).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mjxball.config import Config, ball_reach
from mjxball.control.baselines.gains import load_axis
from mjxball.control.hover import drone_loop, thrust_slopes

STATES = (
    "y",  # of O [m]
    "vy",  # [m/s]
    "roll",  # [rad]
    "rate",  # [rad/s]
    "torque",  # of all rotors about their own drone [N m]
    "wound",  # integral of the leader's rate loop [rad]
    "height",  # of O [m]
    "climb",  # [m/s]
    "led",  # thrust of the leader [N]
    "followed",  # thrust of the follower [N]
    "sunk",  # integral of the leader's height error [m s]
    "load",  # torque that nobody commands: the ball, unequal rotors [N m]
    "loading",  # its rate [N m/s]
    "lift",  # vertical force that nobody commands: weight and rotors that are not as believed [N]
)
SEEN = ("y", "vy", "roll", "rate", "height", "climb")
LATERAL = ("y", "vy")  # what a stand locks
FADING, TURNING = 0.02, 1.0  # rates at which a load or lift, and a load's rate, are expected to die away [1/s]
ROLLS = 5 / 7  # acceleration of a rolling ball over that of a sliding one


class PairModel(NamedTuple):
    """x' = a x + b (follower's roll [rad], vertical acceleration [m/s2])."""

    a: np.ndarray  # (n, n)
    b: np.ndarray  # (n, 2)
    names: tuple[str, ...]  # n of `STATES`
    wound_reach: float  # [rad]
    load_reach: float  # [N m]

    def places(self, names: tuple[str, ...]) -> list[int]:
        """Where those of `names` that the model has stand in x."""
        return [self.names.index(name) for name in names if name in self.names]


def pair_model(config: Config, delay: float) -> PairModel:
    """The model for the nominal plant of `config`; `delay` [s] of the senses is added to the rotors' lag."""
    plant, law = config.plant, config.leader
    pair, loop = load_axis(config, "lqg"), drone_loop(config, 0)
    lag, half = plant.rotor_lag + delay, pair.half_length
    n, at = len(STATES), {name: place for place, name in enumerate(STATES)}
    eye = np.eye(n)
    row = {name: eye[place] for name, place in at.items()}
    a, b = np.zeros((n, n)), np.zeros((n, 2))
    free = float(plant.stand == "free")
    tilt = half if law.error == "own" else 0.0  # the leader sees its own height
    seen_height, seen_climb = row["height"] + tilt * row["roll"], row["climb"] + tilt * row["rate"]
    led_roll = free * (law.kp[1] * row["y"] + law.kd[1] * row["vy"]) / plant.gravity
    led_vertical = law.ki[2] * row["sunk"] - law.kp[2] * seen_height - law.kd[2] * seen_climb

    a[at["y"]], a[at["vy"]] = row["vy"], -plant.gravity * row["roll"]
    a[at["roll"]] = row["rate"]
    a[at["rate"]] = (row["torque"] + half * (row["led"] - row["followed"]) + row["load"]) / pair.inertia
    asked = loop.kp * (led_roll - 2 * row["roll"]) - 2 * loop.kd * row["rate"] - 2 * loop.kdd * a[at["rate"]]
    a[at["torque"]] = (asked + loop.slow * row["wound"] - row["torque"]) / lag
    b[at["torque"], 0] = loop.kp / lag
    a[at["wound"]] = loop.stiffness * (led_roll - row["roll"]) - row["rate"]

    a[at["height"]] = row["climb"]
    total = sum(pair.drone_mass) + plant.object_mass
    a[at["climb"]] = (row["led"] + row["followed"] + row["lift"]) / total
    led, followed = thrust_slopes(config)
    a[at["led"]] = (led * led_vertical - row["led"]) / lag
    a[at["followed"]] = -row["followed"] / lag
    b[at["followed"], 1] = followed / lag
    a[at["sunk"]] = -seen_height

    a[at["load"]] = row["loading"] - FADING * row["load"]
    a[at["lift"]] = -FADING * row["lift"]
    ball = plant.moving_fraction * plant.object_mass
    if config.motion.kind == "rolling":
        a[at["loading"]] = ROLLS * ball * plant.gravity**2 * row["roll"]
    else:
        a[at["loading"]] = -TURNING * row["loading"]
    kept = [name for name in STATES if free or name not in LATERAL]
    places = [at[name] for name in kept]
    reach = ball * plant.gravity * ball_reach(plant) if config.motion.kind == "rolling" else math.inf
    return PairModel(a[np.ix_(places, places)], b[places], tuple(kept), loop.reach, reach)
