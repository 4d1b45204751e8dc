"""Two robots of a Crazyswarm2 file (crazyflies.yaml, fileversion 1 to 3): links, positions, bodies, parameters.

The format follows IMRCLab/crazyswarm2 at f6154e2, crazyflie/config/crazyflies.yaml and docs2/usage.rst. Parameters of a
robot override those of its type, which override those of `all`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.control.crazyflie import PARAMETERS, Gains, PairGains
from mjxball.errors import InputError
from mjxball.files import read_text
from mjxball.reading import is_number
from mjxfly.limits import NAMES
from mjxfly.parameters import is_written
from mjxfly.telemetry import Rig
from mjxfly.uri import check_pair, parse_uri

MAX_FILE_BYTES, MOST_ALIASES = 2**20, 20  # [bytes]; of a file
MERGE = "tag:yaml.org,2002:merge"  # the key <<
VERSIONS = (1, 2, 3)  # of the file
NEAR = 0.1  # [m] tolerance of the initial positions against the mounts


@dataclass(frozen=True)
class Robot:
    """One robot of the file that is enabled and has a connection."""

    name: str
    uri: str
    place: np.ndarray | None  # (3,) initial position [m]
    tracked: bool  # by the motion capture program, as a rigid body of its name
    parameters: Gains
    unused: frozenset[str]  # keys of the file that are ignored


@dataclass(frozen=True)
class CrazyswarmPair:
    """Leader and follower, read from a Crazyswarm2 file."""

    path: Path
    robots: tuple[Robot, Robot]
    chosen: str  # how they were selected, in words

    @property
    def uris(self) -> tuple[str, str]:
        """URIs of leader and follower."""
        return self.robots[0].uri, self.robots[1].uri

    @property
    def parameters(self) -> PairGains:
        """Firmware parameters to be written to leader and follower."""
        return self.robots[0].parameters, self.robots[1].parameters

    @property
    def bodies(self) -> tuple[str, str] | None:
        """Rigid bodies of the motion capture system; None unless it tracks both drones by name."""
        one, other = self.robots
        return (one.name, other.name) if one.tracked and other.tracked else None

    def describe(self, rig: Rig) -> list[str]:
        """Sentences on the roles and on ignored keys. Raises InputError if the initial positions are swapped."""
        leader, follower = self.robots
        found = [f"{self.path.name}: {leader.name} leads, {follower.name} follows, {self.chosen}", *self._places(rig)]
        unused = sorted(leader.unused | follower.unused)
        return [*found, f"{self.path.name}: not used: {', '.join(unused)}"] if unused else found

    def _places(self, rig: Rig) -> list[str]:
        leader, follower = self.robots
        if leader.place is None or follower.place is None:
            return []
        line = leader.place - follower.place
        if np.linalg.norm(line - rig.span) <= NEAR:
            return []
        if np.linalg.norm(line + rig.span) <= NEAR:
            raise InputError(
                f"{self.path}: by their initial_position {follower.name} is the leader, not {leader.name}; "
                f"ask for it with --leader {follower.name} --follower {leader.name}"
            )
        apart, stick = (", ".join(f"{value:g}" for value in one) for one in (line, rig.span))
        text = f"initial_position puts {leader.name} at ({apart}) m from {follower.name}, the stick at ({stick}) m"
        return [f"{self.path.name}: {text}; what the drones measure counts"]


def read_pair(path: Path, leader: str | None = None, follower: str | None = None) -> CrazyswarmPair:
    """The two enabled robots, or those called `leader` and `follower`. Raises InputError."""
    data = _mapping(_parsed(path), f"{path}", needed=True)
    robots = _mapping(data.get("robots"), f"{path}: robots", needed=True)
    types = _mapping(data.get("robot_types"), f"{path}: robot_types", needed=True)
    if odd := [str(name) for name in robots if not (str(name).isprintable() and str(name).strip())]:
        raise InputError(f"{path}: the name {odd[0][:60]!r} of a robot cannot be printed")
    flying = {
        str(name): one
        for name, one in ((name, _mapping(value, f"{path}: robot {name}")) for name, value in robots.items())
        if _enabled(one, f"{path}: robot {name}")
        and _type(one, types, f"{path}: robot {name}").get("connection") != "none"
    }
    version = data.get("fileversion", VERSIONS[-1])
    if type(version) is not int or version not in VERSIONS:
        raise InputError(f"{path}: fileversion {version!r:.60} is none of {', '.join(map(str, VERSIONS))}")
    names, chosen = _choose(path, list(flying), [leader, follower])
    found = [_robot(f"{path}: robot {name}", name, flying[name], types, data) for name in names]
    one, other = (parse_uri(robot.uri, f"{path}: the uri of robot {robot.name},") for robot in found)
    check_pair(one, other, f"{path}: {names[0]} and {names[1]}")
    return CrazyswarmPair(path, (found[0], found[1]), chosen)


def _choose(path: Path, flying: Sequence[str], asked: Sequence[str | None]) -> tuple[list[str], str]:
    listed = ", ".join(flying) or "none"
    if any(name is not None for name in asked):
        for flag, name in zip(NAMES, asked, strict=True):
            if name is None:
                raise InputError(f"--crazyflies takes both --leader NAME and --follower NAME or neither; no --{flag}")
            if name not in flying:
                raise InputError(f"--{flag} {name} is no enabled robot of {path}; enabled: {listed}")
        if asked[0] == asked[1]:
            raise InputError("--leader and --follower are the same drone")
        return [str(name) for name in asked], "as asked"
    if len(flying) < 2:
        raise InputError(f"{path}: {len(flying)} of the 2 robots that fly are enabled: {listed}")
    if len(flying) > 2:
        raise InputError(
            f"{path}: {len(flying)} robots are enabled ({listed}) and 2 fly; disable the others, or name the two with "
            "--leader NAME --follower NAME"
        )
    return list(flying), "in the order of the file"


def _parsed(path: Path) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """Safe YAML without duplicate keys and with a bounded number of aliases."""

        aliases = 0

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = set()
            for key in (self.construct_object(key, deep=True) for key, _ in node.value if key.tag != MERGE):
                if key in keys:
                    where = node.start_mark.line + 1
                    raise ValueError(f"the key {str(key)[:60]!r} stands twice in line {where} and after")
                keys.add(key)
            return super().construct_mapping(node, deep)

        def compose_node(self, parent: Any, index: Any) -> Any:
            self.aliases += self.check_event(yaml.AliasEvent)
            if self.aliases > MOST_ALIASES:  # nested aliases expand exponentially
                raise ValueError(f"it has more than {MOST_ALIASES} aliases, *name")
            return super().compose_node(parent, index)

    text = read_text(path, "Crazyswarm2 file", MAX_FILE_BYTES)
    try:
        return yaml.load(text, Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}: " if mark is not None else ""
        raise InputError(f"Crazyswarm2 file {path} is no YAML: {where}{error.problem}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise InputError(f"Crazyswarm2 file {path} is no YAML: {' '.join(str(error).split())[:200]}") from None


def _mapping(value: Any, where: str, needed: bool = False) -> Mapping[Any, Any]:
    if value is None and not needed:
        return {}
    if not isinstance(value, dict):
        what = "nothing" if value is None else f"a {type(value).__name__}"
        raise InputError(f"{where} must be a mapping, not {what}; see crazyflies.yaml of Crazyswarm2")
    return value


def _enabled(robot: Mapping[Any, Any], where: str) -> bool:
    value = robot.get("enabled")
    if not isinstance(value, bool):
        raise InputError(f"{where}: enabled must be true or false, not {str(value)[:60]}")
    return value


def _type(robot: Mapping[Any, Any], types: Mapping[Any, Any], where: str) -> Mapping[Any, Any]:
    name = robot.get("type")
    if not isinstance(name, str) or name not in types:
        raise InputError(
            f"{where}: type {str(name)[:60]} is not in robot_types, which has {', '.join(map(str, types))}"
        )
    return _mapping(types[name], f"{where}: type {name}")


def _robot(where: str, name: str, robot: Mapping[Any, Any], types: Mapping[Any, Any], data: Mapping[Any, Any]) -> Robot:
    kind, shared = _type(robot, types, where), _mapping(data.get("all"), f"{where}: all")
    if kind.get("big_quad"):
        raise InputError(f"{where}: its type is a big_quad, and policies are for Crazyflies 2.1 and Brushless")
    uri = robot.get("uri")
    if not isinstance(uri, str):
        raise InputError(f"{where} has no uri such as radio://0/80/2M/E7E7E7E7E7")
    wanted: Gains = {}
    for one, source in ((shared, "all"), (kind, "its type"), (robot, "it")):
        wanted |= dict(_parameters(one.get("firmware_params"), f"{where}: firmware_params of {source}"))
    taken = {key: value for key, value in wanted.items() if is_written(key) and key not in PARAMETERS}
    motion = _mapping(kind.get("motion_capture"), f"{where}: motion_capture of its type")
    used = {"enabled", "uri", "initial_position", "type", "firmware_params", "connection", "big_quad", "robots"}
    used |= {"robot_types", "all", "fileversion"}
    unused = {str(key) for one in (data, shared, kind, robot) for key in one if key not in used}
    tracked = motion.get("tracking") == "vendor"
    unused -= {"motion_capture"} if tracked else set()
    unused |= {key for key in wanted if key not in taken}
    return Robot(name, uri, _place(robot.get("initial_position"), where), tracked, taken, frozenset(unused))


def _parameters(groups: Any, where: str) -> Iterator[tuple[str, float]]:
    for group, values in _mapping(groups, where).items():
        for name, value in _mapping(values, f"{where}: {group}").items():
            yield f"{group}.{name}", _number(value, f"{where}: {group}.{name}")


def _place(value: Any, where: str) -> np.ndarray | None:
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f"{where}: initial_position must be three numbers, not {str(value)[:60]}")
    return np.array([_number(one, f"{where}: initial_position") for one in value])


def _number(value: Any, where: str) -> float:
    """A finite float. Strings count too: YAML 1.1 reads 1e-3 as a string, and Crazyswarm2's own file has it."""
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not is_number(number):
        raise InputError(f"{where} must be a finite number, not {str(value)[:60]}")
    return number
