"""Typed, frozen configuration: one source for defaults, validation, JSON, hashes and the command line.

Every leaf is declared with `setting`, which carries its help text and its bounds. SI units throughout.
Importing this module needs the standard library only.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

from mjxball.errors import InputError

Vector3 = tuple[float, float, float]
Range = tuple[float, float]
LARGEST = 1e12  # of any number in a configuration
MAX_LISTED = 6


def setting(
    default: Any,
    about: str,
    *,
    above: float | None = None,
    low: float | None = None,
    high: float | None = None,
    ordered: bool = False,
) -> Any:
    """Declare a leaf: default, help text, and bounds that hold for each of its numbers.

    `above` is exclusive, `low` and `high` are inclusive, `ordered` asks for low <= high in a range.
    """
    bounds = {"about": about, "above": above, "low": low, "high": high, "ordered": ordered}
    return field(default=default, metadata=bounds)


@dataclass(frozen=True)
class Plant:
    """The rigid assembly: two drones, one object. Defaults are the `paper` plant (design section 3)."""

    leader_mass: float = setting(1.0, "mass of the leader [kg]", above=0)
    follower_mass: float = setting(1.0, "mass of the follower [kg]", above=0)
    object_mass: float = setting(0.2, "nominal mass of the object, all of it moving with the CG [kg]", above=0)
    leader_inertia: Vector3 = setting(
        (2.3e-3, 2.3e-3, 4.0e-3), "principal inertia of the leader about its centre [kg m2]", above=0
    )
    follower_inertia: Vector3 = setting(
        (2.3e-3, 2.3e-3, 4.0e-3), "principal inertia of the follower about its centre [kg m2]", above=0
    )
    object_size: Vector3 = setting((0.34, 0.10, 0.05), "edges of the object, a uniform box about O [m]", above=0)
    moving_fraction: float = setting(
        1.0,
        "share of the object's mass that moves, m_b / m_o; the rest is a fixed shell, a box about O",
        above=0,
        high=1,
    )
    ball_radius: float = setting(0.02, "radius of the moving ball [m]", above=0)
    cg_axis: Literal["x", "y"] = setting("x", "body axis along which the CG moves and the drones are mounted")
    stand: Literal["free", "pivot", "heave"] = setting(
        "free", "free flight; pivot: O fixed, only roll free; heave: roll and height free"
    )
    leader_mount: Vector3 = setting((0.17, 0.0, 0.0), "centre of the leader from O, body axes [m]")
    follower_mount: Vector3 = setting((-0.17, 0.0, 0.0), "centre of the follower from O, body axes [m]")
    arm: float = setting(0.12, "centre of a drone to each rotor, plus layout [m]", above=0)
    rotor_force_max: float = setting(5.5, "largest force of one rotor [N]", above=0)
    rotor_lag: float = setting(0.03, "time constant of a rotor's force [s]", above=0)
    yaw_per_thrust: float = setting(0.02, "yaw moment of a rotor over its force [m]", above=0)
    gravity: float = setting(9.81, "gravitational acceleration [m/s2]", above=0)


@dataclass(frozen=True)
class Motion:
    """How the centre of gravity moves along `plant.cg_axis`."""

    kind: Literal["sine", "waveform", "rolling"] = setting(
        "sine", "sine: drawn or given per flight; waveform: the samples below; rolling: a free ball with end stops"
    )
    times: tuple[float, ...] = setting((), "waveform: increasing sample times [s]")
    offsets: tuple[float, ...] = setting(
        (), "waveform: CG offsets at those times, a C2 spline between, held outside [m]"
    )
    rolling_friction: float = setting(0.005, "rolling: friction over the normal force", low=0, high=1)
    stop_frequency: float = setting(60.0, "rolling: natural frequency of the ball against an end stop [rad/s]", above=0)
    stop_damping: float = setting(0.4, "rolling: damping ratio of an end stop, 1 does not bounce", low=0, high=2)


@dataclass(frozen=True)
class Attitude:
    """The PD attitude loop that each drone runs once per physics step (design section 3, ours)."""

    natural_frequency: Vector3 = setting(
        (10.0, 10.0, 4.0), "closed-loop roll, pitch, yaw natural frequency [rad/s]", above=0
    )
    damping: float = setting(0.9, "damping ratio", above=0)
    design_object_mass: float = setting(
        0.2, "object mass that the gains are computed for, with the CG at O [kg]", low=0
    )


@dataclass(frozen=True)
class Leader:
    """The leader's PID law (paper eq. 5) and its command limits."""

    kp: Vector3 = setting((0.5, 0.5, 0.5), "proportional gain per axis [1/s2]", low=0)
    kd: Vector3 = setting((1.0, 1.0, 1.0), "derivative gain per axis [1/s]", low=0)
    ki: Vector3 = setting((0.0, 0.0, 0.0), "integral gain per axis [1/s3]", low=0)
    tilt_limit: float = setting(0.6, "largest commanded roll or pitch [rad]", above=0, high=1.2)
    vertical_limit: float = setting(6.0, "largest commanded vertical acceleration [m/s2]", above=0)


