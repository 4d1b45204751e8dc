"""Flights of many plants of one structure as one batch that keeps metrics alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics, results, rotor_limits
from mjxball.evaluate.running_metrics import begin, update
from mjxball.physics.step import make_numpy_plant_step, structure
from mjxball.plant import PlantParameters, plant_parameters
from mjxball.plant.parameters import AttitudeGains
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.rollout import Carry, Together, control_step, scenario_arrays, start_of
from mjxball.sim.scenario import Scenario, check_scenario

ENGINE = "newton-euler"


class Part(NamedTuple):
    """A follower without privileged information and its flights on one plant."""

    config: Config
    follower: Follower
    scenarios: Sequence[Scenario]
    radii: np.ndarray  # (n,) see `running_metrics.begin` [m]
    deadlines: np.ndarray  # (n,) [s]


def together(configs: Sequence[Config]) -> list[list[int]]:
    """Indices of `configs` in groups that can fly as one batch."""
    groups: dict[Any, list[int]] = {}
    for number, config in enumerate(configs):
        groups.setdefault(structure(config) or number, []).append(number)
    return list(groups.values())


def fly(parts: Sequence[Part]) -> list[Metrics]:
    """Metrics of all flights of `parts`, which `together` has put in one group."""
    config, scenarios = parts[0].config, [one for part in parts for one in part.scenarios]
    for part in parts:
        for scenario in part.scenarios:
            check_scenario(part.config, scenario)
    parameters = _stacked([(plant_parameters(part.config.plant, part.config.attitude), part) for part in parts])
    starts = [start_of(part.config, part.scenarios) for part in parts]
    flown = scenario_arrays(config, scenarios, starts[0].each(lambda *leaves: np.concatenate(leaves), *starts[1:]))
    controller = Together([(part.follower, part.scenarios) for part in parts])
    plant_step = make_numpy_plant_step(config, ENGINE, parameters if structure(config) else None)
    loop = ClosedLoop(config, plant_step, flown.sensors, parameters, flown.inputs.late is not None)
    goal, leader, limit = flown.inputs.at(0).goal, config.plant.leader, config.scenario.termination_distance
    most = np.concatenate([rotor_limits(part.config.plant, part.scenarios) for part in parts])
    radii, deadlines = (np.concatenate([getattr(part, name) for part in parts]) for name in ("radii", "deadlines"))
    state, observation = loop.start(flown.start, goal, flown.load, flown.first, flown.settings)
    carry = Carry(state, observation, controller.start(observation))
    running = begin(flown.start.position, goal.position, flown.start.rotor_force, leader, radii, deadlines)
    for number in range(len(flown.inputs.time)):
        inputs = flown.inputs.at(number)
        carry, row = control_step(loop, controller, lambda *_: None, flown.load, carry, inputs)
        running = update(running, row, limit, most, leader)
    return results(running)


def _stacked(parts: Sequence[tuple[PlantParameters, Part]]) -> PlantParameters:
    """Parameters (n, ...) of the plant of every flight."""

    def each(leaves: Sequence[Any]) -> Any:
        repeated = [np.stack([leaf] * len(part.scenarios)) for leaf, (_, part) in zip(leaves, parts, strict=True)]
        return np.concatenate(repeated)

    columns = list(zip(*(one for one, _ in parts), strict=True))
    found = [
        AttitudeGains(*map(each, zip(*column, strict=True))) if isinstance(column[0], AttitudeGains) else each(column)
        for column in columns
    ]
    return PlantParameters(*found)
