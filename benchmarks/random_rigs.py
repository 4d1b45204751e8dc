"""Followers on random rigs: many rigs at once, each with its own numbers, and laws that know them."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.config import Config, Plant
from mjxball.control.followers import Law, PrivilegedInfo
from mjxball.control.geometry import team_geometry
from mjxball.env import PipelineState, State, TransportEnv
from mjxball.evaluate.metrics import AT_LIMIT_WITHIN, SETTLED, STEADY_AFTER, near_limit, power_of
from mjxball.physics.motion import object_mass
from mjxball.policy.inference import NetworkLaw
from mjxball.sim.rigs import RigTable, rig_config

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

SECONDS = 30.0  # of a flight


class Effort(NamedTuple):
    """What flights of R rigs, K each, cost; all (R, K)."""

    at_limit: Any  # share of the steps in which any rotor is within 1 % of 0 or of its largest force
    tilt_spread: Any  # rms of the followers' roll and pitch less their mean; 0 of a pair [rad]
    lift_spread: Any  # of their vertical command [m/s2]
    power: Any  # mean of sum F^1.5 over all rotors, over that of rotors which share the weight evenly


class Flown(NamedTuple):
    """Flights of R rigs, K each."""

    error: Float[np.ndarray, "R K T"]  # |e_o| at every control step, the start first [m]
    failed: Bool[np.ndarray, "R K"]  # it left scenario.termination_distance, or diverged
    effort: Effort | None = None

    def settling(self, period: float) -> Float[np.ndarray, "R K"]:
        """Last time at which the error exceeds 2 % of the first one [s]; inf: it never settles."""
        late = self.error > SETTLED[0] * self.error[..., :1]
        last = self.error.shape[-1] - 1 - late[..., ::-1].argmax(axis=-1)
        return np.where(self.failed | (last > self.error.shape[-1] - 6), np.inf, period * last)

    def peak(self, period: float) -> Float[np.ndarray, "R K"]:
        """Largest error after 20 s [m]; inf of a flight that failed."""
        return np.where(self.failed, np.inf, self.error[..., round(STEADY_AFTER / period) :].max(axis=-1))


def fly(
    config: Config,
    rigs: RigTable,
    laws: Law | Sequence[Law],
    flights: int = 3,
    seconds: float = SECONDS,
    seed: int = 0,
) -> Flown:
    """Fly `flights` random flights of every rig (R) of one size, the same ones for every follower.

    `laws`: one for all rigs, or R of one class, each made for its rig. In float32 on JAX's default device.
    """
    size, one_rig = int(rigs.size[0]), dataclasses.replace(config.rigs, number=1)
    # Of its plant only the number of drones counts, and its attitude loops are those of the preset's own law.
    own = dataclasses.replace(rig_config(config, rigs, 0), attitude=config.attitude, rigs=one_rig)
    env = TransportEnv(own, "newton-euler")
    numbers: list[Any] | None = None
    if isinstance(laws, Sequence):
        numbers, rebuild = stacked(laws)
    else:
        alike: Law = laws
        rebuild = lambda _: alike  # noqa: E731
    steps = round(seconds / env.dt)

    def flight(key: Any, rig: RigTable, law: Law) -> Any:
        state = env.reset(key, None, rig)

        def step(carry: tuple[State, Any, Any, Any], _: Any) -> Any:
            state, memory, far, effort = carry
            world = state.pipeline_state
            error = jnp.linalg.norm(world.goal - world.loop.plant.position)
            far = far | (error > config.scenario.termination_distance) | world.loop.diverged
            memory, command = law.step(memory, state.obs[..., :18], _privileged(world, size))
            state = env.step_with_command(state, command)
            effort = jax.tree.map(jnp.add, effort, _effort(state.pipeline_state, command, rig, own.plant.gravity))
            return (state, memory, far, effort), error

        if isinstance(law, AnyRigLaw):
            law = law.on(rig, own.plant)
        nothing = Effort(*(jnp.zeros(()) for _ in Effort._fields))
        start = (state, law.start(state.obs[..., :18]), jnp.zeros((), bool), nothing)
        (_, _, far, effort), error = jax.lax.scan(step, start, None, steps + 1)
        mean = jax.tree.map(lambda total: total / (steps + 1), effort)
        return error, far, mean._replace(tilt_spread=jnp.sqrt(mean.tilt_spread), lift_spread=jnp.sqrt(mean.lift_spread))

    def rig_flights(rig: RigTable, numbers: Any, keys: Any) -> Any:
        return jax.vmap(lambda key: flight(key, rig, rebuild(numbers)))(keys)

    keys = jax.random.split(jax.random.key(seed), (rigs.total, flights))
    single = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), (rigs, numbers))
    error, failed, effort = jax.tree.map(np.asarray, jax.jit(jax.vmap(rig_flights))(*single, keys))
    return Flown(error, failed, effort)


def _effort(world: PipelineState, command: Any, rig: RigTable, gravity: float) -> Effort:
    """Of one step, squares in place of roots; `command` (3,) or (followers, 3)."""
    size = len(rig.numbers.mounts)
    force = world.loop.plant.rotor_force
    fade = 1.0 - rig.thrust_fade * world.loop.plant.time
    most = (rig.numbers.rotor_force_max * rig.thrust * fade)[:, None]
    weight = gravity * (rig.numbers.drone_mass.sum() + rig.numbers.carrier_mass + rig.object_mass)
    even = power_of(jnp.broadcast_to(weight / (4 * size), force.shape))
    apart = jnp.atleast_2d(command)
    apart = (apart - apart.mean(axis=0)) ** 2
    return Effort(
        at_limit=near_limit(AT_LIMIT_WITHIN, force, most).max(),
        tilt_spread=apart[:, :2].mean(),
        lift_spread=apart[:, 2].mean(),
        power=power_of(force) / even,
    )


class AnyRigLaw(NetworkLaw):
    """A policy for any rig, which is told every rig's geometry."""

    def on(self, rig: RigTable, plant: Plant) -> AnyRigLaw:
        """The law of the followers of `rig`, drones like those of `plant`."""
        found = copy.copy(self)
        found._geometry = team_geometry(plant, rig.numbers.mounts, rig.size)
        return found


