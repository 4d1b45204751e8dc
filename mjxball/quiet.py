"""Imports of libraries that would otherwise print notes of no use to a user, or load what is not needed."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType
from typing import NamedTuple

# Collisions of meshes (trimesh, most of SciPy) and a solver of Brax's own physics: a quarter of the time it takes to
# import Brax and MJX, for code that a flying assembly never reaches.
LATE = ("mujoco.mjx._src.mesh", "jaxopt")


def import_mjx() -> ModuleType:
    """Return `mujoco.mjx`, without the note that it prints when NVIDIA Warp is absent."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()), _when_used(*LATE):
        return importlib.import_module("mujoco.mjx")


def import_brax_env() -> tuple[type, type]:
    """Return Brax's `Env` and `State`; Brax imports MJX, hence silently."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()), _when_used(*LATE):
        base = importlib.import_module("brax.envs.base")
    return base.Env, base.State


def import_tensorboard_writer() -> type:
    """Return tensorboardX's `SummaryWriter`, without PyTorch, which it would load (5 s) where that is installed."""
    with _without("torch"):
        return importlib.import_module("tensorboardX").SummaryWriter


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


class _Late(MetaPathFinder):
    """Finds the modules `names`, to be loaded when something in them is first asked for."""

    def __init__(self, names: Sequence[str]):
        self._names = names

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Where `fullname` is; None, and the next finder is asked, if it is none of ours or not installed."""
        found = PathFinder.find_spec(fullname, path, target) if fullname in self._names else None
        if found and found.loader:
            found.loader = LazyLoader(found.loader)
        return found


@contextlib.contextmanager
def _when_used(*names: str) -> Iterator[None]:
    """Let imports of the modules `names` load them when they are used, not before."""
    finder = _Late(names)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


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
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()), _when_used(*LATE):
        return BraxTraining(*map(importlib.import_module, names))
