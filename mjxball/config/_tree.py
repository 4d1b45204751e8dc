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
LAST_VERSION = "0.1.0"  # of mjxball that reads settings under the names and values of before


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, dataclasses.Field]]:
    """Yield (dotted path, value, field) of every leaf of a configuration, in declaration order."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        path = f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{path}.")
        elif _are_records(value):
            for number, record in enumerate(value):
                yield from leaves(record, f"{path}.{number}.")
        elif item.metadata:
            yield path, value, item


def range_of(path: str) -> tuple[float, float]:
    """Both ends of the range in which the numbers of the setting `path` must lie."""
    item = next(item for known, _, item in leaves(Config()) if known == path)
    return item.metadata["low"], item.metadata["high"]


def to_text(value: Any) -> str:
    """The value of a leaf as the command line takes it."""
    if isinstance(value, tuple):
        return ",".join(f"{part:g}" for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def about_section(name: str) -> str:
    """What the section `name` of the configuration is: the first sentence of its class."""
    text = type(getattr(Config(), name)).__doc__ or ""
    return re.split(r"\.(?=\s+[A-Z`]|\s*$)", text.strip())[0].replace("`", "")


def replace(config: Any, path: str, value: Any) -> Any:
    """Return a copy of `config` with the leaf at the dotted `path` replaced, unchecked."""
    head, _, rest = path.partition(".")
    if isinstance(config, tuple):
        number = int(head)
        return (*config[:number], replace(config[number], rest, value), *config[number + 1 :])
    if rest:
        value = replace(getattr(config, head), rest, value)
    return dataclasses.replace(config, **{head: value})


def _are_records(value: Any) -> bool:
    """Whether `value` is a tuple of dataclasses, such as the plant's drones."""
    return isinstance(value, tuple) and bool(value) and dataclasses.is_dataclass(value[0])


def override(config: Config, path: str, text: str) -> Config:
    """Return a copy of `config` with the leaf at `path` parsed from `text` (tuples: comma-separated).

    Raises InputError for an unknown path or a text that does not parse to the leaf's type.
    """
    for known, value, item in leaves(config):
        if known == path:
            whole = "int" in str(item.type)
            return replace(config, known, _parse(path, text, value, int if whole else float))
    raise InputError(f"--{path} is not a setting; run with --help for the list")


def apply_overrides(config: Config, values: Mapping[str, Any]) -> Config:
    """Return a copy of `config` with the leaf at every dotted path of `values` replaced; not validated.

    Raises InputError for an unknown path.
    """
    known = {path: value for path, value, _ in leaves(config)}
    for path, value in values.items():
        if path == "plant.drones":
            config = replace(config, path, _drones(value))
            known = {path: value for path, value, _ in leaves(config)}
            continue
        if path not in known:
            raise InputError(f"{path} is not a setting{near(path, known)}; `train.py --help all` lists them")
        if isinstance(value, list):
            whole = all(type(one) is int for one in value) and _holds_floats(known[path])
            value = tuple(map(float, value) if whole else value)  # noqa: PLW2901
        if isinstance(known[path], float) and type(value) is int:
            value = float(value)  # noqa: PLW2901
        config = replace(config, path, value)
    return config


