"""A sweep: settings that differ between the members of a population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.train.reading import read_json

SWEEPABLE = (
    "sac.learning_rate",
    "sac.alpha_learning_rate",
    "sac.learning_rate_end",
    "sac.discount",
    "sac.target_rate",
    "sac.alpha",
    "sac.target_entropy",
    "sac.reward_scale",
    "sac.policy_average",
    "follower.tilt_limit",
    "follower.vertical_limit",
    *(f"reward.{name}" for name in ("error", "error_scale", "velocity", "tilt", "rates", "effort", "smoothness")),
)
Sweep = Mapping[str, Sequence[float]]


def read_sweep(path: Path, members: int, config: Config) -> dict[str, list[float]]:
    """A sweep file: JSON {"<config path>": [one number for each member], ...}. Raises InputError if unsound."""
    try:
        sweep = read_json(path, "sweep file")
    except FileNotFoundError:
        raise InputError(f"sweep file {path} does not exist") from None
    check_sweep(sweep, members, config, f"sweep file {path}")
    return sweep


def check_sweep(sweep: Any, members: int, config: Config, where: str) -> None:
    """Raise InputError, which begins with `where`, unless `sweep` fits `members` followers of `config`."""
    if not isinstance(sweep, dict) or not sweep:
        raise InputError(f"{where} must hold an object of settings")
    for name, values in sweep.items():
        if name not in SWEEPABLE:
            raise InputError(f"{where}: {name!r} cannot differ between members; {', '.join(SWEEPABLE)} can")
        if not isinstance(values, list) or len(values) != members:
            raise InputError(f"{where}: {name} needs {members} numbers, one for each seed")
        for value in values:
            whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
            configs.validate(configs.replace(config, name, float(value) if whole else value))
