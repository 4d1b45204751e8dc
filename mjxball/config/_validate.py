"""Validation: types, bounds, and relations between settings. Every refusal is an InputError of one sentence."""

from __future__ import annotations

import dataclasses
import itertools
import math
import typing
from typing import Any, Literal

from mjxball.config._plant import Plant
from mjxball.config._plausible import check_units
from mjxball.config._settings import Config
from mjxball.config._tree import leaves
from mjxball.errors import InputError
from mjxball.reading import MIN_SIZE, is_number, shown

MOST_DRONES = 16  # of a plant
FARTHEST = 10.0  # distance of a mount from O [m]
APART = 1e-3  # least distance of two drones [m]
THRUST_MARGIN = 0.2  # least share of a Crazyflie's thrust that hovering leaves


def check_leaves(config: Config) -> None:
    """Raise InputError unless every setting has its type and lies within its bounds."""
    for path, value, item in leaves(config):
        _check_leaf(path, value, item)


def _check_leaf(path: str, value: Any, item: dataclasses.Field) -> None:
    kind: Any = item.type
    kinds = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        if value not in kinds:
            raise InputError(f"{path} must be {' or '.join(kinds)}, not {shown(value)}")
    elif kind is bool:
        if not isinstance(value, bool):
            raise InputError(f"{path} must be true or false, not {shown(value)}")
    elif typing.get_origin(kind) is not tuple:
        _check_number(path, value, kind, item.metadata)
    elif not isinstance(value, tuple) or (Ellipsis not in kinds and len(value) != len(kinds)):
        count = "several" if Ellipsis in kinds else str(len(kinds))
        raise InputError(f"{path} takes {count} numbers, not {shown(value)}")
    elif not value and item.default:
        raise InputError(f"{path} must hold at least one number")
    elif len(value) > item.metadata["most"]:
        raise InputError(f"{path} takes at most {item.metadata['most']:,} numbers, not {len(value):,}")
    else:
        for number in value:
            _check_number(path, number, kinds[0], item.metadata)
        if item.metadata["ordered"] and value[0] > value[1]:
            raise InputError(f"{path} must be low,high with low <= high, not {value[0]:g},{value[1]:g}")


def _check_number(path: str, number: Any, kind: type, bounds: Any) -> None:
    allowed = (int,) if kind is int else (int, float)
    if isinstance(number, bool) or not isinstance(number, allowed):
        raise InputError(f"{path} takes {'whole numbers' if kind is int else 'numbers'}, not {shown(number)}")
    if not bounds["low"] <= number <= bounds["high"]:
        raise InputError(f"{path} must be between {bounds['low']:g} and {bounds['high']:g}, not {shown(number)}")
    if not is_number(number):
        raise InputError(f"{path} must be 0 or at least {MIN_SIZE:g} in size, not {shown(number)}")


def validate(config: Config) -> Config:
    """Return `config` if every setting and every relation between settings is valid, else raise InputError."""
    check_leaves(config)
    _validate_plant(config.plant)
    check_units(config)
    _validate_team(config)
    _validate_autopilot(config)
    _validate_motion(config)
    start, goal = config.scenario.start_position, config.scenario.goal_range
    farthest = math.sqrt(3) * (start + goal)
    if farthest >= config.scenario.termination_distance:
        raise InputError(
            f"scenario.goal_range and start_position allow |e_o| = {farthest:.3g} m at the start, "
            f"beyond termination_distance {config.scenario.termination_distance:g} m"
        )
    if config.scenario.attitude_frequency[1] > 0 and config.autopilot.kind != "ideal":
        raise InputError("scenario.attitude_frequency is of ideal attitude loops, and autopilot.kind is another")
    if 0 in config.scenario.attitude_frequency and any(config.scenario.attitude_frequency):
        raise InputError("scenario.attitude_frequency must be 0 0, or positive")
    if config.scenario.wind[1] > 0 and config.scenario.rotor_drag[1] == 0:
        raise InputError("scenario.wind acts through scenario.rotor_drag, which is 0")
    if config.scenario.jitter[1] >= config.timing.control_period:
        raise InputError(f"scenario.jitter must be below timing.control_period {config.timing.control_period:g} s")
    if config.physics_step > 0.005 + 1e-12:
        raise InputError(
            f"timing gives physics steps of {config.physics_step * 1e3:.3g} ms, but the attitude loop "
            "runs once a physics step and needs 5 ms or less (200 Hz)"
        )
    if config.sac.replay_size < max(config.sac.num_envs * config.sac.n_step, config.sac.batch_size):
        raise InputError("sac.replay_size must hold at least n_step steps of all num_envs environments and one batch")
    if config.sac.total_steps <= config.sac.warmup_steps:
        raise InputError(
            f"sac.total_steps {config.sac.total_steps} leaves nothing to learn after "
            f"sac.warmup_steps {config.sac.warmup_steps}"
        )
    if config.ppo.num_envs % config.ppo.minibatches:
        raise InputError(
            f"ppo.num_envs {config.ppo.num_envs} is not a multiple of ppo.minibatches {config.ppo.minibatches}"
        )
    if config.sac.replay_size % config.sac.num_envs:
        raise InputError("sac.replay_size must be a multiple of sac.num_envs")
    return config