def _parse(path: str, text: str, example: Any, kind: type) -> Any:
    """`text` as a value like `example`, of a tuple's parts as `kind`."""
    try:
        if isinstance(example, bool):
            return {"true": True, "false": False, "1": True, "0": False}[text.lower()]
        if isinstance(example, tuple):
            kind = type(example[0]) if example else kind
            return tuple(kind(part) for part in text.split(",")) if text else ()
        return type(example)(text)
    except (ValueError, KeyError):
        several = f"comma-separated {'whole ' if kind is int else ''}numbers"
        wanted = {bool: "true or false", int: "a whole number", float: "a number", tuple: several}
        raise InputError(f"--{path} takes {wanted[type(example)]}, not {shown(text)}") from None


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionary of a configuration (tuples become lists in JSON)."""
    return dataclasses.asdict(config)


def from_dict(data: Any, kind: type = Config, path: str = "") -> Any:
    """Rebuild a configuration from `to_dict`'s output or parsed JSON. Raises InputError on any mismatch."""
    if not isinstance(data, dict):
        raise InputError(f"configuration {path or 'root'} must be an object")
    hints = typing.get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]
    unknown = sorted(set(data) - set(names))
    missing = sorted(set(names) - set(data))
    if unknown or missing:
        where = f" in {path}" if path else ""
        spelt = [f"unknown {str(name)[:60]}{near(str(name)[:60], names)}" for name in unknown[:MAX_LISTED]]
        what = ", ".join(spelt + [f"missing {name}" for name in missing][:MAX_LISTED])
        last = f"; mjxball {LAST_VERSION} is the last version that reads settings of earlier ones" if unknown else ""
        raise InputError(f"configuration does not fit this version{where}: {what}{last}")
    values = {}
    for name in names:
        value = data[name]
        where, record = f"{path}.{name}".lstrip("."), _record_type(hints[name])
        if dataclasses.is_dataclass(hints[name]):
            value = from_dict(value, hints[name], where)
        elif record is not None:
            if not isinstance(value, (list, tuple)):
                raise InputError(f"configuration {where} must be a list")
            value = tuple(from_dict(one, record, f"{where}.{number}") for number, one in enumerate(value))
        elif isinstance(value, list):
            value = tuple(map(float, value)) if _is_float_tuple(hints[name], value) else tuple(value)
        elif hints[name] is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        values[name] = value
    return kind(**values)


def _holds_floats(value: Any) -> bool:
    return isinstance(value, tuple) and any(isinstance(one, float) for one in value)


def _drones(value: Any) -> tuple[Drone, ...]:
    """The drones of a list of tables; what a table leaves out has its default."""
    if not isinstance(value, (list, tuple)) or not all(isinstance(one, dict) for one in value):
        raise InputError("plant.drones must be a list of tables, one for each drone")
    return tuple(
        from_dict(_completed(one, to_dict(Drone())), Drone, f"plant.drones.{number}")
        for number, one in enumerate(value)
    )


def _record_type(hint: Any) -> Any:
    """The dataclass of which `hint` allows a tuple of any length; None for any other hint."""
    kinds = typing.get_args(hint)
    return kinds[0] if kinds[1:] == (Ellipsis,) and dataclasses.is_dataclass(kinds[0]) else None


def from_record(data: Any) -> Any:
    """The configuration that a policy's card or a log holds; what an older version did not know yet has its default.

    Defaults of new settings are what earlier versions did. Raises InputError on any other mismatch or without a plant.
    """
    if isinstance(data, dict) and "plant" not in data:
        raise InputError("configuration does not fit this version: missing plant")
    return from_dict(_completed(data, to_dict(Config())))


def _completed(data: Any, default: Any) -> Any:
    if isinstance(data, (list, tuple)) and isinstance(default, tuple) and default and isinstance(default[0], dict):
        return [_completed(one, to_dict(Drone())) for one in data]
    if not isinstance(data, dict) or not isinstance(default, dict):
        return data
    return {**data, **{name: _completed(data.get(name, value), value) for name, value in default.items()}}


def _is_float_tuple(hint: Any, value: list[Any]) -> bool:
    plain = all(isinstance(number, (int, float)) and not isinstance(number, bool) for number in value)
    return plain and typing.get_args(hint)[:1] == (float,)


def to_json(config: Any) -> str:
    """Canonical JSON text of a configuration, indented, keys sorted."""
    return json.dumps(to_dict(config), indent=2, sort_keys=True)


def config_hash(config: Any) -> str:
    """First 16 hex digits of the SHA-256 of a configuration's canonical JSON; `config` may be its nested dictionary."""
    settings = config if isinstance(config, dict) else to_dict(config)
    compact = json.dumps(settings, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(compact.encode()).hexdigest()[:16]
