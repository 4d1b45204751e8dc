"""The training loop of `train.py` for any algorithm: advance (collect, update), evaluate, save."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import NamedTuple

import jax

from mjxball.train import processes
from mjxball.train import program as programs
from mjxball.train.program import TrainingProgram
from mjxball.train.run import Chunk, Run, Stop, graceful_interrupt
from mjxball.train.run_directory import POLICY

CHUNKS = 25  # rows of metrics.csv in a run, at most


def train(run: Run, on_start: Callable[[], None] = lambda: None) -> bool:
    """Train to the end of the schedule; False after Ctrl-C. `on_start` is called when everything is compiled.

    Raises TrainingDivergedError; the last good policy stays on disk.
    """
    with contextlib.closing(run), contextlib.closing(run.progress):
        with graceful_interrupt(run.progress) as stop:
            run.start()
            stop.begun = True
            on_start()
            finished = learn(run, stop)
            run.end(finished)
        return finished


def learn(run: Run, stop: Stop) -> bool:
    """Train `run` to the end of its schedule; False if `stop` was requested before.

    The host processes a chunk of training, a row of metrics.csv, while the devices work on the next one.
    """
    plan = Plan.of(run.population.program)
    timed = run.seconds_left() is not None
    if timed:  # the first collection tells how quick the devices are
        done = max(run.done, plan.warmup)
        plan = plan._replace(total=max(run.total, done + 2 * plan.window), chunk=plan.window, begin=done)
    waiting: Chunk | None = None  # submitted to the devices, row not written yet
    # Several processes must stop at the same step, which they agree on between chunks.
    pause = (lambda: stop.requested) if jax.process_count() == 1 else lambda: False
    (ended,) = processes.any_of((stop.requested,))
    if run.done < plan.warmup and not ended:
        run.advance(programs.warmup_mode(plan.warmup - run.done))
    while run.done < plan.total and not ended:
        goal, evaluates = plan.next(run.done)
        chunk = run.advance(programs.train_mode(goal - run.done), pause)
        if waiting:
            run.progress.show(run.row(waiting))
        # A chunk that was cut short has no row; the resumed run writes one for its rest.
        waiting = chunk if run.done == goal else None
        # A signal may reach one process only: all act on what they agree on here.
        ended, late = processes.any_of((stop.requested, run.saved_long_ago()))
        evaluates = evaluates and waiting is not None
        if waiting and (evaluates or late or ended or timed):
            row = run.row(waiting)
            run.progress.show(row | run.evaluate() if evaluates else row)
            waiting = None
            left = run.seconds_left()
            if left is not None and goal < plan.total:
                plan = plan.ending(run.done + left * row["rate"] / run.environments, run.done)
                run.end_at(plan.total)
        if evaluates or late:
            run.save()
        if evaluates and run.on_evaluated:
            run.on_evaluated(run.out / POLICY)
    return not ended


class Plan(NamedTuple):
    """Schedule of rows of metrics.csv and of evaluations, in steps of each environment."""

    warmup: int  # first steps, with random actions
    total: int  # all steps, including the warm-up
    chunk: int  # steps between two rows
    evaluations: int  # number of evaluations
    window: int  # steps of a collection
    begin: int = 0  # steps after which the first chunk begins

    @classmethod
    def of(cls, program: TrainingProgram) -> Plan:
        """The plan of a program's schedule."""
        evaluations, window = program.schedule.num_evaluations, program.algorithm.steps_per_collect
        return cls(program.warmup_steps_each, 0, 0, evaluations, window).ending(program.total_steps_each)

    def ending(self, total: float, done: int = 0) -> Plan:
        """The plan with `total` steps in whole collections, one of them after `done` at least."""
        collections = max(math.ceil((total - done) / self.window), 1)
        chunk = math.ceil(total / CHUNKS / self.window) * self.window
        return self._replace(total=done + collections * self.window, chunk=chunk, begin=done)

    def next(self, done: int) -> tuple[int, bool]:
        """(steps at the end of the chunk that contains step `done`, whether an evaluation follows it)."""
        before = done - (done - self.begin) % self.chunk
        goal = min(before + self.chunk, self.total)
        return goal, goal * self.evaluations // self.total > before * self.evaluations // self.total
