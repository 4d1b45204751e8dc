"""The numbers of `control.multi_model_lqg`: offset-free LQGs for loops and rotors from slow to fast (ours)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.lqg import CORRECTION_LIMIT, VERTICAL_LIMIT
from mjxball.baselines.lqg_design import Tuning, feedback
from mjxball.baselines.offset_free import NAME, OffsetFree
from mjxball.baselines.swing_design import ENERGY_TIME, ahead, observers
from mjxball.baselines.team_lqg import angle_filter, height_filter
from mjxball.config import Config
from mjxball.control.followers import copy_gains
from mjxball.control.multi_model_lqg import ADDED_TIME, MultiModelLqg

Array = Any
# Natural frequency of the attitude loops [rad/s] and lag [s] of each model: of the rotors, and of what is measured, in
# the mean 25 ms. Behind slower rotors loops are hardly damped.
MODELS = (
    *((4.7, 0.05), (4.7, 0.1), (4.7, 0.17)),
    *((6.5, 0.045), (6.5, 0.09), (6.5, 0.15)),
    *((9.0, 0.04), (9.0, 0.08), (9.0, 0.13)),
    *((13.0, 0.035), (13.0, 0.07), (18.0, 0.045)),
)
TUNING = Tuning(position=0.2, velocity=0.6, torque_walk=500.0, tilt_limit=0.3)  # of a load's torque over the inertia
# Inertia of a pair about pitch over that about roll, the median of random rigs (`sim.rigs`): the same torque turns it
# about roll as much more, and rotors hold as much more of a tilt. Across the pair the CG goes half as far in the mean.
PAIR_INERTIA_RATIO, ACROSS = 13.0, 0.5
SCORE_TIME = 8.0  # [s] in which a model's score is forgotten
HELD_ROOM = 1.0  # over the load that more than two drones hold: rotors that hold it have room for as much


def multi_model_lqg(
    config: Config,
    models: Sequence[tuple[float, float]] = MODELS,
    tuning: Tuning = TUNING,
) -> MultiModelLqg:
    """The law for teams of ideal loops, damped like those of `config`; InputError unless they fly freely."""
    parts, period, damped = [], config.timing.control_period, config.attitude.damping
    for frequency, lag in models:
        attitude = dataclasses.replace(config.attitude, natural_frequency=(frequency, frequency, frequency))
        model = ideal_model(dataclasses.replace(config, attitude=attitude), NAME)
        stiffness, damping = frequency**2, 2 * damped * frequency
        of_loop, tilts = (stiffness, damping, lag, period), feedback(model, tuning).pitch
        axis, *own = _filter(*of_loop, tuning.torque_walk)
        _, *of_pair = _filter(*of_loop, tuning.torque_walk * (ACROSS * PAIR_INERTIA_RATIO) ** 2)
        swung = ahead(axis, own[0], lag, period)
        parts.append((axis, *own, *of_pair, np.array(tilts), stiffness, damping / stiffness, swung))
    stacked = [np.stack(part) for part in zip(*parts, strict=True)]
    axes, gains, certainty, prior, *rolling, tilt, every_stiffness, every_damping, every_ahead = stacked
    *height, height_gain = height_filter(config.plant.rotor_lag, period)
    return MultiModelLqg(
        axis=axes,
        axis_gain=gains,
        certainty=certainty,
        prior=prior - prior.max(),
        tilt=tilt,
        stiffness=every_stiffness,
        damping=every_damping,
        height=np.hstack(height),
        height_gain=height_gain[:, 0],
        rise=np.array(feedback(model, tuning).height),
        limits=np.array([tuning.tilt_limit, VERTICAL_LIMIT, CORRECTION_LIMIT]),
        keep=1.0 - period / np.array([SCORE_TIME, ADDED_TIME]),
        added_lift=1.0,
        pair_roll_gain=rolling[0],
        pair_roll_certainty=rolling[1],
        pair_roll_prior=rolling[2] - rolling[2].max(),
        pair_roll_room=PAIR_INERTIA_RATIO,
        rig_axes=1.0,
        swing=observers(period),
        swing_ahead=every_ahead,
        swing_keep=1.0 - period / ENERGY_TIME,
        held_room=HELD_ROOM,
    )


def _filter(stiffness: float, damping: float, lag: float, period: float, walk: float) -> tuple[Any, ...]:
    """(A B, K, elements of the inverse covariance of the innovation, log of the root of its determinant)."""
    *axis, gain, covariance = angle_filter(stiffness, damping, lag, period, walk)
    inverse = np.linalg.inv(covariance)
    certainty = np.array([inverse[0, 0], inverse[0, 1], inverse[1, 1]])
    return np.hstack(axis), gain, certainty, -0.5 * np.log(np.linalg.det(covariance))


class MultiModelOffsetFree(OffsetFree):
    """What a network for any rig starts from, flying alone; told the geometry of its team."""

    def __init__(self, config: Config, context: Array):
        self._law, self._leader, self._context = multi_model_lqg(config), copy_gains(config), context

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        return self._law.start(observation, self._context)
