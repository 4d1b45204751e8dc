"""Files of a run directory: configuration, sweep and tables, and the versions and source that made the run.

Readers validate everything: a damaged file raises InputError with one sentence."""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import io
import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.algorithms import ALGORITHMS
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.files import MissingFileError, read_bytes, read_text, write_atomically
from mjxball.physics.step import TRAINING_ENGINES
from mjxball.policy.container import MAX_BYTES
from mjxball.policy.file import PolicyFile, load_file, observing_stale
from mjxball.reading import parse_json
from mjxball.terminal import warn

LONGEST_COUNT = 20  # digits of a number of steps


def read_json(path: Path, called: str) -> Any:
    """The contents of a JSON file; MissingFileError if there is none, InputError if it cannot be read.

    `called` describes the file in the error; with '' the error contains its path alone.
    """
    text = read_text(path, called)
    try:
        return parse_json(text)
    except (ValueError, RecursionError) as error:
        raise _refusal(path, called, error) from None


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a header. Rows with too few or too many values are left out.

    MissingFileError if there is no such file, InputError if it cannot be read or has a column twice.
    """
    lines = read_text(path).splitlines()
    try:
        reader = csv.DictReader(lines)
        rows, names = list(reader), list(reader.fieldnames or ())
    except csv.Error as error:
        raise _refusal(path, "", error) from None
    if len(set(names)) < len(names):
        raise _refusal(path, "", "a column stands twice in its header")
    return [row for row in rows if None not in row and None not in row.values()]


def read_metrics(path: Path) -> list[dict[str, str]]:
    """The rows of `metrics.csv` with increasing steps; a warning on stderr counts the others. Errors as `read_rows`.

    A row whose steps do not increase comes from another process, or from a run that was interrupted.
    """
    rows = read_rows(path)
    kept: list[dict[str, str]] = []
    for row in rows:
        steps = row.get("steps", "")
        if steps.isdecimal() and len(steps) < LONGEST_COUNT and (not kept or int(steps) > int(kept[-1]["steps"])):
            kept.append(row)
    if len(kept) < len(rows):
        left = f"{len(rows) - len(kept)} of {len(rows)} rows do not follow the one before"
        warn(f"warning: {path}: {left} in steps and are left out")
    return kept


def write_rows(path: Path, names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file with the header `names`."""
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, names)
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, stream.getvalue())


def _refusal(path: Path, called: str, why: object) -> InputError:
    words = " ".join(str(why).split())[:200]
    return InputError(f"{called}{' ' if called else ''}{path} cannot be read: {words}")


# Names in a run directory.
CONFIG_FILE, METRICS, POLICY, CHECKPOINTS = "config.json", "metrics.csv", "policy.npz", "checkpoints"
EXTENSIONS = ("env", "reward", "algorithm")  # flags that name the user's code, see `mjxball.train.extensions`
MOST_MEMBERS = 4096
MAX_SEED = 2**31 - 1
ORIGIN = ("seed", "physics", "seeds", "sweep")  # required keys of config.json besides the configuration


def _is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def start_policy(start: dict[str, str], config: Config) -> PolicyFile:
    """The policy file `start["policy"]`; InputError unless it has `start["sha256"]` and the follower of `config`.

    Its network may have fewer units in each layer.
    """
    path = Path(start["policy"])
    contents = load_file(path)
    if file_hash(path) != start["sha256"]:
        raise InputError(f"{path} is not the policy that the run was to start from: its SHA-256 has changed")
    needed = parse_json(json.dumps(configs.to_dict(config)["follower"]))
    trained = contents.metadata.get("config", {}).get("follower", {})
    if config.follower.stale:
        contents = observing_stale(contents)
    trained = {**trained, "stale": contents.metadata.get("stale", False)}  # older configurations do not say it
    trained["privileged_critic"] = needed["privileged_critic"]  # does not matter: critics are not in a policy file
    if 0 < trained.get("recurrent_units", 0) < needed["recurrent_units"]:
        trained["recurrent_units"] = needed["recurrent_units"]
    changed = [f"follower.{name}" for name in needed if needed[name] != trained.get(name)]
    if changed:
        raise InputError(f"{path} was trained with other settings than the run's: {', '.join(changed)}")
    sizes, own = [len(bias) for bias in contents.biases[:-1]], config.gradient.policy_layers
    if len(sizes) != len(own) or any(size > most for size, most in zip(sizes, own, strict=True)):
        layers = ",".join(map(str, sizes))
        raise InputError(f"{path} has hidden layers {layers}; say --gradient.policy_layers {layers}, or more units")
    return contents


def starts_of(origin: Mapping[str, Any]) -> list[dict[str, str]]:
    """Arguments of `start_policy` for a run with this `origin`: one for all members, one for each, or none."""
    start = origin.get("start_from") or []
    return start if isinstance(start, list) else [start]


