"""Classical followers by name, with gains that follow from the plant; all but `copy` are ours.

The adaptive controller that the paper compares with is not public. This package may use SciPy; `copy` lives in
`control.followers`, which needs NumPy alone.
"""

from __future__ import annotations

from collections.abc import Callable

from mjxball.baselines.adaptive import Adaptive
from mjxball.baselines.crazyflie_lqg import CrazyflieLqg
from mjxball.baselines.lqg import KnownFailuresLqg, Lqg, Memoryless, OffsetFree, SlowLqg
from mjxball.baselines.mpc import Mpc
from mjxball.baselines.observer import Observer
from mjxball.baselines.pid import Pid
from mjxball.baselines.reference import Oracle, Random, Stay
from mjxball.baselines.team_lqg import TeamOffsetFree
from mjxball.config import Config
from mjxball.control.followers import Baseline, Controller, Copy
from mjxball.errors import InputError

__all__ = [
    "BASELINES",
    "CONTROLLERS",
    "Adaptive",
    "Copy",
    "CrazyflieLqg",
    "KnownFailuresLqg",
    "Lqg",
    "Memoryless",
    "Mpc",
    "Observer",
    "OffsetFree",
    "Oracle",
    "Pid",
    "Random",
    "SlowLqg",
    "Stay",
    "make_baseline",
    "make_controller",
]

CONTROLLERS: dict[str, Callable[[Config], Controller]] = {
    "stay": Stay,
    "random": Random,
    "copy": Copy,
    "adaptive": Adaptive,
    "adaptive-mass": lambda config: Adaptive(config, adapts_mass=True),
    "oracle": Oracle,
    "memoryless": Memoryless,
    "pid": Pid,
    "observer": Observer,
    "lqg": lambda config: CrazyflieLqg(config) if config.autopilot.kind == "crazyflie" else Lqg(config),
    "lqg-slow": SlowLqg,
    "lqg-offset-free": lambda config: TeamOffsetFree(config) if config.plant.is_team else OffsetFree(config),
    "mpc": Mpc,
    "lqg-known-failures": KnownFailuresLqg,
}
VARIANTS = ("adaptive-mass", "pid", "observer", "lqg-slow", "lqg-offset-free", "mpc", "lqg-known-failures")
BASELINES = tuple(name for name in CONTROLLERS if name not in VARIANTS)  # default followers of `eval.py`


def make_controller(name: str, config: Config) -> Controller:
    """The classical controller called `name` with gains that follow from `config`; InputError if unknown."""
    if name not in CONTROLLERS:
        raise InputError(f"unknown follower {name!r}; baselines are {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](config)


def make_baseline(name: str, config: Config) -> Baseline:
    """The classical follower called `name` for `config`, with its state; InputError if unknown."""
    return Baseline(make_controller(name, config), config)
