"""The numbers of `control.multi_model_lqg`: offset-free LQGs for attitude loops from slow to fast (ours)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.lqg import CORRECTION_LIMIT, VERTICAL_LIMIT
from mjxball.baselines.lqg_design import feedback
from mjxball.baselines.offset_free import NAME, OffsetFree
from mjxball.baselines.team_lqg import TUNING, angle_filter, height_filter
from mjxball.config import Config
from mjxball.control.followers import copy_gains
from mjxball.control.multi_model_lqg import ADDED_TIME, MultiModelLqg

Array = Any
FREQUENCIES = (4.5, 7.0, 11.0, 17.0)  # of the models' attitude loops [rad/s]
LAG, LAG_ANGLE = 0.05, 0.35  # rotor lag that a model assumes: 0.05 s, of fast loops 0.35 over the frequency
SCORE_TIME = 4.0  # [s] in which a model's score is forgotten


def multi_model_lqg(config: Config, frequencies: tuple[float, ...] = FREQUENCIES) -> MultiModelLqg:
    """The law for teams of ideal loops, damped like those of `config`; InputError unless they fly freely."""
    parts, period, damped = [], config.timing.control_period, config.attitude.damping
    for frequency in frequencies:
        attitude = dataclasses.replace(config.attitude, natural_frequency=(frequency, frequency, frequency))
        model = ideal_model(dataclasses.replace(config, attitude=attitude), NAME)
        stiffness, damping = frequency**2, 2 * damped * frequency
        lag = min(LAG, LAG_ANGLE / frequency)
        *axis, gain, covariance = angle_filter(stiffness, damping, lag, period, TUNING.torque_walk)
        inverse, tilts = np.linalg.inv(covariance), feedback(model, TUNING).pitch
        prior = -0.5 * np.log(np.linalg.det(covariance))
        certainty = np.array([inverse[0, 0], inverse[0, 1], inverse[1, 1]])
        parts.append((np.hstack(axis), gain, certainty, prior, np.array(tilts), stiffness, damping / stiffness))
    stacked = [np.stack(part) for part in zip(*parts, strict=True)]
    axes, gains, certainty, prior, tilt, every_stiffness, every_damping = stacked
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
        rise=np.array(feedback(model, TUNING).height),
        limits=np.array([TUNING.tilt_limit, VERTICAL_LIMIT, CORRECTION_LIMIT]),
        keep=1.0 - period / np.array([SCORE_TIME, ADDED_TIME]),
    )


class MultiModelOffsetFree(OffsetFree):
    """What a network for any rig starts from, flying alone; told the geometry of its team."""

    def __init__(self, config: Config, context: Array):
        self._law, self._leader, self._context = multi_model_lqg(config), copy_gains(config), context

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        return self._law.start(observation, self._context)
