"""The table of wins, on scores made by hand."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest

from mjxball.config import preset
from mjxball.control.followers import make_baseline
from mjxball.evaluate.cells import Cell, run_cells
from mjxball.evaluate.judge import Score, winners, wins
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.wins import wins_table
from mjxball.scenario import Scenario

GOOD = Metrics(
    rmse=0.4,
    settling_time=3.0,
    overshoot=0.05,
    x_peak=0.01,
    y_peak=0.0,
    z_peak=0.0,
    max_tilt=0.1,
    action_error=0.1,
    settling_time_10=2.0,
    paper_return=-100.0,
    effort=0.1,
    smoothness=0.01,
    saturation=0.0,
    failed=False,
)


@pytest.fixture(scope="module")
def cell() -> Cell:
    setup = preset("paper")
    return run_cells(setup, [make_baseline("copy", setup)], [Scenario(seconds=0.1)], "newton-euler")[0]


def made(cell: Cell, level: str, follower: str, seeds: list[dict], family: str = "one") -> Score:
    """A score whose seeds differ from `GOOD` as said."""
    return Score(family, level, follower, tuple(dataclasses.replace(GOOD, **seed) for seed in seeds), cell)


def row(table: str, label: str) -> list[str]:
    """The cells of a row of the table, without markup."""
    found = re.search(rf"<tr[^>]*><td>{re.escape(label)}</td>(.*?)</tr>", table)
    assert found, table
    return re.findall(r">(\d+)<", found[1])


def heads(table: str) -> list[str]:
    return re.findall(r"<th>(.*?)</th>", table)


def test_each_metric_and_family_is_counted_by_hand(cell: Cell) -> None:
    scores = [
        made(cell, "a", "slow", [{"x_peak": 0.01, "rmse": 0.5}]),
        made(cell, "a", "fast", [{"x_peak": 0.02, "rmse": 0.3, "overshoot": 0.2}]),
        made(cell, "b", "slow", [{"x_peak": 0.01, "settling_time": None}]),
        made(cell, "b", "fast", [{"x_peak": 0.02, "overshoot": 0.2}]),
        made(cell, "c", "slow", [{"x_peak": 0.03, "settling_time": 4.0}], family="two"),
        made(cell, "c", "fast", [{"x_peak": 0.02, "overshoot": 0.2}], family="two"),
    ]
    table = wins_table(scores)
    assert heads(table) == ["smallest median", "levels", "slow", "fast"]
    assert row(table, "all, steady-state peak") == ["3", "2", "1"]
    assert row(table, "all, RMSE") == ["3", "2", "3"]  # equal in b and c: both win
    assert row(table, "all, settling") == ["3", "1", "3"]  # equal in a
    assert row(table, "all, overshoot") == ["3", "3", "0"]
    assert row(table, "one") == ["2", "2", "0"]
    assert row(table, "two") == ["1", "0", "1"]


def test_failures_and_the_oracle_win_nothing(cell: Cell) -> None:
    fell = made(cell, "a", "fell", [{"x_peak": 1e-6}, {"x_peak": 1e-6}, {"failed": True}])
    assert fell.summary("peak").median == 1e-6  # the median alone would let it win
    oracle = made(cell, "a", "oracle", [{"x_peak": 1e-9}] * 3)
    slow = made(cell, "a", "slow", [{"x_peak": 0.5}] * 3)
    assert winners([fell, oracle, slow], "peak") == ["slow"]
    assert wins([fell, oracle, slow]) == {"fell": 0, "slow": 1}
    assert "oracle" not in heads(wins_table([fell, oracle, slow]))
    assert winners([fell, oracle], "peak") == []


def test_nobody_wins_where_nothing_was_measured(cell: Cell) -> None:
    short = [made(cell, "a", name, [{"x_peak": None, "settling_time": None}]) for name in ("slow", "fast")]
    assert winners(short, "peak") == winners(short, "settling_time") == []
    assert math.isinf(short[0].summary("settling_time").median)


def test_who_never_arrives_does_not_win_by_overshooting_least(cell: Cell) -> None:
    away = made(cell, "a", "away", [{"overshoot": -0.9, "settling_time_10": None}])
    there = made(cell, "a", "there", [{"overshoot": 0.1}])
    assert winners([away, there], "overshoot") == ["there"]
