"""What a policy file's card says of the law around its network, `lqg`, and of a follower's team; all is checked."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.control.offset_free import DRIVES, MEASURED, STATES
from mjxball.policy.container import PolicyFileError

# `control.team_lqg.team_context`, `control.multi_model_lqg.ring_context`.
CONTEXT = ("command_share", "roll_per_lift", "pitch_per_lift", "roll_room", "pitch_room")
GEOMETRY = ("command_share", "roll_acceleration_per_lift", "pitch_acceleration_per_lift", "rotor_room")
CONTEXTS = {3: CONTEXT, 4: GEOMETRY, 5: GEOMETRY}  # by format; a policy of format 5 may do without
MAX_MODELS = 16
MAX_SWINGS = 32  # frequencies at which a load may swing
MAX_SIZES = 16  # of a team, from two drones on, that have factors of their own
MAX_NUMBER = 1e6  # of any number in a card or any weight: larger ones only serve to overflow

LQG_SHAPES: dict[str, tuple[int, ...]] = {
    "transition": (STATES, STATES + DRIVES),
    "gain": (STATES, MEASURED),
    "tilt": (2, 4),
    "height": (2,),
    "limits": (3,),
    "stiffness": (),
    "half_length": (),
    "carried": (2,),
}
TEAM_LQG_SHAPES: dict[str, tuple[int, ...]] = {
    "axis": (5, 6),
    "axis_gain": (5, 2),
    "height": (3, 4),
    "height_gain": (3,),
    "tilt": (4,),
    "rise": (2,),
    "limits": (3,),
    "stiffness": (),
    "damping": (),
}
LATER_LQG_SHARES = {3: "lifting", 4: "added_lift"}  # a share that is absent from a format's first files


MULTI_MODEL_SHAPES: dict[str, tuple[int, ...]] = {  # behind an axis of models
    "axis": (5, 6),
    "axis_gain": (5, 2),
    "certainty": (3,),
    "prior": (),
    "tilt": (4,),
    "stiffness": (),
    "damping": (),
}
# Absent, all of a group, from earlier files; "M" for the models, "J" for the swings, "S" for sizes of a team.
LATER_SHAPES: dict[str, tuple[Any, ...]] = {
    "pair_roll_gain": ("M", 5, 2),
    "pair_roll_certainty": ("M", 3),
    "pair_roll_prior": ("M",),
    "pair_roll_room": (),
    "rig_axes": (),
}
SWING_SHAPES: dict[str, tuple[Any, ...]] = {
    "swing": ("J", 5),
    "swing_ahead": ("M", "J", 2),
    "swing_keep": (),
    "held_room": (),
}
SIZE_SHAPES: dict[str, tuple[Any, ...]] = {"by_size": ("S", 4)}
MULTI_MODEL_COMMON: dict[str, tuple[int, ...]] = {
    "height": (3, 4),
    "height_gain": (3,),
    "rise": (2,),
    "limits": (3,),
    "keep": (2,),
}


def check_lqg(card: dict[str, Any], name: str) -> None:
    """Raise PolicyFileError unless later formats have the numbers of their LQG and format 1 has none."""
    lqg, version = card.get("lqg"), card["format_version"]
    in_team, shapes = version in CONTEXTS, {2: LQG_SHAPES, 3: TEAM_LQG_SHAPES}.get(version, {})
    if version in (1, 5):
        if lqg is not None:
            raise PolicyFileError(f"{name}: card field lqg belongs to policy formats 2 to 4, not {version}")
        if version == 5 and "context" in card:
            _check_context(card, name)
        return
    if version == 4:
        stiffness = lqg.get("stiffness") if isinstance(lqg, dict) else None
        models = len(stiffness) if isinstance(stiffness, list) else 0
        if not 1 <= models <= MAX_MODELS:
            raise PolicyFileError(f"{name}: card field lqg.stiffness must be 1 to {MAX_MODELS} numbers")
        every = {field: (models, *shape) for field, shape in MULTI_MODEL_SHAPES.items()}
        shapes = {**every, **MULTI_MODEL_COMMON}
    later = LATER_LQG_SHARES.get(version)
    if isinstance(lqg, dict):
        shapes = {**shapes, **_optional_shapes(lqg, version)}
    positive = ("stiffness", "limits", "damping" if in_team else "carried")
    if not isinstance(lqg, dict) or lqg.keys() != shapes.keys() or card["action_mode"] != "residual":
        raise PolicyFileError(
            f"{name}: a residual policy of format {version} needs card field lqg: {', '.join(shapes)}"
        )
    for field, shape in shapes.items():
        check_numbers(name, f"lqg.{field}", lqg[field], shape)
    if in_team:
        _check_context(card, name)
    if min(np.min(lqg[field]) for field in positive) <= 0:
        raise PolicyFileError(f"{name}: card field lqg: {', '.join(positive[:2])} and {positive[2]} must be positive")
    if version == 4:
        _check_later(lqg, name)
    if later and not 0 <= lqg.get(later, 0) <= 1:
        raise PolicyFileError(f"{name}: card field lqg.{later} must be a share from 0 to 1")


def _check_later(lqg: dict[str, Any], name: str) -> None:
    """Raise PolicyFileError unless what the first files of format 4 do not have is sound, or absent."""
    if not lqg.get("pair_roll_room", 1.0) > 0:
        raise PolicyFileError(f"{name}: card field lqg.pair_roll_room must be positive")
    if lqg.get("rig_axes", 0) not in (0, 1):
        raise PolicyFileError(f"{name}: card field lqg.rig_axes must be 0 or 1")
    if not 1 <= len(lqg.get("swing", [0])) <= MAX_SWINGS:
        raise PolicyFileError(f"{name}: card field lqg.swing must be 1 to {MAX_SWINGS} rows")
    if not 0 <= lqg.get("swing_keep", 0) < 1:
        raise PolicyFileError(f"{name}: card field lqg.swing_keep must be a share below 1")
    if not 1 <= len(lqg.get("by_size", [0])) <= MAX_SIZES or np.min(lqg.get("by_size", 1.0)) <= 0:
        raise PolicyFileError(f"{name}: card field lqg.by_size must be 1 to {MAX_SIZES} rows of positive factors")
    if not lqg.get("held_room", 0) >= 0:
        raise PolicyFileError(f"{name}: card field lqg.held_room must be a factor that is not negative")


def _optional_shapes(lqg: dict[str, Any], version: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the numbers that the first files of a format do not have, as far as `lqg` has them."""
    later = LATER_LQG_SHARES.get(version)
    shapes: dict[str, tuple[int, ...]] = {}
    if later and later in lqg:
        shapes[later] = ()
    counts = {
        letter: len(lqg[field]) if isinstance(lqg.get(field), list) else 0
        for letter, field in (("M", "stiffness"), ("J", "swing"), ("S", "by_size"))
    }
    for group in (LATER_SHAPES, SWING_SHAPES, SIZE_SHAPES) if version == 4 else ():
        if lqg.keys() & group.keys():
            shapes |= {field: tuple(counts.get(size, size) for size in shape) for field, shape in group.items()}
    return shapes


