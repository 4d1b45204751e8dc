"""Policy files for an evaluation: fit to a plant, bounds of their metadata, native plants."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics
from mjxball.policy import Policy
from mjxball.policy.file import interface_of
from mjxball.sim.outside import outside
from mjxball.terminal import warn


def load_policy(path: Path, config: Config, compare_controllers: bool = True, seconds: float = 0.0) -> Policy:
    """Load a policy and refuse one that was made for another plant or rate, or for other controllers.

    Warns on stderr where a flight of `seconds` [s] goes beyond what its metadata says it was flown for.
    """
    policy = _fitting(path, config, compare_controllers)
    for text in beyond_training(policy.metadata, config.plant.count, seconds):
        warn(f"warning: {path} {text}")
    return policy


def beyond_training(metadata: dict[str, Any], drones: int, seconds: float) -> list[str]:
    """Ways in which a flight of `seconds` [s] with so many `drones` goes beyond `metadata`, one phrase each."""
    flown = metadata.get("flown")
    if flown is None:
        return []
    sizes, longest = sorted(flown["drones"]), flown["seconds"]
    found = []
    if drones not in sizes:
        found.append(f"is good for teams of {', '.join(map(str, sizes))} drones by its metadata, and here are {drones}")
    if seconds > longest:
        found.append(f"is good for {longest:g} s by its metadata, and this flight lasts {seconds:g} s")
    return found


def _fitting(path: Path, config: Config, compare_controllers: bool) -> Policy:
    policy = Policy.load(path)
    policy.join(config.plant)
    period = config.timing.control_period
    if abs(policy.control_period - period) > 1e-9:
        raise InputError(f"{path} was made for a control period of {policy.control_period:g} s, not {period:g} s")
    made_for = _from_metadata(path, {"plant": policy.metadata["plant"]}).plant
    if flies_any_rig(policy):
        if config.plant.stand != "free":
            raise InputError(f"{path} was made for free flight, not for a stand")
        if config.plant.cg_axis == "y":
            raise InputError(
                f"{path} sees and commands along its mount, which plant.cg_axis xy does for a pair along y"
            )
        for text in outside(config, trained_rigs(policy)):
            warn(f"warning: {path} was not trained for this rig: {text}")
        return policy
    if sizes := team_sizes(policy):
        _refuse_other_teams(path, sizes, config)
        return policy
    if made_for.count != config.plant.count:
        raise InputError(f"{path} was made for a plant of {made_for.count} drones, not {config.plant.count}")
    pairs = zip(configs.leaves(made_for), configs.leaves(config.plant), strict=True)
    for (key, found, _), (_, value, _) in pairs:
        if key != "object_mass" and found != value:
            raise InputError(f"{path} was made for another plant: {key} is {found!r}, not {value!r}")
    if compare_controllers:
        _refuse_other_controllers(path, policy.metadata, config)
    return policy


def _from_metadata(name: Path | str, record: dict[str, Any]) -> Config:
    """The configuration in the metadata of the policy `name`; InputError, which names the policy, if it is none."""
    try:
        return configs.from_record(record)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def flies_any_rig(policy: Policy) -> bool:
    """Whether `policy` flies any rig, of which it knows where the drones are mounted alone."""
    return interface_of(policy.metadata).geometry and trained_rigs(policy).rigs.number > 0


def trained_rigs(policy: Policy) -> Config:
    """The configuration that a policy for any rig was trained with; the preset's where its metadata has none."""
    settings = policy.metadata.get("config")
    return _from_metadata(policy.name, settings) if isinstance(settings, dict) else configs.preset("universal")


def team_sizes(policy: Policy) -> tuple[int, ...]:
    """Numbers of drones of the teams that `policy` was trained in; () if it was made for one plant."""
    return _from_metadata(policy.name, {"plant": {}, **policy.metadata.get("config", {})}).scenario.team_sizes


def _refuse_other_teams(path: Path, sizes: tuple[int, ...], config: Config) -> None:
    """Refuse a plant that is none of the teams that a policy for several sizes was made for."""
    plant, low, high = config.plant, min(sizes), max(sizes)
    if not low <= plant.count <= high:
        raise InputError(f"{path} was made for teams of {low} to {high} drones, not {plant.count}")
    if len(plant.directions) == 1 or config.autopilot.kind != "ideal":
        raise InputError(f"{path} was made for ideal drones that carry a load which moves in the plane")


def _refuse_other_controllers(path: Path, metadata: dict[str, Any], config: Config) -> None:
    """Refuse a policy whose leader or attitude loop was another than the one that it would fly with."""
    if "config" not in metadata:
        return
    trained = _from_metadata(path, {"plant": {}, **metadata["config"]})
    for section in ("leader", "attitude"):
        for key, made_for in dataclasses.asdict(getattr(trained, section)).items():
            if made_for != (value := getattr(getattr(config, section), key)):
                raise InputError(f"{path} was trained with {section}.{key} {made_for!r}, not {value!r}")


def check_bounds(policy: Policy, metrics: Metrics) -> list[str]:
    """Bounds in the metadata that a policy misses on the reference scenario, one phrase each."""
    misses = ["the flight failed"] if metrics.failed else []
    for name, bound in sorted(policy.metadata["bounds"].items()):
        value = getattr(metrics, name, None)
        if value is None or value > bound:
            misses.append(f"{name} {'never' if value is None else f'{value:.4g}'} > {bound:g}")
    return misses


def native_config(path: Path) -> Config | None:
    """The configuration in the metadata if the plant is not the paper's (Crazyflies, a team, a rig), else None."""
    settings = Policy.load(path).metadata.get("config")
    if not isinstance(settings, dict):
        return None
    found = configs.validate(_from_metadata(path, settings))
    paper = found.autopilot.kind == "ideal" and found.plant == configs.preset("paper").plant
    return None if paper else found


def group_by_plant(paths: list[Path]) -> tuple[list[Path], list[tuple[Config, list[Path]]]]:
    """(policies for the paper's plant, [(native configuration, its policies)] of the others)."""
    paper: list[Path] = []
    others: list[tuple[Config, list[Path]]] = []
    for path in paths:
        native = native_config(path)
        if native is None:
            paper.append(path)
            continue
        known = next((group for config, group in others if config == native), None)
        if known is None:
            others.append((native, [path]))
        else:
            known.append(path)
    return paper, others
