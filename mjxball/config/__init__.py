"""Typed, frozen configuration: one source for defaults, validation, JSON, hashes and the command line.

Importing it needs the standard library only.
"""

from mjxball.config._presets import PRESETS, RIGS, preset
from mjxball.config._settings import (
    Attitude,
    Autopilot,
    Bounds,
    Config,
    Follower,
    Leader,
    Motion,
    Plant,
    Reward,
    Sac,
    Scenario,
    Timing,
)
from mjxball.config._tree import (
    apply_overrides,
    config_hash,
    from_dict,
    from_record,
    leaves,
    override,
    replace,
    to_dict,
    to_json,
)
from mjxball.config._validate import ball_reach, cg_reach, validate

__all__ = [
    "PRESETS",
    "RIGS",
    "Attitude",
    "Autopilot",
    "Bounds",
    "Config",
    "Follower",
    "Leader",
    "Motion",
    "Plant",
    "Reward",
    "Sac",
    "Scenario",
    "Timing",
    "apply_overrides",
    "ball_reach",
    "cg_reach",
    "config_hash",
    "from_dict",
    "from_record",
    "leaves",
    "override",
    "preset",
    "replace",
    "to_dict",
    "to_json",
    "validate",
]
