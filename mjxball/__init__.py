"""mjxball: two quadrotors carry one object whose centre of gravity moves."""

import os
import sys
from typing import TYPE_CHECKING, Any

# Silence XLA, which writes two lines of 2 kB to stderr for each CPU program that it loads from its cache. Errors are
# raised as exceptions anyway.
if "jax" not in sys.modules:
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
elif os.environ.get("TF_CPP_MIN_LOG_LEVEL") == "1":  # JAX's own setting, which jaxlib has already read
    _set_level = getattr(sys.modules.get("jaxlib.utils"), "absl_set_min_log_level", None)
    if _set_level:
        _set_level(3)

__version__ = "0.2.0"
__all__ = ["Policy", "Scenario", "Trajectory", "__version__", "simulate"]

if TYPE_CHECKING:
    from mjxball.policy import Policy
    from mjxball.sim.rollout import simulate
    from mjxball.sim.scenario import Scenario
    from mjxball.sim.trajectory import Trajectory

_MODULES = {
    "Policy": "mjxball.policy",
    "Scenario": "mjxball.sim.scenario",
    "Trajectory": "mjxball.sim.trajectory",
    "simulate": "mjxball.sim.rollout",
}


def __getattr__(name: str) -> Any:
    """Import public names on first use, so that the base install needs nothing but NumPy."""
    import importlib

    if name not in _MODULES:
        raise AttributeError(f"module 'mjxball' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
