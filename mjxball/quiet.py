"""Imports of libraries that would otherwise print notes of no use to a user, or load PyTorch."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

FOR_MESHES = ("trimesh", "scipy.spatial")  # what MJX imports for meshes alone: that takes as long as JAX


def quietly(name: str) -> Any:
    """The module `name`, imported without what it prints: MJX, also behind Brax, says that NVIDIA Warp is absent.

    Those `FOR_MESHES` are imported when MJX calls them.
    """
    with contextlib.ExitStack() as around:
        around.enter_context(contextlib.redirect_stdout(io.StringIO()))
        around.enter_context(contextlib.redirect_stderr(io.StringIO()))
        for later in FOR_MESHES:
            around.enter_context(_postponed(later))
        return importlib.import_module(name)


@contextlib.contextmanager
def _postponed(name: str) -> Iterator[None]:
    """Who imports the module `name` in here gets one whose functions and classes import it when they are called."""

    def find(attribute: str) -> Any:
        if attribute.startswith("__"):
            raise AttributeError(attribute)

        def call(*arguments: Any, **named: Any) -> Any:
            return getattr(importlib.import_module(name), attribute)(*arguments, **named)

        return call

    if name in sys.modules:
        yield
        return
    stand_in = ModuleType(name)
    stand_in.__dict__["__getattr__"] = find  # PEP 562
    sys.modules[name] = stand_in
    try:
        yield
    finally:
        if sys.modules.get(name) is stand_in:
            del sys.modules[name]


def _initialised_when_used(name: str) -> None:
    """Have the package `name` without running its `__init__`, which happens when it is asked for what that defines."""
    spec = importlib.util.find_spec(name)
    if name in sys.modules or spec is None or spec.loader is None:
        return
    package, loader = importlib.util.module_from_spec(spec), spec.loader

    def find(attribute: str) -> Any:
        if attribute.startswith("__"):
            raise AttributeError(attribute)
        if package.__dict__.pop("__getattr__", None):
            try:
                loader.exec_module(package)
            except BaseException:
                package.__dict__["__getattr__"] = find
                raise
        return getattr(package, attribute)

    package.__dict__["__getattr__"] = find  # PEP 562
    sys.modules[name] = package


def import_mjx() -> ModuleType:
    """`mujoco.mjx`."""
    return quietly("mujoco.mjx")


def import_brax_env() -> tuple[type, type]:
    """Brax's `Env` and `State`."""
    base = quietly("brax.envs.base")
    return base.Env, base.State


def import_tensorboard() -> Any:
    """tensorboardX, without PyTorch, which it would load (5 s) where that is installed."""
    if "torch" in sys.modules:
        return importlib.import_module("tensorboardX")
    sys.modules["torch"] = None  # type: ignore[assignment]  # what Python raises ImportError for
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
    """Brax's networks, SAC losses, running statistics and types; not its physics, which takes as long to import."""
    _initialised_when_used("brax")
    names = ("networks", "agents.sac.losses", "acme.running_statistics", "acme.specs", "distribution", "types")
    return BraxTraining(*(quietly(f"brax.training.{name}") for name in names))


class BraxPpo(NamedTuple):
    """The parts of Brax's PPO that work on current JAX."""

    losses: ModuleType
    networks: ModuleType


def import_brax_ppo() -> BraxPpo:
    """Brax's PPO losses and networks."""
    return BraxPpo(*(quietly(f"brax.training.agents.ppo.{name}") for name in BraxPpo._fields))
