"""Import MJX without the note that it prints when NVIDIA Warp is absent (harmless, and noise to a user)."""

from __future__ import annotations

import contextlib
import importlib
import io
from types import ModuleType
from typing import NamedTuple


def import_mjx() -> ModuleType:
    """Return `mujoco.mjx`, imported silently."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


def import_brax_env() -> tuple[type, type]:
    """Return Brax's `Env` and `State`; Brax imports MJX, hence silently."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        base = importlib.import_module("brax.envs.base")
    return base.Env, base.State


class BraxTraining(NamedTuple):
    """The parts of Brax's training library that work on current JAX."""

    networks: ModuleType
    sac_networks: ModuleType
    losses: ModuleType
    running_statistics: ModuleType
    specs: ModuleType
    distribution: ModuleType
    types: ModuleType


def import_brax_training() -> BraxTraining:
    """Return Brax's networks, SAC losses, running statistics and types, imported silently."""
    names = (
        "brax.training.networks",
        "brax.training.agents.sac.networks",
        "brax.training.agents.sac.losses",
        "brax.training.acme.running_statistics",
        "brax.training.acme.specs",
        "brax.training.distribution",
        "brax.training.types",
    )
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return BraxTraining(*map(importlib.import_module, names))
