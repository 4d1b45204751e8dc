"""The closed loop of one control step, for every simulation: sensors, leader and follower, physics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.observation import OWN_STATE
from mjxball.physics.engine import has_diverged
from mjxball.physics.mounts import own_motion
from mjxball.sim.controllers import Body, Controllers, relative_to_goal
from mjxball.sim.sensors import EXACT, SensorSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Load, PlantState, Vector
    from mjxball.physics.step import PlantStep
    from mjxball.plant import PlantParameters
    from mjxball.sim.controllers import Observation
    from mjxball.sim.goals import Goal
    from mjxball.sim.sensors import Sample, SensorModel

    FollowerCommand = Float[Array, "... 3"]  # of several followers (..., F, 3)


class TeamCommands(NamedTuple):
    """Commands of all drones: roll, pitch [rad], vertical acceleration [m/s2], in body axes."""

    leader: Vector
    follower: FollowerCommand


class LoopState(NamedTuple):
    """State of the closed loop between control steps, any batch shape."""

    plant: PlantState
    integral: Vector
    sensors: Any  # `SensorState`; () without sensor errors
    diverged: Bool[Array, "..."]  # where true, `plant` no longer changes
    commands: Any = ()  # (..., N, 3) of all drones in the last period; () unless commands come late


class ClosedLoop(Controllers):
    """Controllers with sensors and physics: call `start`, then `step` repeatedly; shapes as in `Controllers`."""

    def __init__(
        self,
        config: Config,
        plant_step: PlantStep,
        sensors: SensorModel,
        parameters: PlantParameters | None = None,
        jitters: bool = False,
    ):
        super().__init__(config, parameters)
        self._plant_step, self._sensors, self._jitters = plant_step, sensors, jitters
        self.period, self._count = config.timing.control_period, config.plant.count
        self._yaw = np.array([drone.yaw for drone in config.plant.drones])
        self._leader_measures = config.scenario.leader_uses_measurements

    def start(
        self,
        plant: PlantState,
        goal: Goal,
        load: Load,
        sample: Sample,
        settings: SensorSettings = EXACT,
    ) -> tuple[LoopState, Observation]:
        """(state, observation) before the first step, with the plant in state `plant`.

        `goal` of O; `settings` of the sensors.
        """
        truth = self._truth(plant, goal, load)
        sensors: Any = ()
        if self._sensors.present:
            sensors, measured = self._sensors.start(self._measurable(truth), sample, settings)
            truth = self._observed(measured, goal)
        xp, batch = plant.position.__array_namespace__(), plant.position.shape[:-1]
        commands = xp.zeros((*batch, self._count, 3), dtype=plant.position.dtype) if self._jitters else ()
        return LoopState(plant, xp.zeros_like(plant.position), sensors, has_diverged(plant), commands), truth

    def step(
        self,
        state: LoopState,
        observation: Observation,
        follower: FollowerCommand,
        load: Load,
        goals: tuple[Goal, Goal],
        sample: Sample,
        plant_step: PlantStep | None = None,
    ) -> tuple[LoopState, Observation, TeamCommands]:
        """One control period: (state, observation at its end, commands).

        `follower` is the followers' answer to `observation`, in their mount frames. `goals` are those of O at the
        beginning and the end of the period. `load` includes the external force during the period; `sample` disturbs the
        measurement at its end. `plant_step` replaces the loop's own.
        """
        leader_sees, goal = self._leader_body(state, observation, goals[0]), goals[0].position
        leads = self.leader_command(leader_sees, goal, state.integral)
        commands = TeamCommands(leads, self.in_body_axes(follower))
        sent = self.stack(*commands)
        if load.late is not None:
            load = load._replace(last_commands=state.commands)
        plant = (plant_step or self._plant_step)(state.plant, sent, load)
        diverged = state.diverged | has_diverged(plant)
        if not (isinstance(diverged, np.ndarray | np.generic) and not diverged.any()):
            plant = state.plant.each(lambda old, new: _where(diverged, old, new), plant)
        integral = self.integrate(state.integral, leader_sees, goal, self.period)
        sensors, truth = state.sensors, self._truth(plant, goals[1], load)
        if self._sensors.present:
            sensors, measured = self._sensors.step(sensors, self._measurable(truth), sample)
            truth = self._observed(measured, goals[1])
        return LoopState(plant, integral, sensors, diverged, sent if self._jitters else ()), truth, commands

    def _truth(self, plant: PlantState, goal: Goal, load: Load) -> Observation:
        """The observation without disturbances but constant errors of the attitude.

        A drone on an elastic mount observes its own attitude and rates, and computes the object's error from them.
        """
        seen = self.observe(plant, goal.position, goal.rate)
        if plant.mount_angle is None and load.attitude_error is None:
            return seen
        own = None if plant.mount_angle is None else own_motion(plant, self._yaw)
        read = self.estimate(seen, own, load.attitude_error)
        return read if self._sensors.object_sensor else self.observe_by(read[..., :OWN_STATE], goal.position, goal.rate)

    def _measurable(self, truth: Observation) -> Array:
        """The part of `truth` that sensors measure."""
        return truth if self._sensors.object_sensor else truth[..., :OWN_STATE]

    def _observed(self, measured: Array, goal: Goal) -> Observation:
        return measured if self._sensors.object_sensor else self.observe_by(measured, goal.position, goal.rate)

    def _leader_body(self, state: LoopState, observation: Observation, goal: Goal) -> Body:
        """The body by its measurements, or the true one if `scenario.leader_uses_measurements` is off.

        Its velocity is that relative to the goal.
        """
        if self._leader_measures:
            return self.body_from_observation(observation, goal.position)
        return relative_to_goal(state.plant, goal.rate)


def _where(diverged: Bool[Array, "..."], old: Array, new: Array) -> Array:
    """`old` (..., k) where `diverged` (...), else `new`."""
    xp = new.__array_namespace__()
    return xp.where(xp.reshape(diverged, diverged.shape + (1,) * (new.ndim - diverged.ndim)), old, new)
