"""Offset-free LQG for teams: the numbers of `control.team_lqg`, and the law as a follower (ours)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.lqg import CORRECTION_LIMIT, VERTICAL_LIMIT
from mjxball.baselines.lqg_design import (
    CLIMB_NOISE,
    RATE_NOISE,
    Tuning,
    feedback,
    innovation_filter,
    steady_filter,
)
from mjxball.baselines.offset_free import LIFT_WALK, NAME, OffsetFree
from mjxball.config import Config
from mjxball.control.followers import copy_gains
from mjxball.control.team_lqg import TeamLqg, team_context
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

Array = Any
TUNING = Tuning(position=0.2, velocity=0.6, torque_walk=20.0, tilt_limit=0.3)  # of a load's torque over the inertia
# [s] in which the estimates of d, d' and the lift error are forgotten.
LOAD_TIME, RATE_TIME, LIFT_TIME = 3.0, 0.3, 5.0
ANGLE_NOISE = 5e-3  # deviation of a measurement [rad]


class Forgetting(NamedTuple):
    """How fast estimates change."""

    lift_walk: float = LIFT_WALK  # intensity of the white noise that drives the lift error [(m/s2)2/s]
    lift_time: float = LIFT_TIME  # [s] in which it is forgotten


# Of teams that are to outlive a lost follower: what it gave is to be found at once.
QUICK = Tuning(position=0.1, velocity=0.4, torque_walk=80.0, tilt_limit=0.3)
QUICK_LIFT = Forgetting(lift_walk=0.3, lift_time=10.0)
SLOW_LIFT = Forgetting()


def team_lqg(config: Config) -> TeamLqg:
    """The law for teams like that of `config`; InputError unless it flies freely with ideal loops that are alike."""
    model, lifting = ideal_model(config, NAME), config.follower.differential_thrust_share
    tuning, forgetting = (QUICK, QUICK_LIFT) if lifting else (TUNING, SLOW_LIFT)
    roll, pitch, _ = config.attitude.natural_frequency
    if roll != pitch:
        raise InputError(f"follower {NAME!r} needs attitude loops alike about roll and pitch in a team")
    stiffness, damping = roll**2, 2 * config.attitude.damping * roll
    *axis, axis_gain, _ = angle_filter(stiffness, damping, model.lag, model.period, tuning.torque_walk)
    *height, height_gain = height_filter(model.lag, model.period, forgetting)
    gains = feedback(model, tuning)
    return TeamLqg(
        axis=np.hstack(axis),
        axis_gain=axis_gain,
        height=np.hstack(height),
        height_gain=height_gain[:, 0],
        tilt=np.array(gains.pitch),
        rise=np.array(gains.height),
        limits=np.array([tuning.tilt_limit, VERTICAL_LIMIT, CORRECTION_LIMIT]),
        stiffness=stiffness,
        damping=damping / stiffness,
        lifting=lifting,
    )


def angle_filter(
    stiffness: float, damping: float, lag: float, period: float, walk: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`innovation_filter` of the state about an axis, see `TeamLqg`: loops of Kp, Kd over the inertia [1/s2], [1/s]."""
    a, b = np.zeros((5, 5)), np.zeros((5, 1))
    a[0, 1] = a[2, 3] = a[1, 2] = a[1, 4] = 1.0
    a[2, 2], a[3, 3] = -1.0 / LOAD_TIME, -1.0 / RATE_TIME
    a[4] = np.array([-stiffness, -damping, 0.0, 0.0, -1.0]) / lag
    b[4] = stiffness / lag
    return innovation_filter(a, b, period, {3: walk}, {0: ANGLE_NOISE, 1: RATE_NOISE})


def height_filter(
    lag: float, period: float, forgetting: Forgetting = SLOW_LIFT
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`steady_filter` of the height's state, see `TeamLqg`."""
    a, b = np.zeros((3, 3)), np.zeros((3, 1))
    a[0, 1] = a[0, 2] = 1.0
    a[2, 2] = -1.0 / forgetting.lift_time
    a[1, 1], b[1] = -1.0 / lag, 1.0 / lag
    return steady_filter(a, b, period, {2: forgetting.lift_walk}, {0: CLIMB_NOISE})


class TeamOffsetFree(OffsetFree):
    """What a team's network with `follower.base = lqg` starts from, flying alone. It is not told the object's mass."""

    def __init__(self, config: Config):
        self._law, self._leader = team_lqg(config), copy_gains(config)
        known = plant_parameters(config.plant, config.attitude)
        self._context = team_context(known, config.plant, np.float64(config.plant.object_mass))

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        return self._law.start(observation, self._context)
