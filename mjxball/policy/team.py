"""Policies adapted to another plant: their metadata then hold its configuration, and its geometry if they take one."""

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
from mjxball.policy.file import PolicyFile, interface_of
from mjxball.policy.inference import geometry_of, missing_team_error

CRAZYFLIES = Path("crazyflie")  # default plant of a policy for any rig


def is_for_any(metadata: dict[str, Any]) -> bool:
    """Whether `metadata` is that of a policy for any rig that has not been adapted to one."""
    return interface_of(metadata).geometry and "team" not in metadata


def in_team(policy: PolicyFile, name: str, config: Config | None, drone: int | None = None) -> PolicyFile:
    """`policy` adapted to the follower `drone` of the team of `config`.

    Its metadata then have the plant and configuration of that team, and `team` if it takes geometry. Others fly any
    pair of Crazyflies that is joined and held as the one of their training. Raises InputError if `config` or `drone`
    do not fit.
    """
    if not interface_of(policy.metadata).geometry:
        if drone is not None or (config is not None and not _joined_alike(config, policy.metadata)):
            raise InputError(f"{name} is for the plant that it was trained on: leave --plant and --drone out")
        return policy if config is None else _on(config, policy)
    if config is None and drone is None and "team" in policy.metadata:
        return policy
    followers: tuple[int, ...] = (1,) if config is None else config.plant.followers
    if drone not in (followers if len(followers) > 1 else (None, *followers)):
        raise InputError(f"--drone must be a follower of --plant: {', '.join(map(str, followers))}")
    index = 0 if drone is None else followers.index(drone)
    if config is None:
        raise missing_team_error(name)
    team = {
        "drone": followers[index],
        "mount_angle": float(np.ravel(mount_frames(config.plant))[index]),
        "context": np.atleast_2d(geometry_of(config.plant))[index].tolist(),
    }
    return _on(config, policy, team=team)


def _joined_alike(config: Config, metadata: dict[str, Any]) -> bool:
    """Whether `config` and the plant of training are pairs of Crazyflies alike in axis, stand and leader."""
    pairs = config, _trained(metadata)
    if any(one.autopilot.kind != "crazyflie" or one.plant.count != 2 for one in pairs):
        return False
    flown, trained = ((one.plant.cg_axis, one.plant.stand, one.plant.leader) for one in pairs)
    return flown == trained


def _trained(metadata: dict[str, Any]) -> Config:
    """The configuration of the training of a policy with `metadata`."""
    return configs.from_record({"plant": {}, **metadata.get("config", {})})


def _on(config: Config, policy: PolicyFile, **more: Any) -> PolicyFile:
    """`policy` with metadata for the plant of `config` and `more`; controllers and period are those of its training."""
    trained = _trained(policy.metadata)
    timing = replace(trained.timing, physics_steps=round(trained.timing.control_period / config.physics_step))
    kept = {name: getattr(trained, name) for name in ("preset", "leader", "command", "follower")}
    flown = configs.validate(replace(config, **kept, timing=timing))
    drones = {"firmware": firmware(config)} if config.autopilot.kind == "crazyflie" else {}
    plant = {"plant": configs.to_dict(config.plant), "config": configs.to_dict(flown), **drones}
    return replace(policy, metadata={**policy.metadata, **plant, **more})
