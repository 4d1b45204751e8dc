"""Plant files: a rig in TOML or JSON (shipped ones: `plants/*.toml`), or a model in MJCF or URDF."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball.config._model import RotorSite, read_model
from mjxball.config._model_plant import plant_of
from mjxball.config._model_source import MODELS
from mjxball.config._plant import Plant
from mjxball.config._settings import Config
from mjxball.config._tree import apply_overrides, leaves, override, replace
from mjxball.config._validate import MOST_DRONES, ball_limit, cg_limit, check_leaves, validate
from mjxball.errors import InputError
from mjxball.files import MissingFileError, read_text
from mjxball.reading import parse_json, parse_toml

PLANT_PARTS = ("plant", "attitude", "autopilot", "leader", "scenario", "motion")  # what a plant file may set
SHIPPED = Path(__file__).parent / "plants"
PLANTS = tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))  # names that `--plant` takes
DRONES = "plant.drones"
MASSES = (  # proportional to that of the object
    "scenario.object_mass",
    "scenario.unknown_mass",
    "scenario.mass_change",
    "attitude.design_object_mass",
)
MAX_PLANT = 2**16  # bytes of a plant file; reading TOML of thousands of drones takes minutes


class PlantFile(NamedTuple):
    """The settings of a rig."""

    preset: str | None  # the preset for this rig
    settings: dict[str, Any]  # by dotted path; plant.drones is a list of tables
    assumed: tuple[str, ...] = ()  # for a model: a sentence for each value that neither it nor the file beside it gives


def read_plant(source: Path | str) -> PlantFile:
    """The plant file `source` (.toml, .json), the shipped plant of that name, or the model .xml (MJCF) or .urdf.

    A file holds settings as tables `[plant]`, `[attitude]`, ... or as dotted paths; optionally `preset`, the preset for
    this rig, and `base`, a shipped plant whose other settings apply. A file with `[[plant.drones]]` describes a whole
    plant: missing settings have their defaults. Values are not validated.

    A `.toml` file beside a model may add settings that the model lacks; `drones`, the number of drones if the model is
    a single one; and `rotors`, their positions: names of sites or bodies, positions [m] in the axes of the free body,
    or a table of positions by body.

    Raises InputError if `source` is none of these.
    """
    path = Path(source)
    if path.suffix.lower() in MODELS:
        return _of_model(path)
    if str(source) in PLANTS and not path.exists():
        path = SHIPPED / f"{source}.toml"
    values = _parsed(path)
    base = values.pop("base", None)
    if base is not None and base not in PLANTS:
        raise InputError(f"plant file {path}: base must be one of {', '.join(PLANTS)}, not {base!r}")
    found = _settings(path, values)
    if DRONES in found.settings:
        found = found._replace(settings=_defaults() | found.settings)
    if base is None:
        return found
    below = read_plant(SHIPPED / f"{base}.toml")
    return PlantFile(found.preset or below.preset, below.settings | found.settings)


def _of_model(path: Path) -> PlantFile:
    """The plant of the model `path`, with the settings of the file beside it."""
    beside = path.with_suffix(".toml")
    values = _parsed(beside) if beside.exists() else {}
    count, rotors = values.pop("drones", None), values.pop("rotors", [])
    if count is not None and (type(count) is not int or not 2 <= count <= MOST_DRONES):
        raise InputError(f"plant file {beside}: drones must be a whole number from 2 to {MOST_DRONES}, not {count!r}")
    sites = _rotor_sites(beside, rotors)
    given = _settings(beside, values)
    with np.errstate(all="ignore"):  # validation of the settings refuses numbers that are not finite
        model = read_model(path, sites)
        try:
            settings, assumed = plant_of(model, given.settings, count)
        except InputError as error:
            raise InputError(f"model {path}: {error}") from None
    own = {name: value for name, value in given.settings.items() if name != DRONES}
    return PlantFile(given.preset, _defaults() | settings | own, tuple(assumed))


def _rotor_sites(beside: Path, rotors: Any) -> list[RotorSite]:
    """The rotors in the file `beside` a model."""
    rows = {"": rotors} if isinstance(rotors, list) else rotors
    found = []
    for body, entries in rows.items() if isinstance(rows, dict) else [("", None)]:
        for entry in entries if isinstance(entries, list) else [None]:
            if isinstance(entry, str) and not body:
                found.append(RotorSite(entry))
            elif isinstance(entry, list) and len(entry) == 3 and all(type(part) in (int, float) for part in entry):
                found.append(RotorSite(body, (float(entry[0]), float(entry[1]), float(entry[2]))))
            else:
                raise InputError(
                    f"plant file {beside}: rotors must be a list of names or of places [x, y, z] in m, or a table of "
                    f"such places by body, not {rotors!r:.200}"
                )
    return found


def _defaults() -> dict[str, Any]:
    """Default settings of a plant, without its drones."""
    return {f"plant.{name}": value for name, value, _ in leaves(Plant()) if not name.startswith("drones.")}


def _settings(path: Path, values: dict[str, Any]) -> PlantFile:
    """Preset and settings in `values`, the contents of the file `path`."""
    preset = values.pop("preset", None)
    if preset is not None and not isinstance(preset, str):
        raise InputError(f"plant file {path}: preset must be the name of one, not {preset!r}")
    try:
        settings = dict(_flat(values))
    except RecursionError:
        raise InputError(f"plant file {path} has tables that are nested too deeply") from None
    for name in (*settings, *values):  # empty tables are in `values` alone
        if name.partition(".")[0] not in PLANT_PARTS or (name in PLANT_PARTS and name in settings):
            raise InputError(
                f"plant file {path} may set {', '.join(PLANT_PARTS)}, beside a model drones and rotors, not {name}"
            )
    return PlantFile(preset, settings)


def _parsed(path: Path) -> dict[str, Any]:
    kind = "TOML" if path.suffix == ".toml" else "JSON"
    try:
        text = read_text(path, "plant file", MAX_PLANT)
    except MissingFileError as error:
        raise InputError(f"{error}; by name there are {', '.join(PLANTS)}") from None
    try:
        values = parse_toml(text) if kind == "TOML" else parse_json(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"plant file {path} is not {kind}: {error}") from None
    if not isinstance(values, dict) or not values:
        raise InputError(f'plant file {path} must be one {kind} object such as {{"plant.rotor_lag": 0.06}}')
    return values


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted path, value) of nested tables."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def follow_plant(config: Config, before: Plant, said: Collection[str]) -> Config:
    """`config` with a load that fits its plant, which was `before`; settings with paths in `said` are kept.

    Masses scale with `plant.object_mass`; offsets of the CG and of a rolling ball are limited to the object.
    """
    factor = config.plant.object_mass / before.object_mass
    known = {path: value for path, value, _ in leaves(config)}
    for path in MASSES if factor != 1 else ():
        if path not in said:
            value = known[path]
            scaled = tuple(factor * one for one in value) if isinstance(value, tuple) else factor * value
            config = replace(config, path, scaled)
    if config.plant == before:
        return config
    if "scenario.cg_amplitude" not in said:
        low, high = (min(one, cg_limit(config.plant)) for one in config.scenario.cg_amplitude)
        config = replace(config, "scenario.cg_amplitude", (low, high))
    if "scenario.ball_start" not in said:
        config = replace(config, "scenario.ball_start", min(config.scenario.ball_start, ball_limit(config.plant)))
    return config


def _check_inertias(plant: Plant) -> None:
    """Raise InputError for a principal inertia that is larger than the sum of the other two."""
    named = {f"{DRONES}.{number}.inertia": drone.inertia for number, drone in enumerate(plant.drones)}
    for name, inertia in {**named, "plant.carrier_inertia": plant.carrier_inertia}.items():
        if 2 * max(inertia) > sum(inertia) * (1 + 1e-4):
            raise InputError(f"{name} {inertia!r} is that of no body: one number is larger than the sum of the others")


def _called(source: Path) -> str:
    """The name of the plant file or model `source` in error messages."""
    beside = source.with_suffix(".toml")
    if source.suffix.lower() not in MODELS:
        return f"plant file {source}"
    return f"model {source} with {beside.name}" if beside.exists() else f"model {source}"


def with_plant(
    config: Config, source: Path | str | None, flags: Mapping[str, str] | None = None, found: PlantFile | None = None
) -> Config:
    """`config` with the settings of the plant file `source`, then of `flags` (path -> text), validated.

    `found` is the contents of `source` if it was read before. Settings of the load follow the plant unless file or
    flags set them (`follow_plant`). Raises InputError.
    """
    flags = flags or {}
    try:
        settings = {} if source is None else (found or read_plant(source)).settings
        changed = apply_overrides(config, settings)
        for path, text in flags.items():
            changed = override(changed, path, text)
        check_leaves(changed)
        said = {*settings, *flags}
        changed = validate(follow_plant(changed, config.plant, said))
        if DRONES in settings:
            _check_inertias(changed.plant)
        return changed
    except OverflowError:  # a whole number of hundreds of digits
        raise InputError(f"plant file {source} holds a number that is not finite") from None
    except InputError as error:
        text = str(error)
        if source is None or text.startswith(("plant file", "model", "--")):
            raise
        raise InputError(f"{_called(Path(source))}{' with these flags' if flags else ''}: {text}") from None
