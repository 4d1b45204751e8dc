"""Any number of flights as one compiled program that keeps only their metrics: for batches no memory would hold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mjxball.config import Config
from mjxball.control.followers import Baseline, Controller, Follower
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics, results, rotor_limits
from mjxball.evaluate.running_metrics import RunningMetrics, begin, update
from mjxball.physics import mjx, newton_euler
from mjxball.physics.step import TRAINING_ENGINES, jax_repeat, make_plant_step
from mjxball.policy import Policy
from mjxball.policy.inference import NetworkController
from mjxball.scalar_form import scalar_form
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.rollout import Carry, Inputs, control_step, make_privileged_info, scenario_arrays
from mjxball.sim.scenario import Scenario
from mjxball.xla import enable_compilation_cache


def fly_compiled(
    config: Config,
    follower: Follower,
    scenarios: Sequence[Scenario],
    physics: str = "newton-euler",
    controller: Controller | None = None,
) -> list[Metrics]:
    """Metrics of every flight, computed in float32; `controller` in place of the follower's own.

    Delays, biases and resolutions are constants of the program, everything else is given to it.
    """
    controller, config_of = controller or controller_of(follower), (config.plant, config.attitude)
    if physics not in TRAINING_ENGINES:
        raise InputError(f"batches fly on {' or '.join(TRAINING_ENGINES)}, not on {physics}")
    flown = scenario_arrays(config, scenarios)
    enable_compilation_cache()
    engine = (mjx if physics == "mjx" else newton_euler).make_engine(*config_of)
    # Half of the time for hundreds of worlds; MJX and the cascade of a Crazyflie gain nothing, and compile longer.
    rewritten = physics == "newton-euler" and config.autopilot.kind == "ideal"
    step = (scalar_form if rewritten else jax.vmap)(make_plant_step(config, engine, jax_repeat))
    loop = ClosedLoop(config, step, flown.sensors, jitters=flown.inputs.late is not None)
    privileged = make_privileged_info(config)
    leader, limit = config.plant.leader, config.scenario.termination_distance

    def fly(load: Any, start: Any, inputs: Inputs, first: Any, most: Any) -> RunningMetrics:
        goal = inputs.at(0).goal
        state, observation = loop.start(start, goal, load, first, flown.settings)
        running = begin(start.position, goal.position, start.rotor_force, leader)

        def advance(carried: Any, now: Inputs) -> tuple[Any, None]:
            carry, row = control_step(loop, controller, privileged, load, carried[0], now)
            return (carry, update(carried[1], row, limit, most, leader)), None

        carried = Carry(state, observation, controller.start(observation)), running
        return jax.lax.scan(advance, carried, inputs)[0][1]

    given = (flown.load, flown.start, flown.inputs, flown.first, rotor_limits(config.plant, scenarios))
    single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32 if leaf.dtype == np.float64 else None), given)
    return results(jax.jit(fly)(*single))


def controller_of(follower: Follower) -> Controller:
    """The pure functions of a follower; raise InputError if it has none."""
    if isinstance(follower, Baseline):
        return follower.controller
    if isinstance(follower, Policy):
        return NetworkController(follower)
    raise InputError(f"follower {follower.name!r} is no baseline and no policy; batches cannot fly it")
