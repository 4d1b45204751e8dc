"""Walk, change, parse, serialise and hash a configuration."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from mjxball.config._plant import Drone
from mjxball.config._settings import Config
from mjxball.errors import InputError
from mjxball.reading import near, shown

MAX_LISTED = 6
LAST_VERSION = "0.1.0"  # the last of mjxball that reads the names and values of earlier versions
SWITCHES = {"true": True, "false": False, "1": True, "0": False}


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, dataclasses.Field]]:
    """Yield (dotted path, value, field) of every setting, in declaration order; `type` of a field is no text."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        path = f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{path}.")
        elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):  # drones
            for number, record in enumerate(value):
                yield from leaves(record, f"{path}.{number}.")
        elif item.metadata:
            yield path, value, item


def range_of(path: str) -> tuple[float, float]:
    """Lowest and highest number that the setting `path` accepts."""
    item = next(item for known, _, item in leaves(Config()) if known == path)
    return item.metadata["low"], item.metadata["high"]


def to_text(value: Any) -> str:
    """The value of a setting as the command line takes it."""
    if isinstance(value, tuple):
        return ",".join(f"{part:g}" for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def about_section(name: str) -> str:
    """The description of the section `name` of the configuration: the first sentence of its class."""
    text = type(getattr(Config(), name)).__doc__ or ""
    return re.split(r"\.(?=\s+[A-Z`]|\s*$)", text.strip())[0].replace("`", "")


def replace(config: Any, path: str, value: Any) -> Any:
    """A copy of `config` in which the setting at the dotted `path` has `value`, not validated."""
    head, _, rest = path.partition(".")
    if isinstance(config, tuple):
        number = int(head)
        return (*config[:number], replace(config[number], rest, value), *config[number + 1 :])
    if rest:
        value = replace(getattr(config, head), rest, value)
    return dataclasses.replace(config, **{head: value})


def override(config: Config, path: str, text: str) -> Config:
    """A copy of `config` in which the setting at `path` is parsed from `text` (tuples: comma-separated).

    Raises InputError for an unknown path or a text that does not parse to the type of the setting.
    """
    for known, _, item in leaves(config):
        if known == path:
            return replace(config, known, _parse(path, text, item.type))
    raise InputError(f"--{path} is not a setting; run with --help for the list")


def _parse(path: str, text: str, kind: Any) -> Any:
    several, kind = (True, typing.get_args(kind)[0]) if typing.get_origin(kind) is tuple else (False, kind)
    try:
        if kind is bool:
            return SWITCHES[text.lower()]
        if kind not in (int, float):  # a choice
            return text
        return (tuple(map(kind, text.split(","))) if text else ()) if several else kind(text)
    except (ValueError, KeyError):
        wanted = {bool: "true or false", int: "a whole number", float: "a number"}[kind]
        if several:
            wanted = f"comma-separated {'whole ' if kind is int else ''}numbers"
        raise InputError(f"--{path} takes {wanted}, not {shown(text)}") from None


def apply_overrides(config: Config, values: Mapping[str, Any]) -> Config:
    """A copy of `config` in which every setting that `values` names by dotted path is replaced, not validated.

    Raises InputError for an unknown path.
    """
    kinds = _kinds(config)
    for path, value in values.items():
        if path == "plant.drones":
            config = replace(config, path, _drones(value))
            kinds = _kinds(config)
        elif path in kinds:
            config = replace(config, path, _converted(kinds[path], value))
        else:
            raise InputError(f"{path} is not a setting{near(path, kinds)}; `train.py --help all` lists them")
    return config


def _kinds(config: Config) -> dict[str, Any]:
    return {path: item.type for path, _, item in leaves(config)}


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionary of a configuration (tuples become lists in JSON)."""
    return dataclasses.asdict(config)


def from_dict(data: Any, kind: Any = Config, path: str = "", complete: bool = True) -> Any:
    """Rebuild a configuration, or its part `kind` at `path`, from the output of `to_dict` or parsed JSON.

    Raises InputError for unknown names; for missing ones too if it must be `complete`, else they get their defaults.
    Values are not validated.
    """
    if not isinstance(data, dict):
        raise InputError(f"configuration {path or 'root'} must be an object")
    kinds = {item.name: item.type for item in dataclasses.fields(kind)}
    unknown, missing = sorted(set(data) - set(kinds)), sorted(set(kinds) - set(data)) if complete else []
    if unknown or missing:
        where = f" in {path}" if path else ""
        spelt = [f"unknown {str(name)[:60]}{near(str(name)[:60], kinds)}" for name in unknown[:MAX_LISTED]]
        what = ", ".join(spelt + [f"missing {name}" for name in missing][:MAX_LISTED])
        last = f"; mjxball {LAST_VERSION} is the last version that reads settings of earlier ones" if unknown else ""
        raise InputError(f"configuration does not fit this version{where}: {what}{last}")
    return kind(
        **{name: _built(kinds[name], value, f"{path}.{name}".lstrip("."), complete) for name, value in data.items()}
    )


def _built(kind: Any, value: Any, path: str, complete: bool) -> Any:
    if dataclasses.is_dataclass(kind):
        return from_dict(value, kind, path, complete)
    record = next(iter(typing.get_args(kind)), None)
    if not dataclasses.is_dataclass(record):
        return _converted(kind, value)
    if not isinstance(value, (list, tuple)):
        raise InputError(f"configuration {path} must be a list")
    return tuple(from_dict(one, record, f"{path}.{number}", complete) for number, one in enumerate(value))


def _converted(kind: Any, value: Any) -> Any:
    """A value of JSON or TOML as `kind` has it: lists as tuples, whole numbers as floats; other types are kept."""
    if isinstance(value, (list, tuple)):
        return tuple(_converted(next(iter(typing.get_args(kind)), kind), one) for one in value)
    return float(value) if kind is float and type(value) is int else value


def _drones(value: Any) -> tuple[Drone, ...]:
    """The drones of a list of tables; settings that a table leaves out have their defaults."""
    if not isinstance(value, (list, tuple)) or not all(isinstance(one, dict) for one in value):
        raise InputError("plant.drones must be a list of tables, one for each drone")
    return tuple(from_dict(one, Drone, f"plant.drones.{number}", False) for number, one in enumerate(value))


# Settings of earlier versions. `policy.file` refuses policies that were trained with them.
RETIRED = (("follower", "residual_on_pid"), ("leader", "tilt_integral_gain"))


def from_record(data: Any) -> Any:
    """The configuration in the metadata of a policy file or in a flight log, not validated.

    Settings that the version which wrote it did not have get their defaults, which are what that version did. Raises
    InputError for other unknown names than `RETIRED`, or without a plant.
    """
    if isinstance(data, dict):
        if "plant" not in data:
            raise InputError("configuration does not fit this version: missing plant")
        data = dict(data)
        for part, name in RETIRED:
            if isinstance(data.get(part), dict):
                data[part] = {one: value for one, value in data[part].items() if one != name}
    return from_dict(data, complete=False)


def to_json(config: Any) -> str:
    """Canonical JSON text of a configuration, indented, keys sorted."""
    return json.dumps(to_dict(config), indent=2, sort_keys=True)


def config_hash(config: Any) -> str:
    """First 16 hex digits of the SHA-256 of a configuration's canonical JSON; `config` may be its nested dictionary."""
    settings = config if isinstance(config, dict) else to_dict(config)
    compact = json.dumps(settings, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(compact.encode()).hexdigest()[:16]
