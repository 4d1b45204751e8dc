"""JAX's persistent compilation cache: on by default, in the user's cache directory."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from mjxball.terminal import warn
from mjxball.xla import check_address_space

VARIABLE = "MJXBALL_CACHE"


def cache_directory() -> Path | None:
    """Where compiled programs are kept: $MJXBALL_CACHE, else the user's cache directory; None if it is `off`."""
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return None if chosen.lower() in ("", "off", "0") else Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "mjxball" / "jax"
    except RuntimeError:  # whoever has no home directory
        return None


def traced_directory() -> Path | None:
    """Where traced programs are kept: in the compilation cache's directory; None if there is no such cache."""
    place = _directory_of_jax()
    return Path(place) / "traced" if place and "://" not in place else None


def _directory_of_jax() -> str | None:
    import jax

    settings: Any = jax.config  # its settings are made while JAX is imported: no type checker knows them
    return settings.jax_compilation_cache_dir


def enable_compilation_cache() -> Path | None:
    """Turn the cache on, unless JAX was told of one or it is switched off; return its directory if it is ours."""
    check_address_space()
    import jax

    place = cache_directory()
    if place is None or _directory_of_jax():
        return None
    try:
        place.mkdir(parents=True, exist_ok=True)
        usable = os.access(place, os.R_OK | os.W_OK | os.X_OK)
    except OSError:
        usable = False
    if not usable:
        text = f"warning: {place} cannot be written: nothing compiled is kept; set {VARIABLE} to another directory"
        warn(text)
        return None
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return place
