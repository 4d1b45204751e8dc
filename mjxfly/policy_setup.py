"""Setup of a flight by a policy's metadata: configuration, gains, command maps, goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from mjxball import config as configs
from mjxball.cli import plant_setup
from mjxball.config import Config
from mjxball.control import crazyflie, motors
from mjxball.control.crazyflie import PairGains
from mjxball.control.motors import MOTORS, Motor
from mjxball.errors import InputError
from mjxball.policy import Policy, PolicyFile, load_file, policy_name, team
from mjxfly.classical import NAMES as CLASSICAL
from mjxfly.classical import ClassicalFollower, classical, is_classical
from mjxfly.limits import Limits, Times
from mjxfly.setpoints import CURVE_NAMES, OLDER, CommandMap, CurveName, ForceCurve, Variant, Variants
from mjxfly.telemetry import Rig

GOAL = (0.0, 0.0, 0.4)  # of O, from where it stands at the start [m]
STAND_GOAL = (0.0, 0.0, 0.08)  # on the stand: level at the paper's p_l^d [m]
LOW_BATTERY = {"brushless": 3.35}  # [V], for drones whose limit differs from that of `Limits`
UNKNOWN_MASS = 0.07  # total mass if the policy's plant is not a pair of Crazyflies [kg]


def load_policy(path: Path) -> PolicyFile:
    """The policy in the file `path`; one trained for any rig is given a pair of Crazyflies. Raises PolicyFileError."""
    contents = load_file(path)
    if not team.is_for_any(contents.metadata):
        return contents
    return team.in_team(contents, policy_name(path), plant_setup(team.CRAZYFLIES))


def load_follower(path: Path, plant: Path | None = None) -> Policy | ClassicalFollower:
    """The follower that `path` names: a policy file, or a classical one for the rig `plant`. Raises InputError."""
    if is_classical(path):
        return classical(str(path), plant)
    if plant is not None:
        names = ", ".join(CLASSICAL)
        raise InputError(
            f"--plant is for {names}: a policy flies the plant in its metadata (see mjxball.export --plant)"
        )
    return Policy(load_policy(path), policy_name(path))


def config_of(metadata: Mapping[str, Any]) -> Config:
    """The configuration that a policy was trained with; settings that an older file lacks have their defaults.

    Raises InputError for an invalid configuration.
    """
    data = configs.to_dict(configs.from_record({"plant": {}, **metadata.get("config", {})}))
    data["plant"] = {**data["plant"], **metadata["plant"]}
    tilt, vertical = metadata["command_limits"]
    data["leader"] |= {"kp": metadata["leader_kp"], "kd": metadata["leader_kd"]}
    data["command"] |= {"tilt_limit": tilt, "vertical_limit": vertical}
    data["timing"] |= {"control_period": metadata["control_period"]}
    return configs.validate(configs.from_record(data))


def mount_angle(metadata: Mapping[str, Any]) -> float:
    """Angle [rad] about body z from the object's axes to those in which the policy sees and commands, see `team`."""
    return float(metadata.get("team", {}).get("mount_angle", 0.0))


def is_crazyflie(config: Config) -> bool:
    """True if the policy was trained on a pair of Crazyflies."""
    return config.autopilot.kind == "crazyflie"


def gains_of(config: Config) -> PairGains:
    """Firmware parameters of the cascades that the policy was trained with; empty for other plants than Crazyflies."""
    if not is_crazyflie(config):
        return {}, {}
    return crazyflie.pair_gains(config.autopilot)


def goal_of(config: Config) -> tuple[float, float, float]:
    """Default goal of O, from where it stands at the start [m]."""
    return GOAL if config.plant.stand == "free" else STAND_GOAL


def times_of(config: Config) -> Times:
    """Durations of the states. With the paper's thrust map a pair follows a sinking goal too weakly to wait for it."""
    return Times(land_spare=0.0) if config.autopilot.thrust_law == "paper" else Times()


def limits_of(config: Config, goal: Sequence[float], battery: float | None = None) -> Limits:
    """Bounds of a flight to `goal` [m]; `battery` [V]: land below it, None for the default of the drones."""
    bounds = Limits()
    bounds = replace(bounds, battery=battery or LOW_BATTERY.get(drone_of(config), bounds.battery))
    return bounds if config.plant.stand == "free" else bounds.on_stand(goal[2])


@dataclass(frozen=True)
class ThrustOptions:
    """Thrust settings of the command line; None: as in the policy's configuration."""

    thrust_model: Literal["paper", "calibrated"] | None = None
    hover: float | None = None  # [thrust units]
    curve: CurveName | None = None
    mass: float | None = None  # total mass of drones and object [kg]


def drone_of(config: Config) -> str:
    """Which Crazyflie the policy was trained for, a key of `motors.MOTORS`."""
    return str(motors.firmware(config)["drone"])


def motor_of(config: Config) -> Motor:
    """The motor by which a firmware's force curve is recognised."""
    return MOTORS[drone_of(config)]


def curve_of(config: Config, name: CurveName) -> ForceCurve:
    """Force of one motor over the thrust command, for firmware with (`linear`) or without battery compensation."""
    return ForceCurve(0.0, motor_of(config).max_force) if name == "linear" else OLDER


def with_curve(config: Config, name: CurveName) -> Config:
    """`config` for firmware with the named force curve, see `motors.with_curve`; unchanged if not for Crazyflies."""
    if not is_crazyflie(config) or name == motors.firmware(config)["curve"]:
        return config
    curve = curve_of(config, name)
    return motors.with_curve(config, (curve.quadratic, curve.linear))


def variants(config: Config, choice: ThrustOptions = ThrustOptions(), more: PairGains = ({}, {})) -> list[Variants]:
    """Command map and gains of leader and follower for each force curve that their firmware may have.

    `choice.curve` selects one curve. `more` gains override those of the policy, for every curve.
    """
    known = motors.firmware(config)
    possible = (known["curve"], *known["converts"]) if choice.curve is None else (choice.curve,)
    names = [name for name in CURVE_NAMES if name in possible]
    found: list[dict[CurveName, Variant]] = [{}, {}]
    for name in names:
        own = with_curve(config, name)
        maps, gains = command_maps(own, replace(choice, curve=name)), gains_of(own)
        for number in range(2):
            found[number][name] = Variant(maps[number], {**gains[number], **more[number]})
    return list(found)


def command_maps(config: Config, choice: ThrustOptions = ThrustOptions()) -> tuple[CommandMap, CommandMap]:
    """Command maps of leader and follower: each carries itself and its share of the object's mass, as in simulation."""
    plant, autopilot = config.plant, config.autopilot
    known = is_crazyflie(config)
    shares = Rig.of_plant(plant).weights
    curve = ForceCurve(*autopilot.motor_curve) if known else curve_of(config, choice.curve or "linear")
    hover = autopilot.hover_thrust if choice.hover is None else choice.hover
    thrust_model = choice.thrust_model or (autopilot.thrust_law if known else "calibrated")
    own = plant.known_masses
    carried = [mass + share * plant.object_mass for mass, share in zip(own, shares, strict=True)]
    if choice.mass is not None or not known:
        whole = UNKNOWN_MASS if choice.mass is None else choice.mass
        # The total is given or guessed: scale all masses by one factor.
        carried = [mass * whole / sum(carried) for mass in carried] if known else [share * whole for share in shares]
    per_acceleration = autopilot.thrust_per_acceleration
    leader, follower = (
        CommandMap(thrust_model, hover, per_acceleration, mass, plant.gravity, curve) for mass in carried
    )
    return leader, follower