def members_of(run: Path) -> list[Path]:
    """Policy files of all members of a population, sorted by seed; InputError if there are none."""
    found = [(int(path.stem[4:]), path) for path in (run / "members").glob("seed*.npz") if path.stem[4:].isdecimal()]
    if not found:
        raise InputError(f"{run} holds no population: train.py --num-seeds writes members/seed*.npz")
    return [path for _, path in sorted(found)]


def file_hash(path: Path) -> str:
    """SHA-256 of a policy file."""
    return hashlib.sha256(read_bytes(path, "policy file", MAX_BYTES)).hexdigest()


def write_config(run: Path, config: Config, origin: dict[str, Any]) -> None:
    """Write the run's `config.json`: configuration, its hash, and `origin` (seed, physics, command, commit)."""
    record = {"config": configs.to_dict(config), "config_hash": configs.config_hash(config), **origin}
    write_atomically(run / CONFIG_FILE, json.dumps(record, indent=2) + "\n")


def read_config(run: Path) -> tuple[Config, dict[str, Any]]:
    """(configuration, origin) of a run directory. Raises InputError unless config.json is complete and unchanged."""
    path = run / CONFIG_FILE
    try:
        record = read_json(path, "")
    except MissingFileError:
        raise InputError(f"{run} is not a run directory: it has no {CONFIG_FILE}") from None
    if not isinstance(record, dict) or "config" not in record:
        raise InputError(f"{path} holds no configuration")
    settings = record.pop("config")
    try:
        config = configs.from_dict(settings)
    except (TypeError, OverflowError) as error:  # a value of a wrong type, or a number too large for a float
        raise InputError(f"{path} holds no configuration: {error}") from None
    lost = [name for name in ORIGIN if name not in record]
    if lost:
        raise InputError(f"{path} lacks {', '.join(lost)}")
    sound = _is_whole(record["seed"], 0, MAX_SEED) and _is_whole(record["seeds"], 1, MOST_MEMBERS)
    if not sound or record["physics"] not in TRAINING_ENGINES:
        raise InputError(f"{path} has no sound seed, seeds or physics")
    minutes = record.get("minutes")
    if minutes is not None and not (isinstance(minutes, int | float) and 0 < minutes < math.inf):
        raise InputError(f"{path} has no sound minutes")
    if record["sweep"] is not None:
        record["sweep"] = check_sweep(record["sweep"], record["seeds"], configs.validate(config), str(path))
    if record.pop("config_hash", None) != configs.config_hash(settings):
        raise InputError(f"the configuration in {path} was changed after the run began; restore it, or start a new run")
    return configs.validate(config), record


PACKAGE = Path(__file__).parents[1]
# Source that a training result depends on, without evaluation and flight.
SOURCES = (
    "config",
    "assembly.py",
    "env.py",
    "rewards.py",
    "scalar_form.py",
    "control",
    "plant",
    "physics",
    "sim",
    "algorithms",
    "train",
    "xla.py",
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

    The variable `MJXBALL_COMMIT` takes precedence, for containers and copied trees.
    """
    if given := os.environ.get("MJXBALL_COMMIT"):
        return given
    command = ["git", "-C", str(PACKAGE), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def differences(recorded: Mapping[str, Any]) -> list[str]:
    """Differences, one phrase each, between this program and the one that made a run with the origin `recorded`."""
    found = []
    if recorded.get("source_hash") != source_hash():
        found.append(f"source {recorded.get('source_hash')} (commit {recorded.get('commit')}) is now {source_hash()}")
    old = recorded.get("versions") or {}
    for name, version in versions().items():
        if old.get(name) != version:
            found.append(f"{name} {old.get(name)} is now {version}")
    return found


# Settings that can be traced: real-valued ones of algorithms and reward, and the follower's action scales.
SWEEPABLE = (
    *(
        path
        for path, value, _ in configs.leaves(Config())
        if isinstance(value, float) and path.startswith(("reward.", *(f"{name}." for name in ALGORITHMS)))
    ),
    "follower.action_scale_tilt",
    "follower.action_scale_vertical",
)
Sweep = Mapping[str, Sequence[float]]


def read_sweep(path: Path, members: int, config: Config) -> dict[str, list[float]]:
    """A sweep file: JSON {"<config path>": [one number for each member], ...}. Raises InputError if invalid."""
    return check_sweep(read_json(path, "sweep file"), members, config, f"sweep file {path}")


def check_sweep(sweep: Any, members: int, config: Config, where: str) -> dict[str, list[float]]:
    """`sweep`, unchanged. Raises InputError, which begins with `where`, unless it is valid for so many `members`."""
    if not isinstance(sweep, dict) or not sweep:
        raise InputError(f"{where} must hold an object of settings")
    for name, values in sweep.items():
        if name not in SWEEPABLE:
            raise InputError(f"{where}: {name!r} cannot differ between members; {', '.join(SWEEPABLE)} can")
        if not isinstance(values, list) or len(values) != members:
            raise InputError(f"{where}: {name} needs {members} numbers, one for each seed")
        for value in values:
            whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
            configs.validate(configs.replace(config, name, float(value) if whole else value))
    return sweep
