"""Where a run comes from: versions, source and commit, recorded with it and compared when it is resumed."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1]
# What a training result depends on; the judge and the flight code are not among it.
SOURCES = (
    "config",
    "assembly.py",
    "env.py",
    "rewards.py",
    "control",
    "physics",
    "sim",
    "algorithms",
    "train",
)
LIBRARIES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy")


def source_hash() -> str:
    """First 16 hex digits of the SHA-256 of all source files that a training result depends on."""
    digest = hashlib.sha256()
    for name in SOURCES:
        place = PACKAGE / name
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that a training result depends on."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "absent"
    return found


def commit() -> str:
    """The commit of the source tree, marked `-dirty` if it has changes, or 'unknown' outside a repository.

    `MJXBALL_COMMIT` overrules it, for containers and copied trees.
    """
    if given := os.environ.get("MJXBALL_COMMIT"):
        return given
    command = ["git", "-C", str(PACKAGE), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def differences(recorded: Mapping[str, Any]) -> list[str]:
    """How this program differs from the one that made a run with the origin `recorded`, one phrase each."""
    found = []
    if recorded.get("source_hash") != source_hash():
        found.append(f"source {recorded.get('source_hash')} (commit {recorded.get('commit')}) is now {source_hash()}")
    old = recorded.get("versions") or {}
    for name, version in versions().items():
        if old.get(name) != version:
            found.append(f"{name} {old.get(name)} is now {version}")
    return found