@dataclass(frozen=True)
class Follower:
    """What the follower sees and what it commands."""

    action: Literal["residual", "direct"] = setting(
        "residual", "residual: added to the PD law on its own observation; direct: the command itself"
    )
    tilt_limit: float = setting(0.2, "reach of the network's roll and pitch action [rad]", above=0, high=1.2)
    vertical_limit: float = setting(2.0, "reach of the network's vertical action [m/s2]", above=0)
    history: int = setting(1, "observations that the network sees, the newest included", low=1, high=100)
    ignore_position: bool = setting(
        True, "the network's input omits the absolute position: the dynamics do not depend on it"
    )
    previous_action: bool = setting(False, "the network also sees its last action, scaled to [-1, 1]")


@dataclass(frozen=True)
class Timing:
    """Clock rates."""

    control_period: float = setting(0.02, "time between two commands [s]", above=0)
    physics_steps: int = setting(4, "physics and attitude-loop steps in a control period", low=1)
    episode_steps: int = setting(1000, "control steps of a training episode, then truncated", low=1)


@dataclass(frozen=True)
class Scenario:
    """What every reset draws anew, uniformly from each range."""

    goal_reach: float = setting(1.0, "each coordinate of the goal is drawn from +- this [m]", low=0)
    start_position: float = setting(0.0, "each coordinate of the start is drawn from +- this [m]", low=0)
    start_velocity: float = setting(0.0, "each start velocity is drawn from +- this [m/s]", low=0)
    start_tilt: float = setting(0.0, "start roll and pitch are drawn from +- this [rad]", low=0, high=1.0)
    cg_speed: Range = setting((0.31, 0.31), "angular speed of the CG's sine [rad/s]", low=0, ordered=True)
    cg_amplitude: Range = setting((0.05, 0.05), "amplitude of the CG's sine [m]", low=0, ordered=True)
    object_mass: Range = setting((0.2, 0.2), "true mass of the object [kg]", above=0, ordered=True)
    mass_change: Range = setting(
        (0.0, 0.0), "mass added to (dropped from, if negative) the object in flight [kg]", ordered=True
    )
    mass_change_time: Range = setting((5.0, 15.0), "when the object's mass changes [s]", low=0, ordered=True)
    ball_start: float = setting(0.0, "rolling: the ball starts within +- this from O [m]", low=0)
    mass_known: bool = setting(True, "hover thrust uses the true object mass, else the plant's nominal one")
    termination_distance: float = setting(2.5, "an episode ends when |e_o| exceeds this, d_term [m]", above=0)


@dataclass(frozen=True)
class Reward:
    """Reward of one control step. `paper` mimics the leader; `task` (ours) scores what the user wants."""

    kind: Literal["paper", "task"] = setting("task", "paper (leader mimicry) or task (balance)")
    error: float = setting(1.0, "weight of |e_o| over error_scale, saturating [1]", low=0)
    error_scale: float = setting(0.1, "|e_o| at which the error's cost turns from square to linear [m]", above=0)
    velocity: float = setting(0.1, "weight of |de_o/dt|^2 [s2/m2]", low=0)
    tilt: float = setting(0.0, "weight of roll^2 + pitch^2 [1/rad2]", low=0)
    rates: float = setting(0.05, "weight of the squared body rates [s2/rad2]", low=0)
    effort: float = setting(0.02, "weight of the squared network action in [-1, 1]", low=0)
    smoothness: float = setting(0.02, "weight of the squared change of the network action", low=0)
    termination: float = setting(50.0, "cost of leaving termination_distance, once", low=0)


