"""Builds from a configuration the processing around a follower's network."""

from __future__ import annotations

from mjxball.config import Config
from mjxball.control.network_interface import NetworkInterface
from mjxball.control.observation import observation_history


def network_interface(config: Config) -> NetworkInterface:
    """Observation history, action scaling and limits around the network of `config.follower`."""
    follower, leader = config.follower, config.leader
    return NetworkInterface(
        history=observation_history(config),
        action_scale=(follower.action_scale_tilt, follower.action_scale_vertical),
        limits=(config.command.tilt_limit, config.command.vertical_limit),
        kp=leader.kp,
        kd=leader.kd,
        gravity=config.plant.gravity,
        residual=follower.action == "residual",
        units=follower.recurrent_units,
        geometry=follower.recurrent_units > 0 and config.plant.is_team,
    )
