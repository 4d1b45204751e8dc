"""What the follower sees and how its network's output becomes a command. Written once, for training and for flight."""

from __future__ import annotations

from typing import Any

from mjxball.control import leader, rotations

Array = Any

# (name, unit) of every slot, in order (the paper's; body rates instead of the paper's Euler rates).
OBSERVATION: tuple[tuple[str, str], ...] = (
    ("follower_x", "m"),
    ("follower_y", "m"),
    ("follower_z", "m"),
    ("roll", "rad"),
    ("pitch", "rad"),
    ("yaw", "rad"),
    ("follower_vx", "m/s"),
    ("follower_vy", "m/s"),
    ("follower_vz", "m/s"),
    ("rate_x", "rad/s"),
    ("rate_y", "rad/s"),
    ("rate_z", "rad/s"),
    ("object_error_x", "m"),
    ("object_error_y", "m"),
    ("object_error_z", "m"),
    ("object_error_rate_x", "m/s"),
    ("object_error_rate_y", "m/s"),
    ("object_error_rate_z", "m/s"),
)
ACTION: tuple[tuple[str, str], ...] = (("roll", "rad"), ("pitch", "rad"), ("vertical_acceleration", "m/s2"))
OBSERVATION_SIZE = len(OBSERVATION)
ACTION_SIZE = len(ACTION)
ERROR = slice(12, 15)
ERROR_RATE = slice(15, 18)


def observe(position: Array, matrix: Array, velocity: Array, rates: Array, goal: Array, mount: Array) -> Array:
    """The 18 numbers of `OBSERVATION` (..., 18) from the object's state.

    `position`, `velocity` of O in the world (..., 3), attitude `matrix` (..., 3, 3), body `rates` (..., 3),
    `goal` of O (..., 3), follower `mount` in body axes (3,). The goal stands still, so de_o/dt = -velocity.
    """
    xp = position.__array_namespace__()
    follower = position + rotations.rotate(matrix, mount)
    follower_velocity = velocity + rotations.rotate(matrix, rotations.cross(rates, mount))
    euler = rotations.euler_from_matrix(matrix)
    return xp.concat([follower, euler, follower_velocity, rates, goal - position, -velocity], axis=-1)


def copy_command(
    observation: Array, kp: Array, kd: Array, gravity: float, tilt_limit: float, vertical_limit: float
) -> Array:
    """The `copy` follower: the leader's PD law on the follower's own observation (..., 18) -> command (..., 3)."""
    xp = observation.__array_namespace__()
    kp, kd = (xp.asarray(gain, dtype=observation.dtype) for gain in (kp, kd))
    acceleration = leader.desired_acceleration(
        observation[..., ERROR], observation[..., ERROR_RATE], xp.zeros_like(observation[..., ERROR]), kp, kd, 0.0
    )
    return leader.command(acceleration, 0.0, gravity, tilt_limit, vertical_limit)


def commanded(load_axis_only: bool, cg_axis: str) -> tuple[float, float, float]:
    """1 for each action that a network commands, else 0: of roll and pitch perhaps only the one that the load turns."""
    return (1.0, 1.0, 1.0) if not load_axis_only else (float(cg_axis == "y"), float(cg_axis == "x"), 1.0)


def scale_action(scaled: Array, tilt_limit: float, vertical_limit: float) -> Array:
    """Network action in [-1, 1] (..., 3) -> (roll, pitch [rad], vertical acceleration [m/s2])."""
    xp = scaled.__array_namespace__()
    return scaled * xp.asarray([tilt_limit, tilt_limit, vertical_limit], dtype=scaled.dtype)


def follower_command(
    scaled: Array,
    observation: Array,
    residual: bool,
    action_scale: tuple[float, float],
    kp: Array,
    kd: Array,
    gravity: float,
    limits: tuple[float, float],
) -> Array:
    """Command (..., 3) of a network action `scaled` in [-1, 1] (..., 3) at `observation` (..., 18).

    `action_scale` = (tilt [rad], vertical [m/s2]) scales the action; with `residual` the PD law on the observed
    error is added. The sum is clipped to `limits` = (tilt [rad], vertical [m/s2]).
    """
    command = scale_action(scaled, *action_scale)
    if residual:
        command = command + copy_command(observation, kp, kd, gravity, *limits)
    return leader.clip_command(command, *limits)
