"""Every follower through every level of the scenario families, over several seeds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate.cells import Cell, run_cells
from mjxball.evaluate.families import Family, Level
from mjxball.evaluate.metrics import Metrics

# What the tables show and rank: less is better in each.
RANKED = ("rmse", "settling_time", "overshoot", "x_peak", "peak", "max_tilt", "effort", "smoothness", "saturation")
MEASURED = tuple(item.name for item in dataclasses.fields(Metrics) if item.name != "failed")
ORACLE = "oracle"
TOGETHER = 32  # scenarios in one batch of recorded flights
UNDRAWN: Any = None  # in place of the flights of all seeds but 0, which nobody draws and which would fill the memory
RESAMPLES, CONFIDENCE = 2000, 0.95


@dataclass(frozen=True)
class Summary:
    """Median over the seeds and its bootstrap interval; infinite where the median flight failed or never settled."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Score:
    """One follower on one level of a family."""

    family: str
    level: str
    follower: str
    metrics: tuple[Metrics, ...]  # one for each seed
    shown: Cell  # of seed 0, with its flight

    @property
    def failures(self) -> int:
        """Seeds in which the flight failed."""
        return sum(metrics.failed for metrics in self.metrics)

    def values(self, name: str) -> np.ndarray:
        """A metric of every seed; a failed flight and one that never settled count as infinitely bad."""
        return np.array([_value(metrics, name) for metrics in self.metrics])

    def summary(self, name: str) -> Summary:
        """Median and interval of the metric `name`."""
        return bootstrap(self.values(name))

    def record(self) -> dict[str, Any]:
        """The score as JSON: metric -> [median, low, high], None for infinite."""
        found: dict[str, Any] = {"family": self.family, "level": self.level, "follower": self.follower}
        for name in (*RANKED, *(name for name in MEASURED if name not in RANKED)):
            numbers = dataclasses.astuple(self.summary(name))
            found[name] = [number if math.isfinite(number) else None for number in numbers]
        return {**found, "seeds": len(self.metrics), "failed": self.failures}


def _value(metrics: Metrics, name: str) -> float:
    if metrics.failed:
        return math.inf
    if name == "peak":
        return metrics.peak
    value = getattr(metrics, name)
    if value is None:
        return math.inf if name.startswith("settling") else math.nan
    return value


def bootstrap(values: np.ndarray) -> Summary:
    """Median of `values` (n,) and the percentile interval of the medians of resampled ones; NaN where there is none."""
    values = values[~np.isnan(values)]
    if not values.size:
        return Summary(math.nan, math.nan, math.nan)
    draws = np.random.default_rng(0).integers(0, values.size, (RESAMPLES, values.size))
    medians = np.sort(_median(values[draws]))
    tail = (1 - CONFIDENCE) / 2
    low, high = (medians[round(share * (RESAMPLES - 1))] for share in (tail, 1 - tail))
    return Summary(float(_median(values[None])[0]), float(low), float(high))


def _median(rows: np.ndarray) -> np.ndarray:
    """Median of each row; of an even number the upper one, so that no infinity is averaged away."""
    return np.sort(rows, axis=1)[:, rows.shape[1] // 2]


def judge(
    base: Config,
    followers: Sequence[Follower],
    families: Sequence[Family],
    seeds: int,
    physics: str,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Score]:
    """Fly everything. The followers were made for `base`; what a level changes of it, nobody tells them."""
    scores: list[Score] = []
    for number, family in enumerate(families):
        progress(f"{number + 1}/{len(families)} {family.name}: {len(family.levels)} levels x {seeds} seeds")
        flown = dict(_fly(base, followers, family, seeds, physics))
        for level in family.levels:
            for index, follower in enumerate(followers):
                cells = [flown[level.label, seed][index] for seed in range(seeds)]
                metrics = tuple(cell.metrics for cell in cells)
                scores.append(Score(family.name, level.label, follower.name, metrics, cells[0]))
    return scores


def _fly(
    base: Config, followers: Sequence[Follower], family: Family, seeds: int, physics: str
) -> Iterator[tuple[tuple[str, int], list[Cell]]]:
    """((level's label, seed), cells of all followers); levels that share a configuration fly in one batch."""
    groups: dict[str, tuple[Config, list[tuple[Level, int]]]] = {}
    for level in family.levels:
        for seed in range(seeds):
            flown = level.config(base, seed)
            key = f"{configs.config_hash(flown)} {level.scenario.seconds}"
            groups.setdefault(key, (flown, []))[1].append((level, seed))
    parts = [
        (flown, members[first : first + TOGETHER])
        for flown, members in groups.values()
        for first in range(0, len(members), TOGETHER)
    ]
    for flown, members in parts:
        cells = run_cells(flown, followers, [level.seeded(seed) for level, seed in members], physics)
        for number, (level, seed) in enumerate(members):
            mine = cells[number * len(followers) : (number + 1) * len(followers)]
            kept = [replace(cell, flight=cell.flight.copied() if seed == 0 else UNDRAWN) for cell in mine]
            yield (level.label, seed), kept


def winners(rivals: Sequence[Score], name: str) -> list[str]:
    """Who is best on one level by the median of `name`: one follower, several of equal numbers, or nobody.

    The oracle, which is told, and a follower that failed in any seed are left out; so are, from overshoot, those that
    never come within 10 % of the goal: who does not arrive overshoots nothing.
    """
    able = [score for score in rivals if score.follower != ORACLE and not score.failures]
    if name == "overshoot":
        able = [score for score in able if math.isfinite(score.summary("settling_time_10").median)]
    medians = {score.follower: score.summary(name).median for score in able}
    finite = [value for value in medians.values() if math.isfinite(value)]
    return [follower for follower, value in medians.items() if finite and value == min(finite)]


def wins(scores: Sequence[Score], name: str = "peak") -> dict[str, int]:
    """In how many levels each follower but the oracle is the best by the median of `name`."""
    count = {score.follower: 0 for score in scores if score.follower != ORACLE}
    for rivals in by_level(scores).values():
        for follower in winners(rivals, name):
            count[follower] += 1
    return count


def by_level(scores: Sequence[Score]) -> dict[tuple[str, str], list[Score]]:
    """(family, level) -> its scores, in order."""
    levels: dict[tuple[str, str], list[Score]] = {}
    for score in scores:
        levels.setdefault((score.family, score.level), []).append(score)
    return levels
