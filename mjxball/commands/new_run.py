"""Settings, origin and directory of a run of `train.py`. Every request that cannot be trained is refused here."""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib.util
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mjxball import __version__, cli, config
from mjxball.algorithms import ALGORITHMS
from mjxball.errors import InputError
from mjxball.evaluate.scenarios import standard_scenarios
from mjxball.physics.step import TRAINING_ENGINES
from mjxball.train import shares
from mjxball.train.lock import LOCK, check_free
from mjxball.train.run_directory import (
    EXTENSIONS,
    MAX_SEED,
    MOST_MEMBERS,
    commit,
    differences,
    file_hash,
    members_of,
    read_json,
    read_sweep,
    source_hash,
    start_policy,
    versions,
)
from mjxball.xla import compile_small_loops_whole, use_two_cpu_devices

MOST_MINUTES = 1e5
# Packages that a run imports only after it has begun, some after hours.
LATE_IMPORTS = ("tensorboardX", "orbax.checkpoint", "mujoco", "scipy", "matplotlib", "jinja2")


def new_run(options: argparse.Namespace, command: str) -> tuple[config.Config, dict[str, Any], Path]:
    """(configuration, origin, directory) of a new run. Raises InputError for a request that cannot be trained."""
    name, options.algorithm = chosen(options)
    seed = options.seed or 0
    _refuse_settings_of_others(options)
    settings = cli.apply_config_flags(config.preset(name), options)
    if not 0 <= seed <= MAX_SEED:
        raise InputError(f"--seed must be between 0 and {MAX_SEED}, not {seed}")
    stem = options.env.rpartition(":")[2] if options.env else name
    out = output_directory(options.out or Path("runs") / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}")
    standard_scenarios(settings)
    members = 1 if options.num_seeds is None else options.num_seeds
    if not 1 <= members <= MOST_MEMBERS:
        raise InputError(f"--num-seeds must be between 1 and {MOST_MEMBERS}, not {members}")
    if options.minutes is not None:
        _check_minutes(options)
    extensions = {name: getattr(options, name) for name in EXTENSIONS if getattr(options, name) is not None}
    if extensions.get("algorithm") == "sac":  # the default, which needs no check
        del extensions["algorithm"]
    physics = options.physics or "mjx"
    if extensions:
        physics = _check_extensions(
            extensions, settings, options.physics, bool(options.distributed), _members_here(options, members)
        )
    origin: dict[str, Any] = {
        "command": command,
        "seed": seed,
        "physics": physics,
        "seeds": members,
        "sweep": None if options.sweep is None else read_sweep(options.sweep, members, settings),
        "package_version": __version__,
        "commit": commit(),
        "source_hash": source_hash(),
        "versions": versions(),
    }
    if options.minutes is not None:
        origin["minutes"] = options.minutes
    if options.start_from is not None:
        origin["start_from"] = _start_from(options, settings, members)
    if options.share is not None:
        shares.take(origin, *shares.read(options.share))
    if extensions:
        origin |= {"extensions": extensions, "extension_hash": _digest(extensions)}
    return settings, origin, out


