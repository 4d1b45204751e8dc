"""Scores of followers on the variants of suites, over several seeds: medians, wins, and a text table."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball import terminal
from mjxball.bench.suites import Suite, Variant
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.results import COLUMNS, MARK, Result, fly_scenarios, metric_text, scenario_title

# What the tables show and rank: less is better in each.
RANKED = (
    *("rmse", "settling_time", "overshoot", "x_peak", "peak", "max_tilt", "effort", "smoothness", "saturation"),
    *("rotors_at_limit", "rotor_power", "command_spread"),
)
MEASURED = tuple(item.name for item in dataclasses.fields(Metrics) if item.name != "failed")
ORACLE = "oracle"
BATCH = 32  # scenarios in one batch of recorded flights
NO_FLIGHT: Any = None  # in place of the flights of seeds other than 0, to save memory
RESAMPLES, CONFIDENCE = 2000, 0.95


@dataclass(frozen=True)
class Summary:
    """Median over the seeds and its bootstrap interval; infinite where the median flight failed or never settled."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Score:
    """One follower on one variant of a suite."""

    suite: str
    variant: str
    follower: str
    metrics: tuple[Metrics, ...]  # one for each seed
    first: Result  # of seed 0, with its flight

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
        found: dict[str, Any] = {"suite": self.suite, "variant": self.variant, "follower": self.follower}
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


def fly_suites(
    base: Config,
    followers: Sequence[Follower],
    suites: Sequence[Suite],
    num_seeds: int,
    physics: str,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Score]:
    """Fly everything. The followers are designed for `base` and do not know what a variant changes."""
    scores: list[Score] = []
    for number, suite in enumerate(suites):
        progress(f"{number + 1}/{len(suites)} {suite.name}: {len(suite.variants)} variants x {num_seeds} seeds")
        flown = dict(_fly(base, followers, suite, num_seeds, physics))
        for variant in suite.variants:
            for index, follower in enumerate(followers):
                results = [flown[variant.label, seed][index] for seed in range(num_seeds)]
                metrics = tuple(result.metrics for result in results)
                scores.append(Score(suite.name, variant.label, follower.name, metrics, results[0]))
    return scores


def _fly(
    base: Config, followers: Sequence[Follower], suite: Suite, num_seeds: int, physics: str
) -> Iterator[tuple[tuple[str, int], list[Result]]]:
    """((variant's label, seed), results of all followers); variants that share a configuration fly in one batch."""
    groups: dict[str, tuple[Config, list[tuple[Variant, int]]]] = {}
    for variant in suite.variants:
        for seed in range(num_seeds):
            flown = variant.config(base, seed)
            key = f"{configs.config_hash(flown)} {variant.scenario.seconds}"
            groups.setdefault(key, (flown, []))[1].append((variant, seed))
    parts = [
        (flown, members[first : first + BATCH])
        for flown, members in groups.values()
        for first in range(0, len(members), BATCH)
    ]
    for flown, members in parts:
        results = fly_scenarios(flown, followers, [variant.seeded(seed) for variant, seed in members], physics)
        for number, (variant, seed) in enumerate(members):
            mine = results[number * len(followers) : (number + 1) * len(followers)]
            kept = [replace(result, flight=result.flight.copied() if seed == 0 else NO_FLIGHT) for result in mine]
            yield (variant.label, seed), kept


def winners(rivals: Sequence[Score], name: str) -> list[str]:
    """The followers with the least median of `name` on one variant; several if equal, none if nothing was measured.

    Left out: the oracle, followers that failed in any seed and, for overshoot, followers that never come within 10 %
    of the goal.
    """
    able = [score for score in rivals if score.follower != ORACLE and not score.failures]
    if name == "overshoot":
        able = [score for score in able if math.isfinite(score.summary("settling_time_10").median)]
    medians = {score.follower: score.summary(name).median for score in able}
    finite = [value for value in medians.values() if math.isfinite(value)]
    return [follower for follower, value in medians.items() if finite and value == min(finite)]


def wins(scores: Sequence[Score], name: str = "peak") -> dict[str, int]:
    """Number of variants in which each follower but the oracle has the least median of `name`."""
    count = {score.follower: 0 for score in scores if score.follower != ORACLE}
    for rivals in by_variant(scores).values():
        for follower in winners(rivals, name):
            count[follower] += 1
    return count


def by_variant(scores: Sequence[Score]) -> dict[tuple[str, str], list[Score]]:
    """(suite, variant) -> its scores, in order."""
    variants: dict[tuple[str, str], list[Score]] = {}
    for score in scores:
        variants.setdefault((score.suite, score.variant), []).append(score)
    return variants


SHOWN = (  # in the text table
    *("peak", "rmse", "settling_time", "overshoot", "saturation"),
    *("rotors_at_limit", "rotor_power", "command_spread"),
)


def text_table(scores: Sequence[Score], suites: Sequence[Suite]) -> str:
    """Medians over the seeds, one line for each variant and follower; `MARK` before those on the reference scenario."""
    marked = {(suite.name, variant.label) for suite in suites for variant in suite.variants if variant.is_reference}
    units = {suite.name: suite.axis.partition("[")[2].rstrip("]") for suite in suites}
    measured = [name for name in SHOWN if any(not np.isnan(score.values(name)).all() for score in scores)]
    rows = []
    for score in scores:
        mark = MARK if (score.suite, score.variant) in marked else ""
        medians = (metric_text(name, score.summary(name).median) for name in measured)
        failed = f"{score.failures}/{len(score.metrics)}"
        variant = f"{score.variant} {units[score.suite]}".strip()
        rows.append([mark, score.suite, variant, score.follower, failed, *medians])
    heads = ["", "suite", "variant", "follower", "failed", *(COLUMNS[name][0] for name in measured)]
    said = f"Medians over the seeds. {MARK} the reference scenario; - there is none; failed: of all seeds, or most do."
    return f"{terminal.table(heads, rows, words=(1, 2, 3), name=3)}\n{terminal.fitted_to(sys.stdout, said)}"


def scores_of(results: Sequence[Result]) -> tuple[list[Score], list[Suite]]:
    """Results of single flights as scores of one suite, whose variants are their scenarios."""
    titles = {result.scenario: scenario_title(result) for result in results}
    variants = tuple(Variant(title, scenario) for scenario, title in titles.items())
    suite = Suite("scenarios", "the scenarios of the command line", "scenario", variants)
    scores = [Score(suite.name, titles[r.scenario], r.follower, (r.metrics,), r) for r in results]
    return scores, [suite]