@dataclass(frozen=True)
class Sac:
    """Soft actor-critic and the loop around it."""

    steps: int = setting(1_000_000, "environment steps in all", low=1)
    worlds: int = setting(128, "worlds that are stepped at once", low=1)
    batch: int = setting(256, "transitions in an update", low=1)
    updates: int = setting(4, "gradient updates after each step of all worlds", low=1)
    prefill: int = setting(12_800, "environment steps with random actions before the first update", low=0)
    replay: int = setting(1_024_000, "transitions kept, a multiple of worlds", low=1)
    policy_layers: tuple[int, ...] = setting((64, 64), "hidden layers of the policy", low=1)
    critic_layers: tuple[int, ...] = setting((64, 64), "hidden layers of each critic", low=1)
    critic_layer_norm: bool = setting(False, "LayerNorm in the critics")
    learning_rate: float = setting(1e-3, "Adam's rate for policy and critics", above=0)
    alpha_learning_rate: float = setting(1e-3, "Adam's rate for the temperature's logarithm", above=0)
    discount: float = setting(0.99, "gamma", low=0, high=0.99999)
    return_steps: int = setting(1, "rewards summed before bootstrapping (n-step returns)", low=1, high=50)
    policy_delay: int = setting(1, "critic updates for each update of policy and temperature", low=1, high=1000)
    gradient_clip: float = setting(0.0, "largest global norm of a gradient, 0: not clipped", low=0)
    target_rate: float = setting(0.02, "tau of the target critics", above=0, high=1)
    alpha: float = setting(0.02, "temperature at the start", above=0)
    alpha_fixed: bool = setting(False, "keep the temperature at its start")
    target_entropy: float = setting(-0.5, "wanted entropy for each action dimension [nat]")
    reward_scale: float = setting(1.0, "factor on the reward inside the critic", above=0)
    policy_average: float = setting(
        0.002, "rate of the running average of the policy that is exported", above=0, high=1
    )
    learning_rate_end: float = setting(0.1, "rate at the end of the run over the rate at its start", above=0, high=1)


@dataclass(frozen=True)
class Bounds:
    """What `eval.py --check` enforces for the exported policy on the reference scenario."""

    x_peak: float = setting(0.05, "largest |e_x| after 20 s [m]", above=0)
    settling_time: float = setting(4.0, "2 % settling time [s]", above=0)
    rmse: float = setting(0.36, "root mean square of |e_o| over 20 s [m]", above=0)


