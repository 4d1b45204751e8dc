"""Policies for any rig, adapted to one: their metadata then hold its plant, configuration and geometry."""

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
    """`policy` adapted to the follower `drone` of the team of `config`; unchanged if it takes no geometry.

    Its metadata then have `team`, and the plant and configuration of that team. Raises InputError if `config` or
    `drone` do not fit.
    """
    if not interface_of(policy.metadata).geometry:
        if config is not None or drone is not None:
            raise InputError(f"{name} knows nothing of its team: leave --plant and --drone out")
        return policy
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
    return replace(policy, metadata={**policy.metadata, **_metadata_of(config, policy.metadata), "team": team})


def _metadata_of(config: Config, metadata: dict[str, Any]) -> dict[str, Any]:
    """Metadata fields for plant and configuration of the policy with `metadata` on the plant of `config`.

    Preset, controllers and control period are those of training.
    """
    trained = configs.from_record({"plant": {}, **metadata.get("config", {})})
    timing = replace(trained.timing, physics_steps=round(trained.timing.control_period / config.physics_step))
    kept = {name: getattr(trained, name) for name in ("preset", "leader", "command", "follower")}
    flown = configs.validate(replace(config, **kept, timing=timing))
    drones = {"firmware": firmware(config)} if config.autopilot.kind == "crazyflie" else {}
    return {"plant": configs.to_dict(config.plant), "config": configs.to_dict(flown), **drones}
