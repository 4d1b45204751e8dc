"""On which plant a policy is judged: the paper's, or its own if it was made for two Crazyflies."""

from __future__ import annotations

from pathlib import Path

from mjxball import config as configs
from mjxball.config import Config
from mjxball.policy import Policy


def own_home(path: Path) -> Config | None:
    """The configuration in the card of a policy for Crazyflies, None for any other policy."""
    settings = Policy.load(path).card.get("config")
    autopilot = settings.get("autopilot") if isinstance(settings, dict) else None
    if not isinstance(autopilot, dict) or autopilot.get("kind") != "crazyflie":
        return None
    return configs.validate(configs.from_record(settings))


def by_home(paths: list[Path]) -> tuple[list[Path], list[tuple[Config, list[Path]]]]:
    """(policies for the paper's plant, [(configuration, its policies)] of the others)."""
    here: list[Path] = []
    homes: list[tuple[Config, list[Path]]] = []
    for path in paths:
        home = own_home(path)
        if home is None:
            here.append(path)
            continue
        known = next((there for config, there in homes if config == home), None)
        if known is None:
            homes.append((home, [path]))
        else:
            known.append(path)
    return here, homes