@dataclass(frozen=True)
class Config:
    """Everything that determines a run, its seed aside."""

    preset: str = "paper"
    plant: Plant = Plant()
    motion: Motion = Motion()
    attitude: Attitude = Attitude()
    leader: Leader = Leader()
    follower: Follower = Follower()
    timing: Timing = Timing()
    scenario: Scenario = Scenario()
    reward: Reward = Reward()
    sac: Sac = Sac()
    bounds: Bounds = Bounds()

    @property
    def physics_step(self) -> float:
        """Time of one physics step [s]."""
        return self.timing.control_period / self.timing.physics_steps


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, dataclasses.Field]]:
    """Yield (dotted path, value, field) of every leaf of a configuration, in declaration order."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        path = f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{path}.")
        elif item.metadata:
            yield path, value, item


def replace(config: Any, path: str, value: Any) -> Any:
    """Return a copy of `config` with the leaf at the dotted `path` replaced, unchecked."""
    head, _, rest = path.partition(".")
    if rest:
        value = replace(getattr(config, head), rest, value)
    return dataclasses.replace(config, **{head: value})


def override(config: Config, path: str, text: str) -> Config:
    """Return a copy of `config` with the leaf at `path` parsed from `text` (tuples: comma-separated).

    Raises InputError for an unknown path or a text that does not parse to the leaf's type.
    """
    for known, value, _ in leaves(config):
        if known == path:
            return replace(config, path, _parse(path, text, value))
    raise InputError(f"--{path} is not a setting; run with --help for the list")


def _parse(path: str, text: str, example: Any) -> Any:
    try:
        if isinstance(example, bool):
            return {"true": True, "false": False, "1": True, "0": False}[text.lower()]
        if isinstance(example, tuple):
            kind = type(example[0]) if example else float
            return tuple(kind(part) for part in text.split(",")) if text else ()
        return type(example)(text)
    except (ValueError, KeyError):
        kind = "comma-separated numbers" if isinstance(example, tuple) else type(example).__name__
        raise InputError(f"--{path} takes {kind}, not {text!r}") from None


def _types_of(owner: Any) -> dict[str, Any]:
    return typing.get_type_hints(type(owner))


def _check_leaf(path: str, value: Any, item: dataclasses.Field, hint: Any) -> None:
    if typing.get_origin(hint) is Literal:
        if value not in typing.get_args(hint):
            allowed = " or ".join(str(choice) for choice in typing.get_args(hint))
            raise InputError(f"{path} must be {allowed}, not {value!r}")
        return
    if hint is bool:
        if not isinstance(value, bool):
            raise InputError(f"{path} must be true or false, not {value!r}")
        return
    if typing.get_origin(hint) is not tuple:
        _check_number(path, value, hint, item.metadata)
        return
    kinds = typing.get_args(hint)
    if not isinstance(value, tuple) or (Ellipsis not in kinds and len(value) != len(kinds)):
        count = "several" if Ellipsis in kinds else str(len(kinds))
        raise InputError(f"{path} takes {count} numbers, not {value!r}")
    if not value and item.default:
        raise InputError(f"{path} must hold at least one number")
    for number in value:
        _check_number(path, number, kinds[0], item.metadata)
    if item.metadata["ordered"] and value[0] > value[1]:
        raise InputError(f"{path} must be low,high with low <= high, not {value[0]:g},{value[1]:g}")


def _check_number(path: str, number: Any, kind: type, bounds: Any) -> None:
    allowed = (int,) if kind is int else (int, float)
    if isinstance(number, bool) or not isinstance(number, allowed):
        raise InputError(f"{path} takes {'whole numbers' if kind is int else 'numbers'}, not {number!r}")
    if not abs(number) <= LARGEST:
        raise InputError(f"{path} must be finite and at most {LARGEST:g}, not {number!r}")
    if bounds["above"] is not None and number <= bounds["above"]:
        raise InputError(f"{path} must be greater than {bounds['above']:g}, not {number:g}")
    if bounds["low"] is not None and number < bounds["low"]:
        raise InputError(f"{path} must be at least {bounds['low']:g}, not {number:g}")
    if bounds["high"] is not None and number > bounds["high"]:
        raise InputError(f"{path} must be at most {bounds['high']:g}, not {number:g}")


def validate(config: Config) -> Config:
    """Return `config` if every leaf and every relation between leaves is sound, else raise InputError."""
    for path, value, item in leaves(config):
        owner: Any = config
        for part in path.split(".")[:-1]:
            owner = getattr(owner, part)
        _check_leaf(path, value, item, _types_of(owner)[item.name])
    _validate_plant(config.plant)
    _validate_motion(config)
    start, goal = config.scenario.start_position, config.scenario.goal_reach
    farthest = math.sqrt(3) * (start + goal)
    if farthest >= config.scenario.termination_distance:
        raise InputError(
            f"scenario.goal_reach and start_position allow |e_o| = {farthest:.3g} m at the start, "
            f"beyond termination_distance {config.scenario.termination_distance:g} m"
        )
    if config.physics_step > 0.005 + 1e-12:
        raise InputError(
            f"timing gives physics steps of {config.physics_step * 1e3:.3g} ms, but the attitude loop "
            "runs once a physics step and needs 5 ms or less (200 Hz)"
        )
    if config.sac.replay < max(config.sac.worlds * config.sac.return_steps, config.sac.batch):
        raise InputError("sac.replay must hold at least return_steps steps of all worlds and one batch")
    if config.sac.replay % config.sac.worlds:
        raise InputError("sac.replay must be a multiple of sac.worlds")
    return config


def _validate_plant(plant: Plant) -> None:
    along = "xy".index(plant.cg_axis)
    if plant.leader_mount[along] <= plant.follower_mount[along]:
        raise InputError(f"plant.leader_mount must lie ahead of plant.follower_mount along {plant.cg_axis}")
    if 2 * plant.ball_radius > plant.object_size[along]:
        raise InputError(
            f"plant.ball_radius {plant.ball_radius:g} m makes a ball larger than the object, "
            f"which is {plant.object_size[along]:g} m long"
        )


def cg_reach(plant: Plant) -> float:
    """Largest offset of the CG from O that keeps the moving mass on the object [m]."""
    return plant.moving_fraction * plant.object_size["xy".index(plant.cg_axis)] / 2


def _validate_motion(config: Config) -> None:
    reach = cg_reach(config.plant) + 1e-12
    scenario, motion = config.scenario, config.motion
    if motion.kind == "sine" and scenario.cg_amplitude[1] > reach:
        raise InputError(
            f"scenario.cg_amplitude {scenario.cg_amplitude[1]:g} m leaves the object: the CG reaches {reach:.4g} m"
        )
    if scenario.object_mass[0] + scenario.mass_change[0] <= 0:
        raise InputError(f"scenario.mass_change {scenario.mass_change[0]:g} kg would leave no object mass")
    if motion.kind == "rolling" and scenario.ball_start > reach / config.plant.moving_fraction:
        raise InputError(f"scenario.ball_start {scenario.ball_start:g} m lies beyond the object's end")
    if motion.kind == "waveform":
        if len(motion.times) != len(motion.offsets) or len(motion.times) < 2:
            raise InputError("motion.times and motion.offsets must hold the same number of samples, two or more")
        if not all(map(math.isfinite, (*motion.times, *motion.offsets))):
            raise InputError("motion.times and motion.offsets must be finite")
        if any(later <= earlier for earlier, later in itertools.pairwise(motion.times)):
            raise InputError("motion.times must increase from sample to sample")
        if max(map(abs, motion.offsets)) > reach:
            raise InputError(f"motion.offsets leave the object: the CG reaches {reach:.4g} m")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionary of a configuration (tuples become lists in JSON)."""
    return dataclasses.asdict(config)


