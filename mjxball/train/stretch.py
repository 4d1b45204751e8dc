"""Several steps of training on the devices with any algorithm: collect, update, repeat."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mjxball.train.population import Compiled, FlatState, Population
from mjxball.train.program import Mode, Statistics, TrainState


class Stretch(NamedTuple):
    """Result of `advance`."""

    state: TrainState
    statistics: Statistics
    metrics: Any  # of the last update
    steps: int  # taken by each environment


def advance(
    population: Population,
    compiled: Compiled,
    state: TrainState,
    mode: Mode,
    pause: Callable[[], bool] = lambda: False,
) -> Stretch:
    """Step all environments `mode.steps` times, rounded up to whole collections, and learn; stop if `pause` is true.

    On accelerators it returns before the devices are done. The buffers of `state` are donated.
    """
    phase, window = population.place_phase(mode.phase), population.program.algorithm.steps_per_collect
    carried = FlatState(state, population.no_statistics())
    metrics, taken = population.no_metrics(), 0
    while taken < int(mode.steps):
        keys = compiled.collect(carried, phase)
        if mode.phase.learning:
            metrics = compiled.update(carried, keys)
        taken += window
        if pause():
            break
    return Stretch(*carried.trees(), population.named(metrics), taken)
