"""Followers on random rigs: many rigs at once, each with its own numbers, and controllers that know them."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.config import Config, Plant
from mjxball.control.followers import Controller, PrivilegedInfo
from mjxball.control.geometry import team_geometry
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.env import TransportEnv
from mjxball.evaluate.metrics import Metrics, results
from mjxball.evaluate.running_metrics import RunningMetrics, begin, update
from mjxball.physics.engine import PlantState
from mjxball.physics.motion import object_mass
from mjxball.physics.step import make_jax_plant_step
from mjxball.plant import PlantParameters
from mjxball.policy.inference import NetworkController
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.disturbances import RandomDisturbances
from mjxball.sim.rigs import RigTable, rig_config, whole
from mjxball.sim.rollout import Carry, Inputs, control_step

SECONDS = 30.0  # of a flight


def fly_random_rigs(
    config: Config,
    rigs: RigTable,
    controllers: Controller | Sequence[Controller],
    flights: int = 3,
    seconds: float = SECONDS,
    seed: int = 0,
) -> list[list[Metrics]]:
    """Metrics of `flights` random flights of every rig (R) of one size, the same ones for every follower.

    `controllers`: one for all rigs, or R of one class, each made for its rig. In float32 on JAX's default device.
    """
    one_rig = dataclasses.replace(config.rigs, number=1)
    # Of its plant only the number of drones counts, and its attitude loops are those of the preset's own controller.
    own = dataclasses.replace(rig_config(config, rigs, 0), attitude=config.attitude, rigs=one_rig)
    env, period = TransportEnv(own, "newton-euler"), own.timing.control_period
    numbers: list[Any] | None = None
    if isinstance(controllers, Sequence):
        numbers, rebuild = stacked(controllers)
    else:
        alike: Controller = controllers
        rebuild = lambda _: alike  # noqa: E731
    times = period * np.arange(round(seconds / period) + 1, dtype=np.float32)

    def rig_flights(rig: RigTable, numbers: Any, keys: Any) -> RunningMetrics:
        return jax.vmap(lambda key: _flight(env, key, rig, rebuild(numbers), times))(keys)

    keys = jax.random.split(jax.random.key(seed), (rigs.total, flights))
    single = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), (rigs, numbers))
    running = jax.jit(jax.vmap(rig_flights))(*single, keys)
    # (R, K, 1, ...), or (R, K) of what all flights of a batch share.
    found = results(jax.tree.map(lambda part: part.reshape(-1, *part.shape[3:]), running))
    return [found[first : first + flights] for first in range(0, len(found), flights)]


def _flight(env: TransportEnv, key: Any, rig: RigTable, controller: Controller, times: np.ndarray) -> RunningMetrics:
    """One flight of `rig` from a random start of `env`, over `times` [s], as a batch of one."""
    config, state = env.config, env.reset(key, None, rig)
    world, observation = state.pipeline_state, state.obs[..., :OBSERVATION_SIZE]
    disturbances, parameters = RandomDisturbances(config), whole(world.parameters, config.plant.gravity)
    physics = make_jax_plant_step(config, "newton-euler", parameters)
    loop = ClosedLoop(config, physics, disturbances.sensors, parameters)
    limit, leader = config.scenario.termination_distance, config.plant.leader
    if isinstance(controller, AnyRigController):
        controller = controller.on(rig, config.plant)

    def privileged(plant: PlantState, load: Any) -> PrivilegedInfo:
        return _privileged(plant, load, world.parameters, config.plant.count)

    def step(carried: tuple[Carry, Any, RunningMetrics], time: Any) -> Any:
        carry, random, running = carried
        force = random.force if disturbances.present else None
        random, sample = disturbances.step(random)
        inputs, plant = Inputs(time, world.goal, world.goal, force, sample), carry.loop.plant
        carry, row = control_step(loop, controller, privileged, world.load, carry, inputs, 0.0)
        most = rig.parameters.rotor_force_max * rig.thrust * (1.0 - rig.thrust_fade * plant.time)
        row = jax.tree.map(lambda part: part[None], row)._replace(time=time)
        return (carry, random, update(running, row, limit, most, leader)), None

    plant = world.loop.plant
    running = begin(plant.position[None], world.goal[None], plant.rotor_force[None], leader)
    carry = Carry(world.loop, observation, controller.start(observation))
    return jax.lax.scan(step, (carry, world.disturbances, running), times)[0][2]


class AnyRigController(NetworkController):
    """A policy for any rig, which is given every rig's geometry."""

    def on(self, rig: RigTable, plant: Plant) -> AnyRigController:
        """The controller of the followers of `rig`, drones like those of `plant`."""
        found = copy.copy(self)
        found._geometry = team_geometry(plant, rig.parameters.mounts, rig.size)
        return found


def rig_controllers(config: Config, rigs: RigTable, make: Callable[[Config], Controller]) -> list[Controller]:
    """`make` of every rig's own configuration."""
    return [make(rig_config(config, rigs, row)) for row in range(rigs.total)]


def stacked(controllers: Sequence[Controller]) -> tuple[list[Any], Callable[[list[Any]], Controller]]:
    """(the numbers of `controllers` of one class, stacked; a controller from one row of them)."""
    example, structure = jax.tree.flatten(vars(controllers[0]))
    varies = [isinstance(leaf, (float, np.ndarray, np.floating)) for leaf in example]
    rows = [jax.tree.leaves(vars(controller)) for controller in controllers]
    numbers = [np.stack([row[place] for row in rows]) for place, differs in enumerate(varies) if differs]

    def rebuild(row: list[Any]) -> Controller:
        found, values = copy.copy(controllers[0]), iter(row)
        leaves = [next(values) if differs else leaf for leaf, differs in zip(example, varies, strict=True)]
        vars(found).update(jax.tree.unflatten(structure, leaves))
        return found

    return numbers, rebuild


def _privileged(plant: PlantState, load: Any, rig: PlantParameters, size: int) -> PrivilegedInfo:
    """What a classical follower may know of its world; nothing of where the CG is."""
    mass = object_mass(plant.time, load)
    thrust = load.thrust_scale
    if load.thrust_fade is not None:
        thrust = thrust * (1.0 - load.thrust_fade * plant.time)
    total = rig.drone_mass.sum() + rig.carrier_mass + mass
    zero = jnp.zeros(2)
    known = PrivilegedInfo(load.believed_mass, zero, zero, total, thrust)
    if size == 2:
        return known
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (size - 1, *part.shape)), known)
