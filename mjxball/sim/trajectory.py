"""The one record of flights: every driver writes it, metrics, figures and views read it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball import pictures
from mjxball.control import rotations

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import PlantState, Scalar, Vector
    from mjxball.sim.closed_loop import TeamCommands

NOT_RECORDED: Any = None


class Trajectory(NamedTuple):
    """Record of one flight, or of a batch of n flights, by every driver; a pytree.

    All fields have an axis of T control steps first, the start in row 0, and in a batch the flights' axis n second;
    `row` gives a single step, `world` a single flight. What was not recorded is None. Several followers have an axis,
    in the order of `plant.followers`, before the last one of `follower_command` and `observation`; `cg_offset` ends
    with an axis of 2 where the load moves in the plane. A flight that diverges (a coordinate of O or a body rate beyond
    any bound, or a value that is not finite) stays as it was before. `simulate` gives NumPy float64 and all fields.
    """

    time: Float[Array, "..."]  # [s]
    position: Float[Array, "... 3"]  # of O in the world [m]
    velocity: Float[Array, "... 3"]  # of O in the world [m/s]
    euler: Float[Array, "... 3"]  # roll, pitch, yaw [rad]
    rates: Float[Array, "... 3"]  # body rates [rad/s]
    quaternion: Float[Array, "... 4"]  # body -> world (w, x, y, z)
    rotor_force: Float[Array, "... drones 4"]  # [N]
    leader_command: Float[Array, "... 3"]  # roll, pitch [rad], vertical acceleration [m/s2], in body axes
    follower_command: Float[Array, "... 3"]  # likewise
    target: Float[Array, "... 3"]  # goal of O [m]
    diverged: Bool[Array, "..."]  # whether the flight has diverged by then
    observation: Float[Array, "... 18"] = NOT_RECORDED  # what the followers saw, in their mount frames
    cg_offset: Float[Array, "..."] = NOT_RECORDED  # along the load's directions from O [m]
    object_mass: Float[Array, "..."] = NOT_RECORDED  # [kg]
    contact_force: Float[Array, "... drones 3"] = NOT_RECORDED  # of every drone on the carrier, body axes [N]
    contact_torque: Float[Array, "... drones 3"] = NOT_RECORDED  # likewise, about each drone's centre [N m]

    @classmethod
    def of(cls, plant: PlantState, time: Scalar, target: Vector, commands: TeamCommands, **others: Any) -> Trajectory:
        """The record of `plant`, any leading axes, at `time` with `target`, `commands` and `others` by name."""
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        motion = plant.position, plant.velocity, euler, plant.rates, plant.quaternion, plant.rotor_force
        return cls(time, *motion, *commands, target, **others)

    @property
    def _summary(self) -> str:
        several = f", {self.position.shape[1]} flights" if self.position.ndim > 2 else ""
        diverged = int(np.sum(self.diverged[-1]))
        lost = f", {diverged} diverged" if diverged else ""
        return f"{self.time[-1]:g} s, {len(self.time)} steps{several}{lost}"

    def __repr__(self) -> str:
        return f"<Trajectory {self._summary}>"

    def _repr_html_(self) -> str:
        """For notebooks: the error over time, of several flights its length."""
        if self.position.ndim == 2:
            lines = [pictures.Curve(f"error along {'xyz'[axis]}", self.time, self.error[:, axis]) for axis in range(3)]
        else:
            far = np.linalg.norm(self.error, axis=-1)
            lines = [pictures.Curve(f"flight {number}", self.time, far[:, number]) for number in range(far.shape[1])][
                :4
            ]
        return pictures.summary("flight", {"of": self._summary}, pictures.curves(lines, "time [s]", "error [m]"))

    @property
    def error(self) -> Float[Array, "T ... 3"]:
        """e_o = target - position [m]."""
        return self.target - self.position

    @property
    def goal(self) -> Float[Array, "... 3"]:
        """Goal of O at the end, the last one of a sequence of waypoints [m]."""
        return self.target[-1]

    def row(self, number: Any) -> Trajectory:
        """Control step `number`, without the axis of the steps; or the steps of an array of numbers."""
        return Trajectory(*(None if value is None else value[number] for value in self))

    def batched(self) -> Trajectory:
        """A single flight as a batch of one."""
        return self._each(lambda value: np.expand_dims(value, 1))

    def world(self, index: int) -> Trajectory:
        """Flight `index` of a batch."""
        return self._each(lambda value: value[:, index])

    def _each(self, change: Callable[[np.ndarray], np.ndarray]) -> Trajectory:
        """The same with `change` of every array but the time."""
        return Trajectory(self.time, *(None if value is None else change(value) for value in self[1:]))