def _validate_plant(plant: Plant) -> None:
    if plant.count < 2 or plant.count > MOST_DRONES:
        raise InputError(f"plant.drones must hold 2 to {MOST_DRONES} drones, a leader and its followers")
    if plant.leader >= plant.count:
        raise InputError(f"plant.leader {plant.leader} is none of the {plant.count} drones, which count from 0")
    for (one, a), (other, b) in itertools.combinations(enumerate(plant.drones), 2):
        if math.dist(a.mount, b.mount) < APART:
            raise InputError(f"plant.drones.{one}.mount and plant.drones.{other}.mount are the same place")
    for number, drone in enumerate(plant.drones):
        if math.hypot(*drone.mount) > FARTHEST:
            far = max(map(abs, drone.mount))
            raise InputError(
                f"plant.drones.{number}.mount lies beyond {FARTHEST:g} m from O; {far:g} mm would be {far / 1000:g} m"
            )
    if plant.carrier_mass > 0 and min(plant.carrier_inertia) <= 0:
        raise InputError(
            f"plant.carrier_inertia {plant.carrier_inertia!r} is singular, and the carrier has a mass: set it, of a "
            "disc of mass m and radius r m r^2 / 4, m r^2 / 4, m r^2 / 2"
        )
    if len(plant.directions) == 1:
        along = plant.directions[0]
        places = [drone.mount[along] for drone in plant.drones]
        if max(places) - min(places) < APART:
            raise InputError(f"plant.drones sit at one place along {plant.cg_axis}, where nothing holds the load")
        if plant.count == 2 and places[plant.leader] <= places[1 - plant.leader]:
            raise InputError(
                f"plant.drones.{plant.leader}.mount, the leader's, must lie ahead of the follower's along "
                f"{plant.cg_axis}"
            )
    length = min(plant.object_size[axis] for axis in plant.directions)
    if 2 * plant.ball_radius > length:
        raise InputError(
            f"plant.ball_radius {plant.ball_radius:g} m makes a ball larger than the object, which is {length:g} m long"
        )
    end = length / 2 - plant.ball_radius
    if plant.ball_stop > end + 1e-12:
        raise InputError(f"plant.ball_stop {plant.ball_stop:g} m lies off the object, where a ball reaches {end:.4g} m")


def _validate_team(config: Config) -> None:
    """Settings that need a team, and those that need a pair."""
    plant, scenario = config.plant, config.scenario
    if len(plant.directions) == 1 and scenario.cg_width[1] > 0:
        raise InputError("scenario.cg_width is for a load that moves in the plane: set plant.cg_axis to xy, or it to 0")
    if scenario.battery[1] > 0 and plant.count > 2:
        raise InputError("scenario.battery is for a pair of Crazyflies")
    for name in ("lost_follower_probability", "lost_leader_probability"):
        if getattr(scenario, name) > 0 and plant.count < 3:
            raise InputError(f"scenario.{name} needs a plant of three drones or more")
        if getattr(scenario, name) > 0 and config.rigs.number:
            raise InputError(f"scenario.{name} is for the plant and its rings, not for random rigs: set rigs.number 0")
    if scenario.lost_follower_probability + scenario.lost_leader_probability > 1:
        raise InputError("scenario.lost_follower_probability and scenario.lost_leader_probability exceed 1 together")
    if config.follower.load_axis_only and len(plant.directions) == 2:
        raise InputError("follower.load_axis_only is for a load that moves along a line, not in the plane")
    if config.rigs.number and not scenario.team_sizes:
        raise InputError("rigs.number needs scenario.team_sizes, the numbers of drones of random rigs")
    if not scenario.team_sizes:
        return
    if max(scenario.team_sizes) > plant.count:
        raise InputError(
            f"scenario.team_sizes go up to {max(scenario.team_sizes)} drones, and the plant has {plant.count}: set "
            f"scenario.team_sizes to {plant.count} or less, or to nothing for this plant alone"
        )
    if plant.count < 3 or len(plant.directions) == 1 or plant.leader or config.autopilot.kind != "ideal":
        raise InputError(
            "scenario.team_sizes need a plant of three ideal drones or more, the first of which leads, and a load that "
            "moves in the plane"
        )


