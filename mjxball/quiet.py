"""Imports of libraries that would otherwise print notes of no use to a user, or load PyTorch."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import NamedTuple


def import_mjx() -> ModuleType:
    """Return `mujoco.mjx`, without the note that it prints when NVIDIA Warp is absent."""
    with _silence():
        return importlib.import_module("mujoco.mjx")


def import_brax_env() -> tuple[type, type]:
    """Return Brax's `Env` and `State`; Brax imports MJX, hence silently."""
    with _silence():
        base = importlib.import_module("brax.envs.base")
    return base.Env, base.State


def import_tensorboard_writer() -> type:
    """Return tensorboardX's `SummaryWriter`, without PyTorch, which it would load (5 s) where that is installed."""
    with _without("torch"):
        return importlib.import_module("tensorboardX").SummaryWriter


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


@contextlib.contextmanager
def _without(name: str) -> Iterator[None]:
    """Let imports take the optional package `name` for not installed, unless it is loaded already."""
    if name in sys.modules:
        yield
        return
    sys.modules[name] = None  # type: ignore[assignment]  # what Python raises ImportError for
    try:
        yield
    finally:
        del sys.modules[name]


class BraxTraining(NamedTuple):
    """The parts of Brax's training library that work on current JAX."""

    networks: ModuleType
    losses: ModuleType
    running_statistics: ModuleType
    specs: ModuleType
    distribution: ModuleType
    types: ModuleType


def import_brax_training() -> BraxTraining:
    """Return Brax's networks, SAC losses, running statistics and types, imported silently."""
    names = (
        "brax.training.networks",
        "brax.training.agents.sac.losses",
        "brax.training.acme.running_statistics",
        "brax.training.acme.specs",
        "brax.training.distribution",
        "brax.training.types",
    )
    with _silence():
        return BraxTraining(*map(importlib.import_module, names))


class BraxPpo(NamedTuple):
    """The parts of Brax's PPO that work on current JAX."""

    losses: ModuleType
    networks: ModuleType


def import_brax_ppo() -> BraxPpo:
    """Return Brax's PPO losses and networks, imported silently."""
    with _silence():
        return BraxPpo(*(importlib.import_module(f"brax.training.agents.ppo.{name}") for name in BraxPpo._fields))
