"""Controllers of all drones, which simulation and flight call alike: the leader's PID, observations, stands.

Importing it needs NumPy alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from mjxball.arrays import clipped, joined
from mjxball.config import Config
from mjxball.control import leader, rotations
from mjxball.control import observation as layout
from mjxball.plant import PlantParameters

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Vector

    Observation = Float[Array, "... 18"]

ATTITUDE, RATES = slice(3, 6), slice(9, 12)  # slots of an observation
ROLLS = (1.0, 0.0, 0.0)  # what a stand leaves of an attitude


class BodyState(NamedTuple):
    """A body put together from an observation; see `Body`."""

    position: Vector
    velocity: Vector
    quaternion: Float[Array, "... 4"]
    rates: Vector


class Body(Protocol):
    """The part of a state, simulated or composed of the drones' own, that all drones' controllers need."""

    @property
    def position(self) -> Vector:
        """Of O in the world [m]."""

    @property
    def velocity(self) -> Vector:
        """Of O in the world [m/s]."""

    @property
    def quaternion(self) -> Float[Array, "... 4"]:
        """Body -> world (w, x, y, z)."""

    @property
    def rates(self) -> Vector:
        """About the body axes [rad/s]."""


def relative_to_goal(body: Body, goal_rate: Vector | None) -> Body:
    """`body` with its velocity relative to a goal that moves with `goal_rate` (..., 3) [m/s]; None: it rests."""
    if goal_rate is None:
        return body
    return BodyState(body.position, body.velocity - goal_rate, body.quaternion, body.rates)


class Controllers:
    """Controllers of all drones for one configuration, on arrays of any batch shape and namespace.

    Of several followers, F = N - 1, observations are (..., F, 18) and commands (..., F, 3), in the order of
    `plant.followers`; a pair's one follower has no such axis. Followers see and command in their mount frames
    (`observation.mount_angles`), which are the body axes for a pair; commands that leave here are in body axes.
    `parameters` replace those of `config.plant`.

    On a stand, where a drone's estimator invents motion along what is locked, neither controller is fed it: position
    and velocity across, pitch, yaw and their rates are 0.
    """

    def __init__(self, config: Config, parameters: PlantParameters | None = None):
        self._leader_settings, self._gravity = config.leader, config.plant.gravity
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        # On a pivot height stays: a drone's own follows from roll, and flies on that.
        self._free = None if config.plant.stand == "free" else (0.0, 0.0, 1.0)
        self._follower_sees = config.follower.error
        plant, followers = config.plant, list(config.plant.followers)
        mounts: Any = np.array([drone.mount for drone in plant.drones]) if parameters is None else parameters.mounts
        self._leader, self._followers, self._several = plant.leader, followers, len(followers) > 1
        self._leader_mount = mounts[..., plant.leader, :]
        self._follower_mounts = mounts[..., followers if self._several else followers[0], :]
        self._mount_angles = layout.mount_angles(plant, mounts)

    def observe(self, state: Body, goal: Vector, goal_rate: Vector | None = None) -> Observation:
        """Observations of followers that know the true `state`; `goal` of O [m], and its rate [m/s] if it moves."""
        xp = state.position.__array_namespace__()
        state = self._without_locked_motion(state)
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        origin = (state.position, matrix, state.velocity, state.rates)
        if self._several:
            origin = tuple(xp.expand_dims(part, axis=state.position.ndim - 1) for part in origin)
        own = layout.own_state(*origin, xp.asarray(self._follower_mounts, dtype=state.position.dtype))
        return self._observation(self._without_locked_slots(own), origin, None, goal, goal_rate)

    def estimate(
        self,
        observation: Observation,
        own: tuple[Array, Array] | None,
        attitude_error: Float[Array, "... drones 3"] | None,
    ) -> Observation:
        """The own states in `observation` as drones estimate them that are turned on their mounts.

        `own`: roll, pitch, yaw [rad] and body rates [rad/s] of all drones (..., N, 3) on elastic mounts, see
        `physics.mounts.own_motion`; None: those of the carrier. `attitude_error` of estimates, see `Load`; None: none.
        """
        xp = observation.__array_namespace__()
        drones = self._followers if self._several else self._followers[0]
        attitude, rates = observation[..., ATTITUDE], observation[..., RATES]
        if own is not None:
            attitude, rates = (self._in_mount_frames(part[..., drones, :]) for part in own)
        if attitude_error is not None:
            error = attitude_error[..., drones, :]
            attitude, rates = (rotations.turned_about_z(part, -error[..., 2]) for part in (attitude, rates))
            attitude = attitude + self._in_mount_frames(error)
        rest = observation[..., layout.ERROR.start :]
        return xp.concat([observation[..., :3], attitude, observation[..., 6:9], rates, rest], axis=-1)

    def observe_by(self, own: Float[Array, "... 12"], goal: Vector, goal_rate: Vector | None = None) -> Observation:
        """Observations from the followers' own measured states `own`, from which each computes the object's error.

        p_O = p - R r and its rate, with R of the measured attitude; arguments else as for `observe`.
        """
        own = self._without_locked_slots(self.in_body_axes(own))
        matrix = rotations.matrix_from_quaternion(rotations.quaternion_from_euler(own[..., ATTITUDE]))
        point = (own[..., 0:3], matrix, own[..., 6:9], own[..., RATES])
        return self._observation(own, point, self._follower_mounts, goal, goal_rate)

    def _observation(
        self,
        own: Float[Array, "... 12"],
        point: tuple[Array, ...],
        place: Any,
        goal: Vector,
        goal_rate: Vector | None,
    ) -> Observation:
        """Observations of followers in states `own`, with the error of O or of the leader's place.

        The error follows from the motion of a `point` of the body: its position, the attitude matrix, its velocity, the
        body rates. It is at `place` from O, body axes; None: O itself.
        """
        xp = goal.__array_namespace__()
        position, matrix, velocity, rates = point
        arm = place
        if self._follower_sees == "leader":
            goal = goal + xp.asarray(self._leader_mount, dtype=goal.dtype)
            lead = self._leader_mount[..., None, :] if self._several else self._leader_mount
            arm = -lead if place is None else place - lead
        if self._several:
            goal, goal_rate = (None if part is None else part[..., None, :] for part in (goal, goal_rate))
        error, error_rate = goal - position, -velocity if goal_rate is None else goal_rate - velocity
        if arm is not None:
            arm = xp.asarray(arm, dtype=position.dtype)
            error = error + rotations.rotate(matrix, arm)
            error_rate = error_rate + rotations.rotate(matrix, rotations.cross(rates, arm))
        errors = [self._along_free_axes(error), self._along_free_axes(error_rate)]
        if self._several:
            errors = [xp.broadcast_to(part, (*own.shape[:-1], 3)) for part in errors]
        return self._in_mount_frames(xp.concat([own, *errors], axis=-1))

    def _in_mount_frames(self, vectors: Array) -> Array:
        """`vectors` (..., [F,] 3 k) in body axes, in the followers' mount frames."""
        return vectors if self._mount_angles is None else rotations.turned_about_z(vectors, -self._mount_angles)

    def in_body_axes(self, command: Array) -> Array:
        """The followers' commands (..., 3), or (..., F, 3), from their mount frames."""
        return command if self._mount_angles is None else rotations.turned_about_z(command, self._mount_angles)

    def seen_by_followers(self, vector: Array) -> Array:
        """A vector (..., 2) or (..., 3) in body axes in all mount frames, (..., F, 2 or 3) of several followers."""
        xp, size = vector.__array_namespace__(), vector.shape[-1]
        whole = vector if size == 3 else xp.concat([vector, xp.zeros_like(vector[..., :1])], axis=-1)
        if self._several:
            shape = (*whole.shape[:-1], self._follower_mounts.shape[-2], 3)
            whole = xp.broadcast_to(whole[..., None, :], shape)
        turned = whole if self._mount_angles is None else rotations.turned_about_z(whole, -self._mount_angles)
        return turned[..., :size]

    def stack(self, leader_command: Vector, follower_command: Array) -> Float[Array, "... drones 3"]:
        """Commands in body axes of the leader (..., 3) and the followers as the physics takes them."""
        xp, place = leader_command.__array_namespace__(), self._leader
        if not self._several:
            both = (leader_command, follower_command)
            return joined(both if place == 0 else both[::-1], axis=-2)
        ahead, behind = follower_command[..., :place, :], follower_command[..., place:, :]
        return xp.concat([ahead, leader_command[..., None, :], behind], axis=-2)

    def body_from_observation(self, observation: Observation, goal: Vector) -> BodyState:
        """The body that `observation` tells of, the first follower's of several, e_o or e_l in it; `goal` of O."""
        if self._mount_angles is not None:
            observation = rotations.turned_about_z(observation, self._mount_angles)
        observation = observation[..., 0, :] if self._several else observation
        euler, rates = observation[..., 3:6], observation[..., 9:12]
        position = self._along_free_axes(goal) - observation[..., layout.ERROR]
        quaternion = rotations.quaternion_from_euler(euler)
        velocity = -observation[..., layout.ERROR_RATE]
        if self._follower_sees == "leader":
            arm, sweep = self._leader_mount_motion(quaternion, rates, goal)
            mount = goal.__array_namespace__().asarray(self._leader_mount, dtype=goal.dtype)
            position, velocity = self._along_free_axes(position + mount - arm), self._along_free_axes(velocity - sweep)
        return BodyState(position, velocity, quaternion, rates)

    def leader_error(self, state: Body, goal: Vector) -> tuple[Vector, Vector]:
        """(error, its rate) on which the leader flies."""
        if self._free is not None:
            state, goal = self._without_locked_motion(state), self._along_free_axes(goal)
        if self._leader_settings.error == "object":
            return goal - state.position, -state.velocity
        error, rate = self._leader_place_error(state, goal)
        return self._along_free_axes(error), self._along_free_axes(rate)

    def integrate(self, integral: Vector, state: Body, goal: Vector, period: float) -> Vector:
        """`integral` (..., 3) [m s] of the leader's error one `period` [s] on, in which it was that at `state`."""
        xp = goal.__array_namespace__()
        band = xp.asarray(self._leader_settings.integral_error_limit, dtype=goal.dtype)
        error, rate = self.leader_error(state, goal)
        lead = self._leader_settings.integral_lead_time
        error = error + lead * rate if lead else error
        return integral + period * clipped(error, -band, band)

    def leader_command(self, state: Body, goal: Vector, integral: Vector) -> Vector:
        """The leader's command at `state`; `integral` (..., 3) of its error so far."""
        error, rate = self.leader_error(state, goal)
        gains = self._leader_settings.kp, self._leader_settings.kd, self._leader_settings.ki
        return leader.pid_command(error, rate, integral, gains, self._gravity, *self._limits)

    def _along_free_axes(self, vector: Vector) -> Vector:
        """`vector` in the world without what the stand locks."""
        if self._free is None:
            return vector
        return vector * vector.__array_namespace__().asarray(self._free, dtype=vector.dtype)

    def _without_locked_slots(self, own: Float[Array, "... 12"]) -> Float[Array, "... 12"]:
        """Own states without motion along what the stand locks, the tilted mount's way across included."""
        if self._free is None:
            return own
        return own * own.__array_namespace__().asarray([*self._free, *ROLLS] * 2, dtype=own.dtype)

    def _without_locked_motion(self, state: Body) -> Body:
        """`state` without motion along what the stand locks."""
        if self._free is None:
            return state
        rolls = state.rates.__array_namespace__().asarray(ROLLS, dtype=state.rates.dtype)
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
        quaternion = rotations.quaternion_from_euler(euler * rolls)
        return BodyState(
            self._along_free_axes(state.position),
            self._along_free_axes(state.velocity),
            quaternion,
            state.rates * rolls,
        )

    def _leader_place_error(self, state: Body, goal: Vector) -> tuple[Vector, Vector]:
        """e_l = goal + mount - p_l and its rate: 0 where the object is level and at its goal (paper, V-B)."""
        xp = goal.__array_namespace__()
        mount = xp.asarray(self._leader_mount, dtype=goal.dtype)
        arm, sweep = self._leader_mount_motion(state.quaternion, state.rates, goal)
        return goal + mount - state.position - arm, -state.velocity - sweep

    def _leader_mount_motion(
        self, quaternion: Float[Array, "... 4"], rates: Vector, like: Array
    ) -> tuple[Vector, Vector]:
        """The leader's mount from O in the world and how fast it moves about it."""
        mount = like.__array_namespace__().asarray(self._leader_mount, dtype=like.dtype)
        matrix = rotations.matrix_from_quaternion(quaternion)
        return rotations.rotate(matrix, mount), rotations.rotate(matrix, rotations.cross(rates, mount))
