"""The follower's observation, its history, and the scaling of its network's action to a command.

Written once, for training and for flight; every function runs on NumPy and on JAX arrays.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config, Plant
from mjxball.control import leader, rotations

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
OWN_STATE = 12  # numbers of a follower's own state, which begin an observation: position, attitude, velocity, rates
STALE = 0.05  # input of a network where a measurement repeats the last; small, so that rare ones are not amplified


def own_state(position: Array, matrix: Array, velocity: Array, rates: Array, mount: Array) -> Array:
    """A follower's position, (roll, pitch, yaw), velocity and body rates (..., 12) from the object's state.

    `position`, `velocity` of O in the world (..., 3), attitude `matrix` (..., 3, 3), body `rates` (..., 3), follower
    `mount` in body axes (..., 3); they broadcast.
    """
    xp = position.__array_namespace__()
    follower = position + rotations.rotate(matrix, mount)
    follower_velocity = velocity + rotations.rotate(matrix, rotations.cross(rates, mount))
    parts = (follower, rotations.euler_from_matrix(matrix), follower_velocity, rates)
    return xp.concat([xp.broadcast_to(part, follower.shape) for part in parts], axis=-1)


def observe(position: Array, matrix: Array, velocity: Array, rates: Array, goal: Array, mount: Array) -> Array:
    """The 18 numbers of `OBSERVATION` (..., 18) from the object's state, arguments as for `own_state`.

    `goal` of O (..., 3) stands still, so de_o/dt = -velocity.
    """
    xp, own = position.__array_namespace__(), own_state(position, matrix, velocity, rates, mount)
    errors = (xp.broadcast_to(part, (*own.shape[:-1], 3)) for part in (goal - position, -velocity))
    return xp.concat([own, *errors], axis=-1)


def mount_angles(plant: Plant, mounts: Array | None = None) -> Array | None:
    """Angles (..., F) about body z by which the followers' mount frames are turned from the body axes [rad] (ours).

    In its frame a follower's mount lies on the negative half of x. The frame turns world and body alike, so every
    vector and (roll, pitch, yaw) of an observation turns as a vector, and (roll, pitch) of a command turns back. None
    for a pair whose load moves along a line: its follower sees body axes. `mounts` (..., N, 3) if they are not the
    plant's; without F where there is one follower.
    """
    return mount_frames(plant, mounts) if plant.is_team else None


def mount_frames(plant: Plant, mounts: Array | None = None) -> Array:
    """`mount_angles`, of every pair too."""
    places: Any = np.array([drone.mount for drone in plant.drones]) if mounts is None else mounts
    followers = list(plant.followers) if len(plant.followers) > 1 else plant.followers[0]
    own = places[..., followers, :]
    return own.__array_namespace__().atan2(-own[..., 1], -own[..., 0])


def copy_command(
    observation: Array, kp: Array, kd: Array, gravity: float, tilt_limit: float, vertical_limit: float
) -> Array:
    """The `copy` follower: the leader's PD controller on the follower's observation (..., 18) -> command (..., 3)."""
    error, rate = observation[..., ERROR], observation[..., ERROR_RATE]
    zero = observation.__array_namespace__().zeros_like(error)
    return leader.pid_command(error, rate, zero, (kp, kd, 0.0), gravity, tilt_limit, vertical_limit)


def repeats(observation: Array, last: Array) -> Array:
    """(..., 1) whether the own state in `observation` (..., 18) is exactly the `last` (..., 12), as in a gap."""
    xp = observation.__array_namespace__()
    return xp.all(xp.equal(observation[..., :OWN_STATE], last), axis=-1, keepdims=True)


def action_mask(load_axis_only: bool, cg_axis: str) -> tuple[float, float, float]:
    """1 for each action that a network commands, else 0: of roll and pitch perhaps only the one that the load turns."""
    return (1.0, 1.0, 1.0) if not load_axis_only else (float(cg_axis == "y"), float(cg_axis == "x"), 1.0)


def scale_action(action: Array, tilt_limit: float, vertical_limit: float) -> Array:
    """Network action in [-1, 1] (..., 3) -> (roll, pitch [rad], vertical acceleration [m/s2])."""
    xp = action.__array_namespace__()
    return action * xp.asarray([tilt_limit, tilt_limit, vertical_limit], dtype=action.dtype)


class ObservationHistory(NamedTuple):
    """Past observations and actions in the network's input. By default none.

    The memory (..., m) holds, in this order: for each time constant of `filters` an exponential average of the
    observations (18) and one of the network's actions (3), which is what a linear observer of disturbances needs of
    the past; the last action (3) if `previous_action`; the last own state (12) if `stale`.
    """

    previous_action: bool = False
    filters: tuple[float, ...] = ()  # time constants [s]
    period: float = 0.02  # between two observations [s]
    stale: bool = False  # whether the network's input says that no new measurement has arrived

    @property
    def size(self) -> int:
        """Length m of the memory."""
        return self.past_size + OWN_STATE * self.stale

    @property
    def input_size(self) -> int:
        """What `network_input` is longer than an observation."""
        return self.past_size + self.stale

    @property
    def past_size(self) -> int:
        """Length of the memory of averages and the last action."""
        averages = len(self.filters) * (OBSERVATION_SIZE + ACTION_SIZE)
        return averages + (ACTION_SIZE if self.previous_action else 0)

    def start(self, observation: Array) -> Array:
        """Memory (..., m) at the start of an episode: always this `observation` (..., 18), and zero actions."""
        xp = observation.__array_namespace__()
        still = xp.zeros_like(observation[..., :ACTION_SIZE])
        parts = [observation, still] * len(self.filters) + [still] * self.previous_action
        # Not equal to the first measurement, which is new.
        parts += [observation[..., :OWN_STATE] + 1.0] * self.stale
        return xp.concat(parts, axis=-1) if parts else observation[..., :0]

    def next(self, memory: Array, observation: Array, scaled_action: Array) -> Array:
        """Memory for the next step, after `observation` was answered by `scaled_action` (..., 3) in [-1, 1]."""
        xp = observation.__array_namespace__()
        if not self.size:
            return memory
        parts = []
        for average, tau in zip(self._averages(memory), self.filters, strict=True):
            new = xp.concat([observation, scaled_action], axis=-1)
            parts.append(average - math.expm1(-self.period / tau) * (new - average))
        parts += [scaled_action] * self.previous_action + [observation[..., :OWN_STATE]] * self.stale
        return xp.concat(parts, axis=-1)

    def network_input(self, observation: Array, memory: Array) -> Array:
        """Input of the network (..., 18 + `input_size`): the observation, averages minus it, the last action, `STALE`.

        The difference to an average is a filtered derivative; normalised on its own it keeps its small numbers.
        """
        xp = observation.__array_namespace__()
        parts = [observation]
        for average in self._averages(memory):
            parts += [average[..., :OBSERVATION_SIZE] - observation, average[..., OBSERVATION_SIZE:]]
        parts.append(memory[..., self.past_size - ACTION_SIZE * self.previous_action : self.past_size])
        if self.stale:
            flag, fresh = xp.asarray(STALE, dtype=observation.dtype), xp.zeros_like(observation[..., :1])
            parts.append(xp.where(repeats(observation, memory[..., self.past_size :]), flag, fresh))
        return xp.concat(parts, axis=-1)

    def mask(self, ignore_position: bool) -> list[float]:
        """1 for each number of `network_input` that the network uses, 0 for absolute positions if it ignores them."""
        shown = [0.0 if ignore_position else 1.0] * 3 + [1.0] * (OBSERVATION_SIZE - 3)
        # How an absolute position differs from its average does not depend on where that is.
        return shown + [1.0] * self.input_size

    def slowest_action(self, memory: Array) -> Array:
        """(..., 3) the network's own action in [-1, 1], averaged over the longest of `filters`."""
        slowest = self.filters.index(max(self.filters))
        return self._averages(memory)[slowest][..., OBSERVATION_SIZE:]

    def _averages(self, memory: Array) -> list[Array]:
        width = OBSERVATION_SIZE + ACTION_SIZE
        return [memory[..., k * width : (k + 1) * width] for k in range(len(self.filters))]


def observation_history(config: Config) -> ObservationHistory:
    """That of the follower of `config`."""
    follower, period = config.follower, config.timing.control_period
    return ObservationHistory(follower.previous_action, follower.observation_averages, period, follower.stale)
