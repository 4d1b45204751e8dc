"""A flight of two Crazyflies on the paper's test stand, the ball rolling freely along the stick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.followers import Follower
from mjxball.rollout import simulate
from mjxball.scenario import Scenario

SETTINGS = {"paper": "the paper's gains", "better": "better settings"}
# The leader's height loop of free flight with a quarter of its integral, and thrust by the motors' curve.
BETTER = {
    "leader.kp": (1.0, 1.0, 4.0),
    "leader.kd": (2.0, 2.0, 3.5),
    "leader.ki": (0.2, 0.1, 0.5),
    "autopilot.thrust_law": "calibrated",
}
LEVEL = 0.08  # height of the leader at rest on the level stand, its goal p_l^d (paper) [m]
# Slightly off (ours): 3 degrees of roll, 3 cm too low, the ball 3 cm from the middle and at rest.
SCENARIO = Scenario(
    amplitude=0.0,
    mass=configs.preset("stand").plant.object_mass,
    goal=(0.0, 0.0, 0.0),
    start_position=(0.0, 0.0, -0.03),
    start_tilt=(0.0524, 0.0),
    ball_start=0.03,
    seconds=60.0,
)


def stand_config(settings: str = "paper") -> Config:
    """The preset `stand`, with the paper's settings of the leader or `better` ones."""
    config = configs.preset("stand")
    for name, value in BETTER.items() if settings == "better" else ():
        config = configs.replace(config, name, value)
    return configs.validate(config)


@dataclass(frozen=True)
class StandFlight:
    """What the paper's Fig. 7 draws, one row per control step, and the ball that causes it."""

    time: np.ndarray  # (T,) [s]
    height: np.ndarray  # (T,) of the leader, `LEVEL` where the stick is level and O at its goal [m]
    roll: np.ndarray  # (T,) of the assembly [rad]
    vertical: np.ndarray  # (T,) follower's vertical acceleration command [m/s2]
    ball: np.ndarray  # (T,) from O along the stick, towards the leader [m]


def fly_stand(config: Config, follower: Follower, leader_error: bool, physics: str, scenario: Scenario) -> StandFlight:
    """Fly `follower` on the stand, shown the object's error or, with `leader_error`, the leader's, as in the paper.

    The leader's law is eq. 5 on e_l = p_l^d - p_l, p_l^d its place when the stick is level and O at its goal. A flight
    that diverges stays where it did.
    """
    config = configs.replace(config, "follower.error", "leader" if leader_error else "object")
    flown = simulate(config, follower, scenario, physics)
    lever = rotations.rotate(rotations.matrix_from_quaternion(flown.quaternion), np.array(config.plant.leader_mount))
    rise = flown.position[:, 2] - flown.target[:, 2] + lever[:, 2] - config.plant.leader_mount[2]
    ball = flown.cg_offset / config.plant.moving_fraction
    return StandFlight(flown.time, LEVEL + rise, flown.euler[:, 0], flown.follower_command[:, 2], ball)
