"""A training by the clock, on devices whose speed and clock the test sets."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from mjxball.train.loop import Plan, learn
from mjxball.train.run import Stop

WORLDS, WINDOW, WARMUP = 4, 10, 30


class Devices:
    """Stands in for a `Run`: a step of every environment takes `cost(done)` seconds of its clock."""

    def __init__(self, seconds: float, cost: Callable[[int], float], done: int = 0, total: int = 500):
        self.seconds, self.cost, self.done, self.total = seconds, cost, done, total
        self.now, self.environments, self.rows, self.saves = 0.0, WORLDS, list[dict[str, Any]](), 0
        self.progress, self.on_evaluated = SimpleNamespace(show=self.rows.append), None
        schedule = SimpleNamespace(num_evaluations=5)
        algorithm = SimpleNamespace(steps_per_collect=WINDOW)
        program = SimpleNamespace(
            schedule=schedule, algorithm=algorithm, total_steps_each=total, warmup_steps_each=WARMUP
        )
        self.population = SimpleNamespace(program=program)

    def seconds_left(self) -> float:
        return max(self.seconds - self.now, 0.0)

    def end_at(self, total: int) -> None:
        self.total = total

    def advance(self, mode: Any, pause: Any = None) -> Any:
        begun, steps = self.now, -(-int(mode.steps) // WINDOW) * WINDOW
        for _ in range(steps):
            self.now += self.cost(self.done)
            self.done += 1
        return SimpleNamespace(steps=steps, reached=self.done, took=self.now - begun)

    def row(self, chunk: Any) -> dict[str, Any]:
        return {"steps": chunk.reached, "rate": chunk.steps * WORLDS / chunk.took}

    def evaluate(self) -> dict[str, Any]:
        self.now += 0.5
        return {"eval_return": 1.0}

    def save(self) -> None:
        self.saves += 1

    def saved_long_ago(self) -> bool:
        return False


@pytest.mark.parametrize("cost", [0.001, 0.02, 0.3])
@pytest.mark.parametrize("change", [1.0, 0.5, 3.0])  # of the cost after a third of the time
def test_a_training_by_the_clock_ends_in_time_and_evaluated(cost: float, change: float) -> None:
    seconds = 60.0
    run = Devices(seconds, lambda done: cost * (change if run.now > seconds / 3 else 1.0))
    assert learn(run, Stop())  # type: ignore[arg-type]
    most = seconds / 25 * max(change, 1.0) + WINDOW * cost * change  # a chunk that was planned before the change
    assert seconds - most - 1.0 < run.now < seconds + most + 1.0
    assert run.done == run.total == run.rows[-1]["steps"]
    assert run.total % WINDOW == 0
    evaluated = [row["steps"] / run.total for row in run.rows if "eval_return" in row]
    assert evaluated[-1] == 1.0
    assert 2 <= len(evaluated) <= 8
    assert len(run.rows) < 60
    assert run.saves >= len(evaluated) - 1


def test_a_training_whose_time_is_over_takes_two_collections() -> None:
    """Compilation took all of it: there is a follower nevertheless."""
    run = Devices(0.0, lambda done: 0.1)
    assert learn(run, Stop())  # type: ignore[arg-type]
    assert run.done == run.total == WARMUP + 2 * WINDOW
    assert "eval_return" in run.rows[-1]


def test_a_training_by_the_clock_goes_on_after_more_steps_than_its_settings_say() -> None:
    run = Devices(30.0, lambda done: 0.01, done=900, total=1200)
    run.population.program.total_steps_each = 500
    assert learn(run, Stop())  # type: ignore[arg-type]
    assert run.done == pytest.approx(900 + 30 / 0.01, rel=0.1)


@pytest.mark.parametrize("total", [250, 255, 1000, 12340])
def test_a_plan_without_a_clock_covers_the_schedule_and_evaluates_evenly(total: int) -> None:
    plan, done, evaluated = Plan(WARMUP, 0, 0, 5, WINDOW).ending(total), WARMUP, list[int]()
    while done < plan.total:
        done, evaluates = plan.next(done)
        evaluated += [done] if evaluates else []
    assert done == plan.total == -(-total // WINDOW) * WINDOW
    assert len(evaluated) == 5
    assert evaluated[-1] == done
