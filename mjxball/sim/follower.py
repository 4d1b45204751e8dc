"""The laws around the follower's network for a configuration."""

from __future__ import annotations

from typing import Any

from mjxball.config import Config
from mjxball.control.follower_law import FollowerLaw
from mjxball.control.observation import observation_history


def follower_law(config: Config) -> FollowerLaw:
    """The laws around the network of `config.follower`; InputError if its plant has none of this kind."""
    follower, leader = config.follower, config.leader
    lqg: Any = None
    if follower.base == "lqg":
        from mjxball.baselines import multi_model_lqg, offset_free, team_lqg  # need SciPy

        if config.rigs.number:
            lqg = multi_model_lqg.multi_model_lqg(config)
        else:
            lqg = team_lqg.team_lqg(config) if config.plant.is_team else offset_free.offset_free_lqg(config)
    return FollowerLaw(
        history=observation_history(config),
        action_scale=(follower.action_scale_tilt, follower.action_scale_vertical),
        limits=(config.command.tilt_limit, config.command.vertical_limit),
        kp=leader.kp,
        kd=leader.kd,
        gravity=config.plant.gravity,
        residual=follower.action == "residual",
        lqg=lqg,
        units=follower.recurrent_units,
        geometry=follower.recurrent_units > 0 and config.plant.is_team,
    )
