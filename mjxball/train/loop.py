"""The training loop that `train.py` runs, of any algorithm: advance (collect, update), evaluate, save."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import NamedTuple

import jax

from mjxball.train import processes
from mjxball.train import program as programs
from mjxball.train.program import Program
from mjxball.train.run import Chunk, Run, Stop, graceful_interrupt

CHUNKS = 25  # rows of metrics.csv in a run, at most


def train(run: Run, beside: Callable[[], None] = lambda: None) -> bool:
    """Train to the end, or to Ctrl-C: False. Raises TrainingDivergedError; the last good policy stays on disk.

    `beside` is called when everything is compiled.
    """
    with contextlib.closing(run), contextlib.closing(run.progress):
        with graceful_interrupt(run.progress) as stop:
            run.start()
            stop.begun = True
            beside()
            finished = learn(run, stop)
            run.end(finished)
        return finished


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
