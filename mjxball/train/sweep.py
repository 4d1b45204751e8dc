"""A sweep: settings that differ between the members of a population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.train.reading import read_json

UNSWEPT = ("sac.curriculum", "sac.max_grad_norm")  # the program branches on whether they are 0
# Every real-valued setting of algorithm and reward, and the follower's action scales: those may be traced.
SWEEPABLE = (
    *(
        path
        for path, value, _ in configs.leaves(Config())
        if isinstance(value, float) and path.startswith(("sac.", "reward.")) and path not in UNSWEPT
    ),
    "follower.action_scale_tilt",
    "follower.action_scale_vertical",
)
Sweep = Mapping[str, Sequence[float]]


def read_sweep(path: Path, members: int, config: Config) -> dict[str, list[float]]:
    """A sweep file: JSON {"<config path>": [one number for each member], ...}. Raises InputError if unsound."""
    try:
        sweep = read_json(path, "sweep file")
    except FileNotFoundError:
        raise InputError(f"sweep file {path} does not exist") from None
    return check_sweep(sweep, members, config, f"sweep file {path}")


def check_sweep(sweep: Any, members: int, config: Config, where: str) -> dict[str, list[float]]:
    """`sweep` under the settings' present names; InputError that begins with `where` unless it fits the members."""
    if not isinstance(sweep, dict) or not sweep:
        raise InputError(f"{where} must hold an object of settings")
    for given, values in sweep.items():
        name = configs.current_name(given)
        if name not in SWEEPABLE:
            raise InputError(f"{where}: {given!r} cannot differ between members; {', '.join(SWEEPABLE)} can")
        if not isinstance(values, list) or len(values) != members:
            raise InputError(f"{where}: {name} needs {members} numbers, one for each seed")
        for value in values:
            whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
            configs.validate(configs.replace(config, name, float(value) if whole else value))
    return {configs.current_name(name): values for name, values in sweep.items()}
