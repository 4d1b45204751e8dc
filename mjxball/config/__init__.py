"""Typed, frozen configuration: one source for defaults, validation, JSON, hashes and the command line.

Importing it needs NumPy only.
"""

from mjxball.config._leaf import Range
from mjxball.config._learning import Gradient, Ppo, Sac
from mjxball.config._model_source import MAX_ELEMENTS, MAX_PIXELS
from mjxball.config._plant import Drone, Plant
from mjxball.config._plant_file import PLANT_PARTS, PLANTS, PlantFile, follow_plant, read_plant, with_plant
from mjxball.config._plausible import check_lift, thrust_over_weight, total_mass
from mjxball.config._presets import PRESETS, PRESETS_ABOUT, algorithm_of, preset
from mjxball.config._scenario import Motion, Rigs, ScenarioRanges
from mjxball.config._settings import Attitude, Autopilot, Bounds, Command, Config, Follower, Leader, Reward, Timing
from mjxball.config._tree import (
    about_section,
    apply_overrides,
    config_hash,
    from_dict,
    from_record,
    leaves,
    override,
    range_of,
    replace,
    to_dict,
    to_json,
    to_text,
)
from mjxball.config._validate import MOST_DRONES, THRUST_MARGIN, ball_limit, cg_limit, validate

__all__ = [
    "MAX_ELEMENTS",
    "MAX_PIXELS",
    "MOST_DRONES",
    "PLANTS",
    "PLANT_PARTS",
    "PRESETS",
    "PRESETS_ABOUT",
    "THRUST_MARGIN",
    "Attitude",
    "Autopilot",
    "Bounds",
    "Command",
    "Config",
    "Drone",
    "Follower",
    "Gradient",
    "Leader",
    "Motion",
    "Plant",
    "PlantFile",
    "Ppo",
    "Range",
    "Reward",
    "Rigs",
    "Sac",
    "ScenarioRanges",
    "Timing",
    "about_section",
    "algorithm_of",
    "apply_overrides",
    "ball_limit",
    "cg_limit",
    "check_lift",
    "config_hash",
    "follow_plant",
    "from_dict",
    "from_record",
    "leaves",
    "override",
    "preset",
    "range_of",
    "read_plant",
    "replace",
    "thrust_over_weight",
    "to_dict",
    "to_json",
    "to_text",
    "total_mass",
    "validate",
    "with_plant",
]
