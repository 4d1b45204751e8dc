"""The training loop that `train.py` runs, of any algorithm: collect, update, evaluate, save."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax

from mjxball.train import processes
from mjxball.train import program as programs
from mjxball.train.population import Carried, Compiled, Population
from mjxball.train.program import Mode, Program, Statistics, TrainState

if TYPE_CHECKING:
    from mjxball.train.run import Chunk, Run, Stop

CHUNKS = 25  # rows of metrics.csv in a run, at most


def learn(run: Run, stop: Stop) -> bool:
    """Train `run` to the end of its schedule; False if `stop` was requested before.

    The host looks at a chunk of training, a row of metrics.csv, while the devices are at the next one.
    """
    plan = Plan.of(run.population.program)
    waiting: Chunk | None = None  # the devices are at it, or done with it
    # Several processes must stop at the same step, and agree on that between chunks alone.
    pause = (lambda: stop.requested) if jax.process_count() == 1 else lambda: False
    (ended,) = processes.any_of((stop.requested,))
    if run.done < plan.warmup and not ended:
        run.advance(programs.warmup(plan.warmup - run.done))
    while run.done < plan.total and not ended:
        goal, evaluates = plan.next(run.done)
        chunk = run.advance(programs.train(goal - run.done), pause)
        if waiting:
            run.progress.show(run.row(waiting))
        # One that is cut short has no row: who resumes has one of the rest.
        waiting = chunk if run.done == goal else None
        # All processes act on what they agreed on here, whenever a signal reaches one of them.
        ended, late = processes.any_of((stop.requested, run.saved_long_ago()))
        evaluates = evaluates and waiting is not None
        if waiting and (evaluates or late or ended):
            row = run.row(waiting)
            run.progress.show(row | run.evaluate() if evaluates else row)
            waiting = None
        if evaluates or late:
            run.save()
    return not ended


class Plan(NamedTuple):
    """When there is a row of metrics.csv, and an evaluation. In steps of every environment."""

    warmup: int  # steps with random actions, first
    total: int  # all steps, those of the warm-up with them
    chunk: int  # between two rows
    evaluations: int

    @classmethod
    def of(cls, program: Program) -> Plan:
        """The plan of a program's schedule."""
        total, window = program.total_rounds, program.algorithm.steps_per_collect
        chunk = math.ceil(total / CHUNKS / window) * window
        return cls(program.warmup_rounds, total, chunk, program.schedule.num_evaluations)

    def next(self, done: int) -> tuple[int, bool]:
        """(steps at the end of the chunk that begins or goes on at `done`, whether it ends in an evaluation)."""
        number, chunks = done // self.chunk + 1, math.ceil(self.total / self.chunk)
        goal = min(number * self.chunk, self.total)
        evaluates = number * self.evaluations // chunks > (number - 1) * self.evaluations // chunks
        return goal, evaluates or goal >= self.total


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
