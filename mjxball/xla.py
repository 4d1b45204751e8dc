"""What XLA is told before JAX finds its devices, where it keeps what it compiles, and what its errors mean to users."""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path
from typing import Any

from mjxball.errors import InputError
from mjxball.files import user_cache
from mjxball.terminal import warn

# On CPUs a loop whose body touches fewer bytes than that becomes one function of LLVM's, instead of one for each
# operation of its body, called by XLA's runtime, which takes longer than the operation if that has dozens of numbers.
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"


def compile_small_loops_whole() -> None:
    """Add `SMALL_LOOPS` to this process's flags, unless these say something of such options themselves."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SMALL_LOOPS}".strip()


def explained(error: BaseException) -> str | None:
    """What a user can do about an `error` of JAX's, a sentence; None if it is nothing of the kind.

    Without a device of `JAX_PLATFORMS` JAX fails in many ways, one of them an assertion without a word.
    """
    jax: Any = sys.modules.get("jax")
    if isinstance(error, MemoryError):
        return "there is not enough memory; make it smaller, or see `ulimit -v` and other programs"
    if jax is None or not hasattr(jax, "devices"):
        return None
    if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error):
        return f"there is not enough memory: {str(error).splitlines()[0][:200]}"
    try:
        jax.devices()
    except Exception as missing:  # RuntimeError or AssertionError, as the platform may be
        wanted, why = jax.config.jax_platforms, (str(missing).splitlines() or [""])[0][:200]
        return f"JAX has no device of JAX_PLATFORMS={wanted}; unset that or say cpu{': ' if why else ''}{why}"
    return None


ADDRESS_SPACE = 2.5e9  # [B] that JAX, its compiler and their threads reserve; with less they hang or abort


def check_address_space() -> None:
    """Refuse to start JAX below a limit in which it would hang or abort without a word. Raises InputError."""
    limit, needed = resource.getrlimit(resource.RLIMIT_AS)[0], ADDRESS_SPACE / 1e9
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise InputError(
            f"the limit of address space, ulimit -v, is {limit / 1e9:.3g} GB, and JAX needs {needed:g} GB and what the "
            "arrays take: raise it, or say ulimit -v unlimited"
        )


def room_in_address_space() -> float:
    """What this process may still reserve [B]."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return float("inf")
    with open("/proc/self/statm", encoding="ascii") as stream:
        return limit - int(stream.read().split()[0]) * resource.getpagesize()


VARIABLE = "MJXBALL_CACHE"


def cache_directory() -> Path | None:
    """Where compiled programs are kept: $MJXBALL_CACHE, else in `user_cache`; None if it is `off` or there is none."""
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        return None if chosen.lower() in ("", "off", "0") else Path(chosen)
    place = user_cache()
    return place and place / "jax"


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