def rig_laws(config: Config, rigs: RigTable, make: Callable[[Config], Law]) -> list[Law]:
    """`make` of every rig's own configuration."""
    return [make(rig_config(config, rigs, row)) for row in range(rigs.total)]


def stacked(laws: Sequence[Law]) -> tuple[list[Any], Callable[[list[Any]], Law]]:
    """(the numbers of `laws` of one class, stacked; a law from one row of them)."""
    example, structure = jax.tree.flatten(vars(laws[0]))
    varies = [isinstance(leaf, (float, np.ndarray, np.floating)) for leaf in example]
    rows = [jax.tree.leaves(vars(law)) for law in laws]
    numbers = [np.stack([row[place] for row in rows]) for place, drawn in enumerate(varies) if drawn]

    def rebuild(row: list[Any]) -> Law:
        found, values = copy.copy(laws[0]), iter(row)
        leaves = [next(values) if drawn else leaf for leaf, drawn in zip(example, varies, strict=True)]
        vars(found).update(jax.tree.unflatten(structure, leaves))
        return found

    return numbers, rebuild


def _privileged(world: PipelineState, size: int) -> PrivilegedInfo:
    """What a classical follower may know of its world; nothing of where the CG is."""
    load: Any = world.load
    mass = object_mass(world.loop.plant.time, load)
    thrust = load.thrust_scale
    if load.thrust_fade is not None:
        thrust = thrust * (1.0 - load.thrust_fade * world.loop.plant.time)
    total = world.rig.drone_mass.sum() + world.rig.carrier_mass + mass
    zero = jnp.zeros(2)
    known = PrivilegedInfo(load.believed_mass, zero, zero, total, thrust)
    if size == 2:
        return known
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (size - 1, *part.shape)), known)