def _members_here(options: argparse.Namespace, members: int) -> int:
    """Members that this command trains, of all: those of its share."""
    return members if options.share is None else max(members // shares.read(options.share)[1], 1)


def chosen(options: argparse.Namespace) -> tuple[str, str]:
    """(preset, algorithm) of a command that may leave out either."""
    swept = read_json(options.sweep, "sweep file") if options.sweep else {}
    settings = [*_given(options), *(swept if isinstance(swept, dict) else ())]  # `read_sweep` refuses another sweep
    sections = {path.partition(".")[0] for path in settings}
    algorithm = options.algorithm or next((one for one in ALGORITHMS if one in sections), None)
    if algorithm is None and (options.env or options.physics == "mjx"):  # of which no gradient is known
        algorithm = "sac"
    name = options.preset or (cli.read_plant(options.plant).preset if options.plant else None)
    if name is None:
        name = "quick" if algorithm in (None, "gradient") and not options.plant else "transport"
    return name, algorithm or config.algorithm_of(name)


def _given(options: argparse.Namespace) -> list[str]:
    """Names of the settings that a command gives."""
    return [name.removeprefix("config:") for name, value in vars(options).items() if value and "config:" in name]


def check_packages() -> None:
    """Raise ModuleNotFoundError if one of `LATE_IMPORTS` is not installed, before training starts."""
    for name in LATE_IMPORTS:
        if importlib.util.find_spec(name) is None:
            package = name.partition(".")[0]
            raise ModuleNotFoundError(f"{package} is not installed", name=package)


@contextlib.contextmanager
def clean_up_unless_begun(out: Path, errors: type[Exception] | tuple[()]) -> Iterator[Callable[[], None]]:
    """Empty the new `out` if one of `errors` is raised before the function that this yields is called.

    Training calls it when it begins. After an earlier error the same command can be given again.
    """
    begun = threading.Event()
    try:
        yield begun.set
    except errors:
        if not begun.is_set():
            for place in (place for place in out.glob("*") if place.name != LOCK):
                shutil.rmtree(place) if place.is_dir() else place.unlink()
        raise


def output_directory(out: Path) -> Path:
    """`out`, if it can be made or is empty but for a lock. Raises InputError otherwise, first if a run holds it."""
    try:
        return cli.output_directory(out, but=(LOCK,))
    except InputError:
        check_free(out)  # that another run holds it is the more helpful error
        raise


def _start_from(options: argparse.Namespace, settings: config.Config, members: int) -> Any:
    """The policy file (as in `run_directory.start_policy`) that the run starts from, or a list, one per member."""
    if options.algorithm != "gradient" or options.env:
        raise InputError(
            "--start-from needs --algorithm gradient and no --env: the others begin with more than a policy"
        )
    if not options.start_from.is_dir():
        return _start(options.start_from, settings)
    files = members_of(options.start_from)
    if len(files) != members:
        raise InputError(
            f"{options.start_from} has {len(files)} members and the run {members}; say --num-seeds {len(files)}"
        )
    return [_start(path, settings) for path in files]


def _start(path: Path, settings: config.Config) -> dict[str, str]:
    """Path and hash of a policy file to start from. Raises InputError unless it fits `settings`."""
    start = {"policy": str(path), "sha256": file_hash(path)}
    start_policy(start, settings)
    return start


def _check_minutes(options: argparse.Namespace) -> None:
    """Raise InputError unless --minutes can be kept. What is meant to be the same everywhere goes by steps."""
    if not 0 < options.minutes <= MOST_MINUTES:
        raise InputError(f"--minutes must be above 0 and at most {MOST_MINUTES:g}, not {options.minutes:g}")
    if options.distributed or options.share is not None:
        other = "--distributed" if options.distributed else "--share"
        raise InputError(f"--minutes goes by the clock of one process, and {other} by steps; drop one of them")


def _digest(names: dict[str, str]) -> str | None:
    from mjxball.train.extensions import digest

    return digest(names)


def _refuse_settings_of_others(options: argparse.Namespace) -> None:
    """Raise InputError for a setting of a built-in algorithm other than the one that trains."""
    used = options.algorithm
    for path in _given(options):
        section = path.partition(".")[0]
        if used in ALGORITHMS and section in ALGORITHMS and section != used:
            raise InputError(
                f"--{path} is a setting of {section}, and {used} trains; drop it or say --algorithm {section}"
            )


def _check_extensions(
    names: dict[str, str], settings: config.Config, wanted: str | None, distributed: bool, members: int
) -> str:
    """The physics engine to train on. Raises InputError for an extension that is not found or does not fit."""
    from mjxball.train.extensions import Extensions, make_env, resolve

    extensions = resolve(Extensions(**names))
    _choose_processor(extensions.algorithm, settings, members)
    if not distributed:
        wake_devices()
    engines = getattr(extensions.algorithm, "engines", TRAINING_ENGINES)
    physics = wanted or engines[0]
    if physics not in engines:
        raise InputError(
            f"--algorithm {names['algorithm']} cannot train on --physics {physics}; it can on {', '.join(engines)}"
        )
    if not distributed:  # the processes connect before any of them uses a device; training repeats this check
        make_env(extensions, settings, physics)
    missing = [name for name in ("init", "collect", "update", "policy") if not hasattr(extensions.algorithm, name)]
    if extensions.algorithm is not None and missing:
        raise InputError(
            f"--algorithm {names['algorithm']} lacks {', '.join(missing)}; see docs/howto/own-algorithm.md"
        )
    return physics


def _choose_processor(algorithm: Any, settings: config.Config, members: int) -> None:
    """Select the CPU for an algorithm that prefers it (`Algorithm`), unless JAX_PLATFORMS is set.

    Wherever such an algorithm trains on a CPU, that is two devices, with small loops compiled whole.
    """
    import jax

    prefers = getattr(algorithm, "prefers_cpu", False)
    if not prefers:
        return
    compile_small_loops_whole()
    use_two_cpu_devices()
    if not os.environ.get("JAX_PLATFORMS") and (prefers(settings, members) if callable(prefers) else prefers):
        of_jax: Any = jax.config
        of_jax.update("jax_platforms", "cpu")


def recorded(run: Path) -> tuple[config.Config, dict[str, Any]]:
    """(configuration, origin) of the `run` to continue. Raises InputError if another version of the program made it."""
    from mjxball.train.run_directory import read_config

    settings, origin = read_config(run)
    changed = differences(origin)
    extensions = origin.get("extensions") or {}
    if extensions and _digest(extensions) != origin.get("extension_hash"):
        changed.append(f"{', '.join(extensions.values())} has changed")
    if extensions.get("algorithm"):
        from mjxball.train.extensions import find

        _choose_processor(find(extensions["algorithm"], "--algorithm"), settings, origin["seeds"])
    if changed:
        raise InputError(f"{run} was made by another program and cannot be continued exactly: {'; '.join(changed)}")
    return settings, origin


def refuse_new_run_options(options: argparse.Namespace, why: str, but: tuple[str, ...]) -> None:
    """Raise InputError, which begins with `why`, for options of a new run other than `but`."""
    given = [f"--{name[7:]}" for name, value in vars(options).items() if name.startswith("config:") and value]
    names = ("out", "seed", "num_seeds", "minutes", "sweep", "share", "physics", "plant", "start_from", *EXTENSIONS)
    given += [f"--{name.replace('_', '-')}" for name in names if name not in but and getattr(options, name) is not None]
    given += [options.preset] if options.preset else []
    if given:
        raise InputError(f"{why}; drop {', '.join(given)}")


@functools.cache
def wake_devices() -> None:
    """Start the accelerator's runtime (2 s on a GPU) in a thread, in parallel to the imports that follow.

    The thread is no daemon: if Python stopped it inside XLA, the process would abort.
    """
    import jax  # here: two threads must not both import it

    threading.Thread(target=_first_kernel, args=(jax.numpy,)).start()


def _first_kernel(xp: Any) -> None:
    with contextlib.suppress(RuntimeError, AssertionError):  # no device; the code that needs one reports it
        xp.zeros(1).block_until_ready()