def from_dict(data: Any, kind: type = Config, path: str = "") -> Any:
    """Rebuild a configuration from `to_dict`'s output or parsed JSON; raise InputError on any mismatch."""
    if not isinstance(data, dict):
        raise InputError(f"configuration {path or 'root'} must be an object")
    hints = typing.get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]
    unknown = sorted(set(data) - set(names))
    missing = sorted(set(names) - set(data))
    if unknown or missing:
        where = f" in {path}" if path else ""
        what = ", ".join([f"unknown {n}" for n in unknown] + [f"missing {n}" for n in missing][:MAX_LISTED])
        raise InputError(f"configuration does not fit this version{where}: {what}")
    values = {}
    for name in names:
        value = data[name]
        if dataclasses.is_dataclass(hints[name]):
            value = from_dict(value, hints[name], f"{path}.{name}".lstrip("."))
        elif isinstance(value, list):
            value = tuple(map(float, value)) if _is_float_tuple(hints[name], value) else tuple(value)
        elif hints[name] is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        values[name] = value
    return kind(**values)


def _is_float_tuple(hint: Any, value: list[Any]) -> bool:
    plain = all(isinstance(number, (int, float)) and not isinstance(number, bool) for number in value)
    return plain and typing.get_args(hint)[:1] == (float,)


def to_json(config: Any) -> str:
    """Canonical JSON text of a configuration, indented, keys sorted."""
    return json.dumps(to_dict(config), indent=2, sort_keys=True)


def config_hash(config: Any) -> str:
    """First 16 hex digits of the SHA-256 of the configuration's canonical JSON."""
    compact = json.dumps(to_dict(config), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(compact.encode()).hexdigest()[:16]


def _paper() -> Config:
    return Config(
        preset="paper",
        follower=Follower(action="direct", tilt_limit=0.6, vertical_limit=6.0, ignore_position=False),
        reward=Reward(kind="paper", termination=0.0),
        sac=Sac(
            steps=1_000_000,
            worlds=16,
            replay=1_000_000,
            batch=256,
            updates=16,
            prefill=10_000,
            policy_layers=(256, 256),
            critic_layers=(256, 256),
            learning_rate=3e-4,
            learning_rate_end=1.0,
            discount=0.99,
            target_rate=0.005,
            alpha=0.3,
            alpha_fixed=True,
        ),
    )


def _transport() -> Config:
    return Config(
        preset="transport",
        scenario=Scenario(
            cg_speed=(0.2, 3.2),
            cg_amplitude=(0.0, 0.10),
            object_mass=(0.1, 0.3),
            start_velocity=0.2,
            start_tilt=0.05,
        ),
        reward=Reward(error_scale=0.05),
        sac=Sac(
            steps=768_000,
            replay=768_000,
            discount=0.97,
            return_steps=5,
            learning_rate=2e-3,
            learning_rate_end=0.02,
        ),
    )


PRESETS: types.MappingProxyType[str, Config] = types.MappingProxyType({"transport": _transport(), "paper": _paper()})


def preset(name: str) -> Config:
    """Return the named preset; raise InputError for an unknown name."""
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}; choose from {', '.join(PRESETS)}")
    return PRESETS[name]
