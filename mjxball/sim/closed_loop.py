"""The closed loop of one control step: sensors, leader and follower, physics; every simulation calls it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.physics.engine import has_diverged
from mjxball.sim.laws import Body, Laws

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from mjxball.physics.engine import Array, Load, PlantState, Scalar, Vector
    from mjxball.physics.step import ControlStep
    from mjxball.sim.disturbances import Observation, Sample, SensorModel, SensorState
    from mjxball.sim.laws import Integral


class Commands(NamedTuple):
    """What both drones are sent: roll, pitch [rad], vertical acceleration [m/s2]."""

    leader: Vector
    follower: Vector


class LoopState(NamedTuple):
    """What the closed loop carries from step to step, any batch shape."""

    plant: PlantState
    integral: Integral
    sensors: SensorState
    diverged: Bool[Array, "..."]  # a plant that diverged stays as it was


class ClosedLoop(Laws):
    """The laws with sensors and physics: `start`, then `step`, which is `commands`, the physics and `after_physics`."""

    def __init__(self, config: Config, physics: ControlStep, sensors: SensorModel):
        super().__init__(config)
        self.physics, self._sensors = physics, sensors
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
        """(state, observation) before the first step at `plant`; `integral`: None for none yet.

        `goal` of O [m]; `delay` (...) of the measurements in control steps.
        """
        sensors, observation = self._sensors.start(self.observe(plant, goal), sample, delay)
        integral = self.zero_integral(plant.position) if integral is None else integral
        return LoopState(plant, integral, sensors, has_diverged(plant)), observation

    def step(
        self,
        state: LoopState,
        observation: Observation,
        follower: Vector,
        load: Load,
        goals: tuple[Vector, Vector],
        sample: Sample,
        shares: Scalar | float = 1.0,
    ) -> tuple[LoopState, Observation, Commands]:
        """One control period: (state, observation at its end, commands); arguments as of its three parts.

        `goals`: of O at its beginning and at its end [m]. `load` with the external force that acts in it.
        """
        commands = self.commands(state, observation, follower, goals[0], shares)
        plant = self.physics(state.plant, self.stack(commands), load)
        return *self.after_physics(state, observation, commands, plant, goals, sample, shares), commands

    @staticmethod
    def stack(commands: Commands) -> Float[Array, "... 2 3"]:
        """Both commands as the physics takes them (..., 2, 3)."""
        return commands.leader.__array_namespace__().stack(commands, axis=-2)

    def commands(
        self, state: LoopState, observation: Observation, follower: Vector, goal: Vector, shares: Scalar | float = 1.0
    ) -> Commands:
        """Both commands at `observation`, which the follower's law answers with `follower`.

        `shares` (...): 1 for a follower that shares the integrals, a network; 0 for one with a law of its own.
        """
        leader_command = self.leader_command(self._leader_sees(state, observation, goal), goal, state.integral)
        if not self._shares:
            return Commands(leader_command, follower)
        xp, shares = leader_command.__array_namespace__(), np.asarray(shares)
        return Commands(
            leader_command, xp.where(shares[..., None] > 0, self.follower_command(follower, state.integral), follower)
        )

    def after_physics(
        self,
        state: LoopState,
        observation: Observation,
        commands: Commands,
        plant: PlantState,
        goals: tuple[Vector, Vector],
        sample: Sample,
        shares: Scalar | float = 1.0,
    ) -> tuple[LoopState, Observation]:
        """(state, observation) once the physics has brought the plant of `state` to `plant`."""
        diverged = state.diverged | has_diverged(plant)
        plant = state.plant.each(lambda old, new: _where(diverged, old, new), plant)
        measured = self._leader_sees(state, observation, goals[0])
        shares = np.asarray(shares)[..., None]
        integral = self.integrate(state.integral, measured, goals[0], self._period, shares, commands.follower)
        sensors, observation = self._sensors.step(state.sensors, self.observe(plant, goals[1]), sample)
        return LoopState(plant, integral, sensors, diverged), observation

    def _leader_sees(self, state: LoopState, observation: Observation, goal: Vector) -> Body:
        return self.body_from_observation(observation, goal) if self._leader_measures else state.plant


def _where(diverged: Bool[Array, "..."], old: Array, new: Array) -> Array:
    """`old` (..., k) where `diverged` (...), else `new`."""
    xp = new.__array_namespace__()
    return xp.where(xp.reshape(diverged, diverged.shape + (1,) * (new.ndim - diverged.ndim)), old, new)
