"""Import MJX without the note that it prints when NVIDIA Warp is absent (harmless, and noise to a user)."""

from __future__ import annotations

import contextlib
import importlib
import io
from types import ModuleType


def import_mjx() -> ModuleType:
    """Return `mujoco.mjx`, imported silently."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


def import_brax_env() -> tuple[type, type]:
    """Return Brax's `Env` and `State`; Brax imports MJX, hence silently."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        base = importlib.import_module("brax.envs.base")
    return base.Env, base.State
