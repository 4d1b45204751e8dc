"""The closed loop of one control step, for every simulation: sensors, leader and follower, physics."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.physics.engine import has_diverged
from mjxball.sim.controllers import Body, Controllers

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from mjxball.arrays import Array
    from mjxball.physics.engine import Load, PlantState, Scalar, Vector
    from mjxball.physics.step import PlantStep
    from mjxball.plant import PlantParameters
    from mjxball.sim.controllers import Integral
    from mjxball.sim.disturbances import Observation, Sample, SensorModel, SensorState

    FollowerCommand = Float[Array, "... 3"]  # of several followers (..., F, 3)


class TeamCommands(NamedTuple):
    """Commands of all drones: roll, pitch [rad], vertical acceleration [m/s2], in body axes."""

    leader: Vector
    follower: FollowerCommand


class LoopState(NamedTuple):
    """State of the closed loop between control steps, any batch shape."""

    plant: PlantState
    integral: Integral
    sensors: SensorState
    diverged: Bool[Array, "..."]  # where true, `plant` no longer changes


class ClosedLoop(Controllers):
    """Controllers with sensors and physics: call `start`, then `step` repeatedly; shapes as in `Controllers`."""

    def __init__(
        self, config: Config, plant_step: PlantStep, sensors: SensorModel, parameters: PlantParameters | None = None
    ):
        super().__init__(config, parameters)
        self._plant_step, self._sensors = plant_step, sensors
        self._period = config.timing.control_period
        self._leader_measures = config.scenario.leader_uses_measurements

    def start(
        self,
        plant: PlantState,
        goal: Vector,
        sample: Sample,
        delay: Int[Array, "..."] | int = 0,
        integral: Integral | None = None,
    ) -> tuple[LoopState, Observation]:
        """(state, observation) before the first step, with the plant in state `plant`; `integral` None: zero.

        `goal` of O [m]; `delay` (...) of the measurements in control steps.
        """
        sensors, observation = self._sensors.start(self.observe(plant, goal), sample, delay)
        integral = self.zero_integral(plant.position) if integral is None else integral
        return LoopState(plant, integral, sensors, has_diverged(plant)), observation

    def step(
        self,
        state: LoopState,
        observation: Observation,
        follower: FollowerCommand,
        load: Load,
        goals: tuple[Vector, Vector],
        sample: Sample,
        on_pid: Scalar | float = 1.0,
        plant_step: PlantStep | None = None,
    ) -> tuple[LoopState, Observation, TeamCommands]:
        """One control period: (state, observation at its end, commands).

        `follower` is the followers' answer to `observation`, in their mount frames. `goals` are those of O at the
        beginning and the end of the period [m]. `load` includes the external force during the period; `sample` disturbs
        the measurement at its end. `on_pid` (...) is 1 for a network to whose command the integral terms are added
        (`follower.residual_on_pid`), 0 for a follower whose command is complete. `plant_step` replaces the loop's own.
        """
        leader_sees = self._leader_body(state, observation, goals[0])
        commands = self._commands(leader_sees, state.integral, follower, goals[0], on_pid)
        plant = (plant_step or self._plant_step)(state.plant, self.stack(*commands), load)
        diverged = state.diverged | has_diverged(plant)
        if not (isinstance(diverged, np.ndarray | np.generic) and not diverged.any()):
            plant = state.plant.each(lambda old, new: _where(diverged, old, new), plant)
        on_pid = np.asarray(on_pid)[..., None]
        integral = self.integrate(state.integral, leader_sees, goals[0], self._period, on_pid, commands.follower)
        sensors, observation = self._sensors.step(state.sensors, self.observe(plant, goals[1]), sample)
        return LoopState(plant, integral, sensors, diverged), observation, commands

    def _commands(
        self, leader_sees: Body, integral: Integral, follower: FollowerCommand, goal: Vector, on_pid: Scalar | float
    ) -> TeamCommands:
        leader_command = self.leader_command(leader_sees, goal, integral)
        follower = self.in_body_axes(follower)
        if not self._on_pid:
            return TeamCommands(leader_command, follower)
        xp, on_pid = leader_command.__array_namespace__(), np.asarray(on_pid)
        return TeamCommands(
            leader_command, xp.where(on_pid[..., None] > 0, self.follower_command(follower, integral), follower)
        )

    def _leader_body(self, state: LoopState, observation: Observation, goal: Vector) -> Body:
        """The body by its measurements, or the true one if `scenario.leader_uses_measurements` is off."""
        return self.body_from_observation(observation, goal) if self._leader_measures else state.plant


def _where(diverged: Bool[Array, "..."], old: Array, new: Array) -> Array:
    """`old` (..., k) where `diverged` (...), else `new`."""
    xp = new.__array_namespace__()
    return xp.where(xp.reshape(diverged, diverged.shape + (1,) * (new.ndim - diverged.ndim)), old, new)
