"""Classical followers by name, with gains that follow from the plant; all but `copy` are ours.

The adaptive controller that the paper compares with is not public. This package may use SciPy; `copy` lives in
`control.followers`, which needs NumPy alone.
"""

from __future__ import annotations

from collections.abc import Callable

from mjxball.baselines.adaptive import Adaptive
from mjxball.baselines.crazyflie_lqg import CalmCrazyflieLqg, CrazyflieLqg, DisturbedCrazyflieLqg
from mjxball.baselines.crazyflie_oracle import CrazyflieOracle
from mjxball.baselines.lqg import CalmLqg, DisturbedLqg, Lqg
from mjxball.baselines.mpc import Mpc
from mjxball.baselines.observer import Observer
from mjxball.baselines.oracle import Oracle
from mjxball.baselines.pid import Pid
from mjxball.baselines.reference import Random, Stay
from mjxball.config import Config
from mjxball.control.followers import Baseline, Controller, Copy
from mjxball.errors import InputError
from mjxball.reading import near

__all__ = [
    "BASELINES",
    "CONTROLLERS",
    "Adaptive",
    "CalmCrazyflieLqg",
    "CalmLqg",
    "Copy",
    "CrazyflieLqg",
    "CrazyflieOracle",
    "DisturbedCrazyflieLqg",
    "DisturbedLqg",
    "Lqg",
    "Mpc",
    "Observer",
    "Oracle",
    "Pid",
    "Random",
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
    "oracle": lambda config: _of_kind(config, Oracle, CrazyflieOracle),
    "pid": Pid,
    "observer": Observer,
    "lqg": lambda config: _of_kind(config, Lqg, CrazyflieLqg),
    "lqg-calm": lambda config: _of_kind(config, CalmLqg, CalmCrazyflieLqg),
    "lqg-disturbed": lambda config: _of_kind(config, DisturbedLqg, DisturbedCrazyflieLqg),
    "mpc": Mpc,
}
VARIANTS = ("adaptive-mass", "pid", "observer", "lqg-calm", "lqg-disturbed", "mpc")
BASELINES = tuple(name for name in CONTROLLERS if name not in VARIANTS)  # default followers of `eval.py`


def _of_kind(
    config: Config, ideal: Callable[[Config], Controller], firmware: Callable[[Config], Controller]
) -> Controller:
    """The controller for the attitude loops of `config`: ideal ones, or a Crazyflie's."""
    return (firmware if config.autopilot.kind == "crazyflie" else ideal)(config)


def make_controller(name: str, config: Config) -> Controller:
    """The classical controller called `name` with gains that follow from `config`; InputError if unknown."""
    if name not in CONTROLLERS:
        raise InputError(f"unknown follower {name!r}{near(name, CONTROLLERS)}; baselines are {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](config)


def make_baseline(name: str, config: Config) -> Baseline:
    """The classical follower called `name` for `config`, with its state; InputError if unknown."""
    return Baseline(make_controller(name, config), config)
