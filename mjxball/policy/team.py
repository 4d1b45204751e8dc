"""A policy for any rig, told which one it flies: its card then holds plant, configuration and context of that rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control.motors import firmware
from mjxball.control.observation import mount_frames
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile, law_of
from mjxball.policy.inference import geometry_of, not_told

CRAZYFLIES = Path("crazyflie")  # the plant that a policy for any rig flies where none is named


def is_for_any(card: dict[str, Any]) -> bool:
    """True for the card of a policy for any rig that has not been told which."""
    return law_of(card).geometry and "team" not in card


def in_team(policy: PolicyFile, name: str, config: Config | None, drone: int | None = None) -> PolicyFile:
    """`policy` as `drone` of the team of `config` flies it; itself if it is told nothing of its team.

    Its card then has `team`, and plant and configuration of that team. Raises InputError for what does not fit.
    """
    if not law_of(policy.card).geometry:
        if config is not None or drone is not None:
            raise InputError(f"{name} is told nothing of its team: leave --plant and --drone out")
        return policy
    if config is None and drone is None and "team" in policy.card:
        return policy
    followers: tuple[int, ...] = (1,) if config is None else config.plant.followers
    if drone not in (followers if len(followers) > 1 else (None, *followers)):
        raise InputError(f"--drone must be a follower of --plant: {', '.join(map(str, followers))}")
    place = 0 if drone is None else followers.index(drone)
    if config is None:
        raise not_told(name)
    team = {
        "drone": followers[place],
        "mount_angle": float(np.ravel(mount_frames(config.plant))[place]),
        "context": np.atleast_2d(geometry_of(config.plant))[place].tolist(),
    }
    return replace(policy, card={**policy.card, **_card_of(config, policy.card), "team": team})


def _card_of(config: Config, card: dict[str, Any]) -> dict[str, Any]:
    """What `card` says of plant and configuration where its policy flies on the plant of `config`."""
    own = configs.from_record({"plant": {}, **card.get("config", {})})
    timing = replace(own.timing, physics_steps=round(own.timing.control_period / config.physics_step))
    flown = configs.validate(
        replace(config, preset=own.preset, leader=own.leader, command=own.command, follower=own.follower, timing=timing)
    )
    drones = {"firmware": firmware(config)} if config.autopilot.kind == "crazyflie" else {}
    return {"plant": configs.to_dict(config.plant), "config": configs.to_dict(flown), **drones}
