"""A flight on the paper's test stand, where the leader flies on its own position instead of the object's."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from mjxball import config as configs
from mjxball.config import Config, Leader, Plant
from mjxball.control import rotations
from mjxball.control.followers import Follower
from mjxball.rollout import simulate
from mjxball.scenario import Scenario

STANDS = {"pivot": "pivot at O", "heave": "roll and height free"}  # the two readings of "p_o is restricted"
LEVEL = 0.08  # height of the leader at rest on the level stand, its goal p_l^d (paper) [m]
GAINS = Leader(kp=(1.0, 1.0, 0.1), kd=(2.0, 2.0, 5.0), ki=(0.2, 0.1, 0.1))  # of the paper's experiment
# Slightly off (ours): 3 degrees of roll and, where the stand lets it, 3 cm too low; one CG cycle takes 20 s.
SCENARIO = Scenario(goal=(0.0, 0.0, 0.0), start_position=(0.0, 0.0, -0.03), start_tilt=(0.0524, 0.0), seconds=60.0)


def stand_config(stand: str) -> Config:
    """The reference pair laid across the stand `pivot` or `heave`, with the leader of the paper's experiment."""
    across = Plant(
        stand=stand,  # type: ignore[arg-type]
        cg_axis="y",
        object_size=(0.10, 0.34, 0.05),
        leader_mount=(0.0, 0.17, 0.0),
        follower_mount=(0.0, -0.17, 0.0),
    )
    return configs.validate(dataclasses.replace(configs.preset("paper"), plant=across, leader=GAINS))


@dataclass(frozen=True)
class StandFlight:
    """What the paper's Fig. 7 draws, one row per control step, and the CG that causes it."""

    time: np.ndarray  # (T,) [s]
    height: np.ndarray  # (T,) of the leader, `LEVEL` where the stick is level and O at its goal [m]
    roll: np.ndarray  # (T,) of the assembly [rad]
    vertical: np.ndarray  # (T,) follower's vertical acceleration command [m/s2]
    cg_offset: np.ndarray  # (T,) along the stick, towards the leader [m]


def fly_stand(
    config: Config, follower: Follower, leader_error: bool, physics: str = "mjx", scenario: Scenario = SCENARIO
) -> StandFlight:
    """Fly `follower` on a stand; with `leader_error` its object-error slots carry the leader's error, as in the paper.

    The leader's law is eq. 5 on e_l = p_l^d - p_l, p_l^d its place when the stick is level and O at its goal. A flight
    that diverges stays where it did.
    """
    config = configs.replace(config, "leader.error", "own")
    config = configs.replace(config, "follower.error", "leader" if leader_error else "object")
    flown = simulate(config, follower, scenario, physics)
    lever = rotations.rotate(rotations.matrix_from_quaternion(flown.quaternion), np.array(config.plant.leader_mount))
    rise = flown.position[:, 2] - flown.target[:, 2] + lever[:, 2] - config.plant.leader_mount[2]
    return StandFlight(flown.time, LEVEL + rise, flown.euler[:, 0], flown.follower_command[:, 2], flown.cg_offset)
