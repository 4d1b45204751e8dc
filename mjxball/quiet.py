"""Imports of libraries without the notes that they print or the PyTorch that they load."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from types import ModuleType
from typing import Any, NamedTuple


def import_quietly(name: str) -> Any:
    """Import the module `name` without output. MJX, which Brax imports too, prints that NVIDIA Warp is absent."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return importlib.import_module(name)


def import_mjx() -> ModuleType:
    """`mujoco.mjx`."""
    return import_quietly("mujoco.mjx")


def import_brax_env() -> tuple[type, type]:
    """Brax's `Env` and `State`."""
    base = import_quietly("brax.envs.base")
    return base.Env, base.State


def import_tensorboard() -> Any:
    """tensorboardX, without PyTorch, which it would import (5 s) if it is installed."""
    if "torch" in sys.modules:
        return importlib.import_module("tensorboardX")
    sys.modules["torch"] = None  # type: ignore[assignment]  # makes `import torch` raise ImportError
    try:
        return importlib.import_module("tensorboardX")
    finally:
        del sys.modules["torch"]


class BraxTraining(NamedTuple):
    """The parts of Brax's training library that work on current JAX."""

    networks: ModuleType
    losses: ModuleType
    running_statistics: ModuleType
    specs: ModuleType
    distribution: ModuleType
    types: ModuleType


def import_brax_training() -> BraxTraining:
    """Brax's networks, SAC losses, running statistics and types."""
    names = ("networks", "agents.sac.losses", "acme.running_statistics", "acme.specs", "distribution", "types")
    return BraxTraining(*(import_quietly(f"brax.training.{name}") for name in names))


class BraxPpo(NamedTuple):
    """The parts of Brax's PPO that work on current JAX."""

    losses: ModuleType
    networks: ModuleType


def import_brax_ppo() -> BraxPpo:
    """Brax's PPO losses and networks."""
    return BraxPpo(*(import_quietly(f"brax.training.agents.ppo.{name}") for name in BraxPpo._fields))