def _check_context(card: dict[str, Any], name: str) -> None:
    """Raise PolicyFileError unless a policy that is told its team names what this version can tell it."""
    context = CONTEXTS[card["format_version"]]
    if card.get("context") != list(context):
        raise PolicyFileError(f"{name} needs another context than this version's {', '.join(context)}")
    if "team" in card:
        _check_team(card["team"], name, context)


def _check_team(team: Any, name: str, context: tuple[str, ...]) -> None:
    """Raise PolicyFileError unless `team` says in which team, and as which of its drones, a policy flies."""
    if not isinstance(team, dict) or team.keys() != {"drone", "mount_angle", "context"}:
        raise PolicyFileError(f"{name}: card field team must hold drone, mount_angle and context")
    for field, shape in (("drone", ()), ("mount_angle", ()), ("context", (len(context),))):
        check_numbers(name, f"team.{field}", team[field], shape)
    share, _, _, *room = team["context"]
    if share <= 1 or min(room) <= 0:
        raise PolicyFileError(f"{name}: card field team.context: command_share must be above 1 and both rooms positive")


def check_numbers(name: str, field: str, value: Any, shape: tuple[int, ...]) -> None:
    """Raise PolicyFileError unless `value` of a card is numbers of `shape`, none of them a string or out of bounds."""
    try:
        array = np.array(value)
    except ValueError:
        array = np.array("ragged")
    if array.shape != shape or array.dtype.kind not in "iuf" or not (np.abs(array) <= MAX_NUMBER).all():
        raise PolicyFileError(f"{name}: card field {field} must be finite numbers of shape {shape}")


def is_finite(value: Any) -> bool:
    """Whether `value` of a card is one number within bounds, no truth value."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER
