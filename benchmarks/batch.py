"""Any number of flights as one compiled program: only their metrics, for batches no memory would hold, or `Course`s."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.followers import Baseline, Follower, Law
from mjxball.errors import InputError
from mjxball.evaluate import metrics
from mjxball.evaluate.metrics import Metrics
from mjxball.physics import mjx, newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import TRAINING_ENGINES, jax_repeat, make_cg_offset, make_control_step
from mjxball.policy import Policy
from mjxball.policy.inference import NetworkLaw
from mjxball.scalar_form import scalar_form
from mjxball.sim import rollout
from mjxball.sim.closed_loop import ClosedLoop, LoopState
from mjxball.sim.disturbances import Sample, SensorModel, followers_axis, record, sensors_of
from mjxball.sim.scenario import Scenario, check_scenario
from mjxball.xla import enable_compilation_cache

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Carry(NamedTuple):
    """What flies on from step to step."""

    loop: LoopState
    observation: Float[Array, "n 18"]
    follower: Any
    running: metrics.RunningMetrics


class Inputs(NamedTuple):
    """What is given to each control step."""

    number: Int[Array, "..."]
    goals: tuple[Float[Array, "... n 3"], Float[Array, "... n 3"]]  # of O at its beginning and at its end [m]
    force: Float[Array, "... n 3"] | None  # external force on O in it [N]
    sample: Sample  # of the measurement at its end


class Course(NamedTuple):
    """What `n` flights did, row by row from the start, in float32."""

    time: Float[np.ndarray, " rows"]  # [s]
    error: Float[np.ndarray, "rows n 3"]  # goal less place of O [m]
    velocity: Float[np.ndarray, "rows n 3"]  # of O [m/s]
    euler: Float[np.ndarray, "rows n 3"]  # [rad]
    cg_offset: Float[np.ndarray, "rows n ..."]  # [m]
    diverged: Bool[np.ndarray, " n"]


class Batch:
    """One follower and one configuration, for `n` flights of one length. Each method compiles at its first call."""

    def __init__(self, config: Config, follower: Follower, physics: str = "newton-euler"):
        if physics not in TRAINING_ENGINES:
            raise InputError(f"batches fly on {' or '.join(TRAINING_ENGINES)}, not on {physics}")
        enable_compilation_cache()
        self._config, self._law = config, law_of(follower)
        make = mjx.make_engine if physics == "mjx" else newton_euler.make_engine
        step = make_control_step(config, make(config.plant, config.attitude), jax_repeat)
        # Half of the time for hundreds of worlds; MJX and the cascade of a Crazyflie gain nothing, and compile longer.
        rewritten = physics == "newton-euler" and config.autopilot.kind == "ideal"
        self._physics = (scalar_form if rewritten else jax.vmap)(step)
        self._privileged = rollout.make_privileged_info(config)
        self._offset = make_cg_offset(config)
        self._on_pid = np.float32(not isinstance(follower, Baseline))
        self._compiled: dict[Any, Any] = {}

    def fly(self, scenarios: Sequence[Scenario]) -> list[Metrics]:
        """Metrics of every flight, computed in float32."""
        return metrics.results(self._run(scenarios, False)[0])

    def course(self, scenarios: Sequence[Scenario]) -> Course:
        """Every step of every flight."""
        rows = self._run(scenarios, True)[1]
        error, velocity, euler, offset, diverged = (np.asarray(part) for part in rows)
        time = np.arange(len(error)) * self._config.timing.control_period
        return Course(time, error, velocity, euler, offset, diverged[-1])

    def _run(self, scenarios: Sequence[Scenario], keeps: bool) -> Any:
        """(metrics, rows of `Course` or None)."""
        scenarios = [check_scenario(self._config, scenario) for scenario in scenarios]
        if len({scenario.seconds for scenario in scenarios}) != 1:
            raise InputError("scenarios of one batch must last equally long")
        period = self._config.timing.control_period
        count = round(scenarios[0].seconds / period)
        disturbances = [scenario.disturbance for scenario in scenarios]
        followers = followers_axis(self._config)
        sensors, delays = sensors_of(disturbances, period, followers)
        single = lambda tree: jax.tree.map(lambda leaf: np.asarray(leaf, _single(leaf)), tree)  # noqa: E731
        flown = rollout.load_of(self._config, scenarios), rollout.start_of(self._config, scenarios)
        load, start = single(flown)
        most = single(metrics.rotor_limits(self._config.plant, scenarios))
        goals, samples = single(
            (rollout.targets(self._config, scenarios, count + 1), record(disturbances, count + 2, period, followers))
        )
        force, later = samples.at(slice(count + 1)).force, samples.at(slice(1, None))
        inputs = Inputs(
            np.arange(count + 1, dtype=np.int32), (goals[:-1], goals[1:]), force, later._replace(force=None)
        )
        return self._program(sensors, delays, keeps)(start, load, most, goals[0], samples.at(0), inputs)

    def _program(self, sensors: SensorModel, delays: np.ndarray, keeps: bool) -> Any:
        """The compiled flight; delays, biases and resolutions are constants in it, everything else is given to it."""
        bias = None if sensors.relay_bias is None else sensors.relay_bias.tobytes()
        key = (delays.tobytes(), bias, np.asarray(sensors.quantized).tobytes(), keeps)
        if key not in self._compiled:
            loop = ClosedLoop(self._config, self._physics, sensors)
            self._compiled[key] = jax.jit(lambda *parts: self._all(loop, delays, keeps, *parts))
        return self._compiled[key]

    def _all(
        self,
        loop: ClosedLoop,
        delays: Int[Array, " n"],
        keeps: bool,
        start: PlantState,
        load: Load,
        most: Float[Array, "n drones"],
        goal: Float[Array, "n 3"],
        first: Sample,
        inputs: Inputs,
    ) -> tuple[metrics.RunningMetrics, Any]:
        state, observation = loop.start(start, goal, first, delays)
        running = metrics.begin(start.position, goal, start.rotor_force, self._config.plant.leader)
        carry = Carry(state, observation, self._law.start(observation), running)

        def step(carry: Carry, inputs: Inputs) -> tuple[Carry, Any]:
            return self._step(loop, load, most, carry, inputs), self._seen(carry, load, inputs) if keeps else None

        last, rows = jax.lax.scan(step, carry, inputs)
        return last.running, rows

    def _seen(self, carry: Carry, load: Load, inputs: Inputs) -> tuple[Array, ...]:
        plant = carry.loop.plant
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        offset = self._offset(plant, load)
        return inputs.goals[0] - plant.position, plant.velocity, euler, offset, carry.loop.diverged

    def _step(
        self, loop: ClosedLoop, load: Load, most: Float[Array, "n drones"], carry: Carry, inputs: Inputs
    ) -> Carry:
        config, state, observation = self._config, carry.loop, carry.observation
        plant, goals = state.plant, inputs.goals
        follower, answer = self._law.step(carry.follower, observation, self._privileged(plant, load))
        acting = load._replace(external_force=inputs.force)
        moved, after, commands = loop.step(state, observation, answer, acting, goals, inputs.sample, self._on_pid)
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        time = inputs.number * jnp.float32(config.timing.control_period)
        flown = (time, plant.position, goals[0], euler, plant.rotor_force, *commands, state.diverged)
        limits = (config.scenario.termination_distance, most, config.plant.leader)
        return Carry(moved, after, follower, metrics.update(carry.running, rollout.Tick(*flown), *limits))


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
