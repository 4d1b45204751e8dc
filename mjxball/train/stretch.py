"""A stretch of training on the devices, of any algorithm: collect, update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mjxball.train.population import Carried, Compiled, Population
from mjxball.train.program import Mode, Statistics, TrainState


class Stretch(NamedTuple):
    """What `advance` returns."""

    state: TrainState
    statistics: Statistics
    metrics: Any  # of the last update
    steps: int  # of every environment


def advance(
    population: Population,
    compiled: Compiled,
    state: TrainState,
    mode: Mode,
    pause: Callable[[], bool] = lambda: False,
) -> Stretch:
    """Step all environments `mode.steps` times, rounded up to whole collections, and learn; fewer if `pause` says so.

    Results are there before the devices are done with them, unless they are CPUs. The arrays of `state` are used up.
    """
    phase, window = population.place_phase(mode.phase), population.program.algorithm.steps_per_collect
    carried = Carried(state, population.no_statistics())
    metrics, taken = population.no_metrics(), 0
    while taken < int(mode.steps):
        keys = compiled.collect(carried, phase)
        if mode.phase.learning:
            metrics = compiled.update(carried, keys)
        taken += window
        if pause():
            break
    return Stretch(*carried.trees(), population.named(metrics), taken)
