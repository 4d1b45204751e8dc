"""`config.json` of a run directory: the configuration, its hash, and where the run comes from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.physics.stepper import TRAINING_ENGINES
from mjxball.train.reading import read_json
from mjxball.train.sweep import check_sweep

# What a run directory holds.
CONFIG_FILE, METRICS, POLICY, CHECKPOINTS = "config.json", "metrics.csv", "policy.npz", "checkpoints"
EXTENSIONS = ("env", "reward", "algorithm")  # what a run may use of the user's own, by name
MOST_MEMBERS = 4096
LARGEST_SEED = 2**31 - 1
ORIGIN = ("seed", "physics", "seeds", "sweep")  # what it must say beside the configuration


def _is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def write_config(run: Path, config: Config, origin: dict[str, Any]) -> None:
    """Write the run's `config.json`: configuration, its hash, and `origin` (seed, physics, command, commit)."""
    record = {"config": configs.to_dict(config), "config_hash": configs.config_hash(config), **origin}
    partial = run / f".{CONFIG_FILE}.partial"
    partial.write_text(json.dumps(record, indent=2) + "\n")
    partial.replace(run / CONFIG_FILE)


def read_config(run: Path) -> tuple[Config, dict[str, Any]]:
    """Configuration and origin of a run directory; raise InputError if it is none."""
    path = run / CONFIG_FILE
    try:
        record = read_json(path, "")
    except FileNotFoundError:
        raise InputError(f"{run} is not a run directory: it has no {CONFIG_FILE}") from None
    if not isinstance(record, dict) or "config" not in record:
        raise InputError(f"{path} holds no configuration")
    settings = record.pop("config")
    try:
        config = configs.from_dict(settings)
    except (TypeError, OverflowError) as error:  # a value of another kind than any setting, a number beyond all floats
        raise InputError(f"{path} holds no configuration: {error}") from None
    lost = [name for name in ORIGIN if name not in record]
    if lost:
        raise InputError(f"{path} lacks {', '.join(lost)}")
    sound = _is_whole(record["seed"], 0, LARGEST_SEED) and _is_whole(record["seeds"], 1, MOST_MEMBERS)
    if not sound or record["physics"] not in TRAINING_ENGINES:
        raise InputError(f"{path} has no sound seed, seeds or physics")
    if record["sweep"] is not None:
        record["sweep"] = check_sweep(record["sweep"], record["seeds"], configs.validate(config), str(path))
    if record.pop("config_hash", None) != configs.config_hash(settings):
        raise InputError(f"the configuration in {path} was changed after the run began; restore it, or start a new run")
    return configs.validate(config), record
