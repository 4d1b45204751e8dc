"""What leader and follower see of the plant, and the leader's law on it: one wiring for simulation and flight."""

from __future__ import annotations

from typing import Any, Protocol

from mjxball.config import Config
from mjxball.control import leader, observation, rotations

Array = Any


class Body(Protocol):
    """What both drones' laws need of a state: a simulated one, or one that was put together from two drones'."""

    @property
    def position(self) -> Array:
        """(..., 3) of O in the world [m]."""

    @property
    def velocity(self) -> Array:
        """(..., 3) of O in the world [m/s]."""

    @property
    def quaternion(self) -> Array:
        """(..., 4) body -> world (w, x, y, z)."""

    @property
    def rates(self) -> Array:
        """(..., 3) about the body axes [rad/s]."""


class Wiring:
    """The senses of both drones and the leader's PID for one configuration, on arrays of any batch shape."""

    def __init__(self, config: Config):
        self._law, self._gravity = config.leader, config.plant.gravity
        self._follower_sees = config.follower.error
        self._leader_mount, self._follower_mount = config.plant.leader_mount, config.plant.follower_mount

    def observe(self, state: Body, goal: Array) -> Array:
        """The follower's observation (..., 18); `goal` of O (..., 3)."""
        xp = state.position.__array_namespace__()
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        mount = xp.asarray(self._follower_mount, dtype=state.position.dtype)
        seen = observation.observe(state.position, matrix, state.velocity, state.rates, goal, mount)
        if self._follower_sees == "object":
            return seen
        return xp.concat([seen[..., : observation.ERROR.start], *self._own_error(state, goal)], axis=-1)

    def leader_error(self, state: Body, goal: Array) -> tuple[Array, Array]:
        """(error, its rate) (..., 3) on which the leader flies."""
        if self._law.error == "object":
            return goal - state.position, -state.velocity
        return self._own_error(state, goal)

    def integrated(self, integral: Array, state: Body, goal: Array, period: float) -> Array:
        """`integral` (..., 3) [m s] one `period` [s] on, in which its error was that at `state`."""
        xp = goal.__array_namespace__()
        band = xp.asarray(self._law.integral_band, dtype=goal.dtype)
        return integral + period * xp.clip(self.leader_error(state, goal)[0], -band, band)

    def leader_command(self, state: Body, goal: Array, integral: Array) -> Array:
        """The leader's command (..., 3) at `state`; `integral` (..., 3) of its error so far [m s]."""
        xp, law = goal.__array_namespace__(), self._law
        gains = (xp.asarray(gain, dtype=goal.dtype) for gain in (law.kp, law.kd, law.ki))
        wanted = leader.desired_acceleration(*self.leader_error(state, goal), integral, *gains)
        return leader.command(wanted, 0.0, self._gravity, law.tilt_limit, law.vertical_limit)

    def _own_error(self, state: Body, goal: Array) -> tuple[Array, Array]:
        """e_l = goal + mount - p_l (..., 3) and its rate: 0 where the object is level and at its goal (paper, V-B)."""
        xp = goal.__array_namespace__()
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        mount = xp.asarray(self._leader_mount, dtype=goal.dtype)
        arm = rotations.rotate(matrix, mount)
        sweep = rotations.rotate(matrix, rotations.cross(state.rates, mount))
        return goal + mount - state.position - arm, -state.velocity - sweep
