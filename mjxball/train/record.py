"""`config.json` of a run directory: the configuration, its hash, and where the run comes from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.physics.stepper import TRAINING_ENGINES

# What a run directory holds.
CONFIG_FILE, METRICS, POLICY, CHECKPOINTS = "config.json", "metrics.csv", "policy.npz", "checkpoints"
ORIGIN = ("seed", "physics", "seeds", "sweep")  # what it must say beside the configuration


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
        record = json.loads(path.read_text())
        config = configs.from_dict(record.pop("config"))
    except FileNotFoundError:
        raise InputError(f"{run} is not a run directory: it has no {CONFIG_FILE}") from None
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read: {error}") from None
    lost = [name for name in ORIGIN if name not in record]
    if lost:
        raise InputError(f"{path} lacks {', '.join(lost)}")
    whole = all(isinstance(record[name], int) and not isinstance(record[name], bool) for name in ("seed", "seeds"))
    if record["physics"] not in TRAINING_ENGINES or not whole or record["seeds"] < 1:
        raise InputError(f"{path} has no sound seed, seeds or physics")
    recorded = record.pop("config_hash", None)
    if recorded != configs.config_hash(config):
        raise InputError(f"the configuration in {path} was changed after the run began; restore it, or start a new run")
    return configs.validate(config), record