def thrust_margin(config: Config) -> float:
    """Share of full thrust that hovering with the heaviest object leaves the most loaded drone; negative: too heavy."""
    plant, most = config.plant, 4 * sum(config.autopilot.motor_curve)
    mass = config.scenario.object_mass[1] + max(config.scenario.mass_change[1], 0.0)
    carried = (own + share * mass for own, share in zip(plant.known_masses, plant.load_shares, strict=True))
    return 1 - max(carried) * plant.gravity / most


def _validate_autopilot(config: Config) -> None:
    if config.autopilot.kind == "ideal":
        return
    if abs(config.physics_step - 0.002) > 1e-9:
        raise InputError(
            f"timing gives physics steps of {config.physics_step * 1e3:.3g} ms, but a Crazyflie's loops run at 500 Hz: "
            "control_period over physics_steps must be 2 ms"
        )
    most = sum(config.autopilot.motor_curve)
    if config.plant.layout != "x" or abs(config.plant.rotor_force_max - most) > 1e-3 * most:
        raise InputError(
            f"a Crazyflie has plant.layout x and, with this autopilot.motor_curve, plant.rotor_force_max {most:.4g} N"
        )
    if any(drone.yaw or drone.rotor_force_max for drone in config.plant.drones):
        raise InputError(
            "a Crazyflie has no yaw or rotor_force_max of its own in plant.drones: its firmware's axes are the rig's, "
            "and autopilot.motor_curve is that of all drones"
        )
    margin = thrust_margin(config)
    if margin < THRUST_MARGIN:
        raise InputError(
            f"hovering takes {1 - margin:.0%} of a drone's thrust and leaves {margin:.0%}, where 20% are needed: "
            "make the rig lighter or the motors stronger"
        )


def cg_limit(plant: Plant) -> float:
    """Largest offset of the CG from O that keeps the moving mass on the object [m]."""
    return plant.moving_fraction * min(plant.object_size[axis] for axis in plant.directions) / 2


def ball_limit(plant: Plant) -> float:
    """Offset of a rolling ball at which it touches an end stop or the rim [m]."""
    return plant.ball_stop or min(plant.object_size[axis] for axis in plant.directions) / 2 - plant.ball_radius


def _validate_motion(config: Config) -> None:
    limit = cg_limit(config.plant) + 1e-12
    scenario, motion = config.scenario, config.motion
    if motion.kind == "sine" and scenario.cg_amplitude[1] > limit:
        raise InputError(
            f"scenario.cg_amplitude {scenario.cg_amplitude[1]:g} m leaves the object: the CG reaches {limit:.4g} m"
        )
    if scenario.object_mass[0] + scenario.mass_change[0] <= 0:
        raise InputError(f"scenario.mass_change {scenario.mass_change[0]:g} kg would leave no object mass")
    if motion.kind == "rolling" and scenario.ball_start > ball_limit(config.plant):
        end = ball_limit(config.plant)
        raise InputError(f"scenario.ball_start {scenario.ball_start:g} m lies beyond the end stop at {end:.4g} m")
    if motion.kind == "waveform":
        if len(motion.times) != len(motion.offsets) or len(motion.times) < 2:
            raise InputError("motion.times and motion.offsets must hold the same number of samples, two or more")
        across = motion.offsets_across or (0.0,) * len(motion.times)
        if len(across) != len(motion.times):
            raise InputError("motion.times and motion.offsets_across must hold the same number of samples, or none")
        if motion.offsets_across and len(config.plant.directions) == 1:
            raise InputError("motion.offsets_across is for a load that moves in the plane, with plant.cg_axis xy")
        if not all(map(math.isfinite, (*motion.times, *motion.offsets, *across))):
            raise InputError("motion.times and motion.offsets must be finite")
        if any(later <= earlier for earlier, later in itertools.pairwise(motion.times)):
            raise InputError("motion.times must increase from sample to sample")
        if max(map(math.hypot, motion.offsets, across)) > limit:
            raise InputError(f"motion.offsets leave the object: the CG reaches {limit:.4g} m")
