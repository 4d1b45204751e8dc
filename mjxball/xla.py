"""XLA: flags set before JAX initialises its devices, the compilation cache, and errors explained to users."""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path
from typing import Any

from mjxball.errors import InputError
from mjxball.files import user_cache
from mjxball.terminal import warn

# On CPUs a loop whose body touches fewer bytes than this compiles to one LLVM function. Otherwise XLA's runtime calls a
# function per operation, which takes longer than the operation itself on arrays of dozens of elements.
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"


def compile_small_loops_whole() -> None:
    """Add `SMALL_LOOPS` to XLA_FLAGS of this process, unless they already set extra backend options."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SMALL_LOOPS}".strip()


# XLA runs the small operations of one device on one core. Environments are cut into as many parts wherever there are
# cores for them or not, so that a seed gives the same training everywhere.
CPU_DEVICES = "--xla_force_host_platform_device_count=2"


def use_two_cpu_devices() -> None:
    """Add `CPU_DEVICES` to XLA_FLAGS of this process, unless they already say how many there are."""
    flags = os.environ.get("XLA_FLAGS", "")
    if CPU_DEVICES.partition("=")[0] not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {CPU_DEVICES}".strip()


def explained(error: BaseException) -> str | None:
    """A sentence on what the user can do about an `error` of JAX; None for other errors.

    Without a device of `JAX_PLATFORMS`, JAX fails in many ways, for example with an assertion without a message.
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
    """Raise InputError if `ulimit -v` is so low that JAX would hang or abort without a message."""
    limit, needed = resource.getrlimit(resource.RLIMIT_AS)[0], ADDRESS_SPACE / 1e9
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise InputError(
            f"the limit of address space, ulimit -v, is {limit / 1e9:.3g} GB, and JAX needs {needed:g} GB and what the "
            "arrays take: raise it, or say ulimit -v unlimited"
        )


def room_in_address_space() -> float:
    """Address space that this process may still reserve [B]."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return float("inf")
    with open("/proc/self/statm", encoding="ascii") as stream:
        return limit - int(stream.read().split()[0]) * resource.getpagesize()


VARIABLE = "MJXBALL_CACHE"


def cache_directory() -> Path | None:
    """Directory of compiled programs: $MJXBALL_CACHE, else in `user_cache`; None if that is `off` or does not exist."""
    setting = os.environ.get(VARIABLE)
    if setting is not None:
        return None if setting.lower() in ("", "off", "0") else Path(setting)
    parent = user_cache()
    return parent and parent / "jax"


def traced_directory() -> Path | None:
    """Directory of traced programs, inside that of the compilation cache; None without a local one."""
    directory = _directory_of_jax()
    return Path(directory) / "traced" if directory and "://" not in directory else None


def _directory_of_jax() -> str | None:
    import jax

    settings: Any = jax.config  # its attributes are created at import, so type checkers do not know them
    return settings.jax_compilation_cache_dir


def enable_compilation_cache() -> Path | None:
    """Enable JAX's compilation cache in `cache_directory()`; return that, or None if unused or JAX has one already."""
    check_address_space()
    import jax

    directory = cache_directory()
    if directory is None or _directory_of_jax():
        return None
    try:
        directory.mkdir(parents=True, exist_ok=True)
        usable = os.access(directory, os.R_OK | os.W_OK | os.X_OK)
    except OSError:
        usable = False
    if not usable:
        warn(f"warning: {directory} cannot be written: nothing compiled is kept; set {VARIABLE} to another directory")
        return None
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return directory
