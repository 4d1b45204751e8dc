"""Any number of flights as one compiled program that keeps only their metrics: for batches no memory would hold."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball import rollout
from mjxball.cache import enable_compilation_cache
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.baselines.law import Law
from mjxball.control.followers import Baseline, Follower
from mjxball.errors import InputError
from mjxball.evaluate import metrics
from mjxball.evaluate.metrics import Metrics
from mjxball.physics import mjx, newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import make_control_step
from mjxball.physics.stepper import TRAINING_ENGINES
from mjxball.policy import Policy
from mjxball.policy.policy import NetworkLaw
from mjxball.scenario import Scenario, check_scenario
from mjxball.sensing import Senses
from mjxball.wiring import Wiring

Array = Any


class Carry(NamedTuple):
    """What flies on from step to step."""

    plant: PlantState
    integral: Array  # (n, 3) of the leader's error [m s]
    follower: Any
    senses: Any
    diverged: Array  # (n,)
    tally: metrics.Tally


class Draws(NamedTuple):
    """What happens at each control step, (count + 1, ...)."""

    number: Array
    target: Array  # (count + 1, n, 3)
    noise: Array | None
    arrives: Array | None
    push: Array | None


class Batch:
    """One follower and one configuration, for `n` flights of one length. `fly` compiles at its first call."""

    def __init__(self, config: Config, follower: Follower, physics: str = "newton-euler"):
        if physics not in TRAINING_ENGINES:
            raise InputError(f"batches fly on {' or '.join(TRAINING_ENGINES)}, not on {physics}")
        enable_compilation_cache()
        self._config, self._law = config, law_of(follower)
        make = mjx.make_engine if physics == "mjx" else newton_euler.make_engine
        step = make_control_step(config, make(config.plant, config.attitude), mjx.jax_repeat)
        self._step = jax.vmap(step)
        self._brief = rollout.make_brief(config)
        self._wiring = Wiring(config)
        self._compiled: dict[Any, Any] = {}

    def fly(self, scenarios: Sequence[Scenario]) -> list[Metrics]:
        """Metrics of every flight, computed in float32."""
        for scenario in scenarios:
            check_scenario(self._config, scenario)
        if len({scenario.seconds for scenario in scenarios}) != 1:
            raise InputError("scenarios of one batch must last equally long")
        period = self._config.timing.control_period
        count = round(scenarios[0].seconds / period)
        senses = Senses([scenario.disturbance for scenario in scenarios], count, period)
        single = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf, _single(leaf)), tree)  # noqa: E731
        load, start = single((rollout.load_of(scenarios), rollout.start_of(self._config, scenarios)))
        target = rollout.targets(scenarios, count, period)
        draws = single(Draws(np.arange(count + 1), target, senses.noise, senses.arrives, senses.pushes))
        with jax.default_matmul_precision("highest"):
            tally = self._program(senses)(start, load, draws)
        return metrics.results(tally)

    def _program(self, senses: Senses) -> Any:
        """The compiled flight; delays and biases are constants in it, everything else is given to it."""
        key = (senses.delays.tobytes(), senses.bias.tobytes())
        if key not in self._compiled:
            self._compiled[key] = jax.jit(lambda *parts: self._all(senses, *parts))
        return self._compiled[key]

    def _all(self, senses: Senses, start: PlantState, load: Load, draws: Draws) -> metrics.Tally:
        seen = self._wiring.observe(start, draws.target[0])
        noise, arrives = (None if t is None else t[0] for t in (draws.noise, draws.arrives))
        memory = senses.start(seen)
        _, first = senses.step(memory, jnp.zeros((), jnp.int32), seen, noise, arrives)
        carry = Carry(
            plant=start,
            integral=jnp.zeros_like(start.position),
            follower=self._law.start(first),
            senses=memory,
            diverged=jnp.zeros(len(start.position), bool),
            tally=metrics.begin(start.position, draws.target[0], start.rotor_force),
        )
        return jax.lax.scan(lambda c, d: (self._tick(senses, load, c, d), None), carry, draws)[0].tally

    def _tick(self, senses: Senses, load: Load, carry: Carry, draws: Draws) -> Carry:
        config, plant, goal = self._config, carry.plant, draws.target
        period = config.timing.control_period
        seen = self._wiring.observe(plant, goal)
        memory, seen = senses.step(carry.senses, draws.number, seen, draws.noise, draws.arrives)
        led = self._wiring.leader_command(plant, goal, carry.integral)
        follower, command = self._law.step(carry.follower, seen, self._brief(plant, load))
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        time = draws.number * jnp.float32(period)
        flown = (time, plant.position, goal, euler, plant.rotor_force, led, command, carry.diverged)
        limits = (config.scenario.termination_distance, config.plant.rotor_force_max)
        tally = metrics.update(carry.tally, rollout.Tick(*flown), *limits)
        moved = self._step(plant, jnp.stack([led, command], axis=1), load._replace(push=draws.push))
        diverged = carry.diverged | rollout.has_diverged(moved)
        return Carry(
            plant=plant.each(functools.partial(rollout.keep, diverged), moved),
            integral=self._wiring.integrated(carry.integral, plant, goal, period),
            follower=follower,
            senses=memory,
            diverged=diverged,
            tally=tally,
        )


def law_of(follower: Follower) -> Law:
    """The pure functions of a follower; raise InputError if it has none."""
    if isinstance(follower, Baseline):
        return follower.law
    if isinstance(follower, Policy):
        return NetworkLaw(follower)
    raise InputError(f"follower {follower.name!r} is no baseline and no policy; batches cannot fly it")


def _single(leaf: Any) -> Any:
    kind = np.asarray(leaf).dtype
    return np.float32 if kind == np.float64 else kind
