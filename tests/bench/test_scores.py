"""The table of wins, on scores made by hand."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest

from mjxball.baselines import make_baseline
from mjxball.bench import report
from mjxball.bench.report import verdict, wins_by_suite
from mjxball.bench.scores import Score, winners, wins
from mjxball.bench.suites import Suite, Variant
from mjxball.config import Plant, preset, with_plant
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.sim.scenario import Scenario

GOOD = Metrics(
    rmse=0.4,
    settling_time=3.0,
    overshoot=0.05,
    x_peak=0.01,
    y_peak=0.0,
    z_peak=0.0,
    plane_peak=0.0,
    max_tilt=0.1,
    action_error=0.1,
    settling_time_10=2.0,
    paper_return=-100.0,
    effort=0.1,
    smoothness=0.01,
    saturation=0.0,
    rotors_at_limit=0.0,
    rotor_power=1.0,
    command_spread=None,
    failed=False,
)


@pytest.fixture(scope="module")
def cell() -> Result:
    setup = preset("paper")
    return fly_scenarios(setup, [make_baseline("copy", setup)], [Scenario(seconds=0.1)], "newton-euler")[0]


def made(cell: Result, variant: str, follower: str, seeds: list[dict], suite: str = "one") -> Score:
    """A score whose seeds differ from `GOOD` as said."""
    return Score(suite, variant, follower, tuple(dataclasses.replace(GOOD, **seed) for seed in seeds), cell)


def test_each_metric_and_suite_is_counted_by_hand(cell: Result) -> None:
    scores = [
        made(cell, "a", "slow", [{"x_peak": 0.01, "rmse": 0.5}]),
        made(cell, "a", "fast", [{"x_peak": 0.02, "rmse": 0.3, "overshoot": 0.2}]),
        made(cell, "b", "slow", [{"x_peak": 0.01, "settling_time": None}]),
        made(cell, "b", "fast", [{"x_peak": 0.02, "overshoot": 0.2}]),
        made(cell, "c", "slow", [{"x_peak": 0.03, "settling_time": 4.0}], suite="two"),
        made(cell, "c", "fast", [{"x_peak": 0.02, "overshoot": 0.2}], suite="two"),
    ]
    found = {row["follower"]: [cell["text"] for cell in row["cells"]] for row in verdict(scores)["rows"]}
    # Variants, peak, RMSE (equal in b and c: both win), settling (equal in a), overshoot, failed flights.
    assert found == {"slow": ["3", "2", "2", "1", "3", "0"], "fast": ["3", "1", "3", "3", "0", "0"]}
    table = wins_by_suite(scores)
    assert table["names"] == ["slow", "fast"]
    suites = {row["suite"]: (row["total"], [cell["text"] for cell in row["cells"]]) for row in table["rows"]}
    assert suites == {"one": (2, ["2", "0"]), "two": (1, ["0", "1"])}


def test_suites_flown_by_different_followers_are_compared_where_both_flew(
    cell: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = [
        made(cell, "a", "pair", [{"x_peak": 0.01}], suite="pairs"),
        made(cell, "a", "adaptive", [{"x_peak": 0.02}], suite="pairs"),
        made(cell, "b", "team", [{"x_peak": 0.01}], suite="teams"),
        made(cell, "b", "adaptive", [{"x_peak": 0.02}], suite="teams"),
        made(cell, "c", "adaptive", [{"x_peak": 0.02}], suite="teams"),
    ]
    found = {row["follower"]: [cell["text"] for cell in row["cells"]] for row in verdict(scores)["rows"]}
    assert {name: (row[0], row[1], row[-1]) for name, row in found.items()} == {
        "pair": ("1", "1", "1 : 0"),
        "team": ("1", "1", "1 : 0"),
        "adaptive": ("3", "1", "–"),
    }
    monkeypatch.setattr(report, "film", lambda *_: (None, "not drawn in this test"))
    variants = {"pairs": (Variant("a", Scenario()),), "teams": (Variant("b", Scenario()), Variant("c", Scenario()))}
    suites = [Suite(name, name, "case", members) for name, members in variants.items()]
    report.write_report(tmp_path, Plant(), scores, suites, [], "", {})
    assert {row["follower"] for row in json.loads((tmp_path / "scores.json").read_text())["scores"]} == set(found)
    assert "Reference scenario: CG ±5 cm" in " ".join((tmp_path / "report.html").read_text().split())
    team = with_plant(preset("paper"), "team4").plant
    report.write_report(tmp_path, team, scores, suites, [], "", {})
    told = (tmp_path / "report.html").read_text()
    assert "Reference scenario" not in told
    assert "the pair" not in told


def test_failures_and_the_oracle_win_nothing(cell: Result) -> None:
    fell = made(cell, "a", "fell", [{"x_peak": 1e-6}, {"x_peak": 1e-6}, {"failed": True}])
    assert fell.summary("peak").median == 1e-6  # the median alone would let it win
    oracle = made(cell, "a", "oracle", [{"x_peak": 1e-9}] * 3)
    slow = made(cell, "a", "slow", [{"x_peak": 0.5}] * 3)
    assert winners([fell, oracle, slow], "peak") == ["slow"]
    assert wins([fell, oracle, slow]) == {"fell": 0, "slow": 1}
    assert wins_by_suite([fell, oracle, slow])["names"] == ["slow", "fell"]
    assert winners([fell, oracle], "peak") == []


def test_nobody_wins_where_nothing_was_measured(cell: Result) -> None:
    short = [made(cell, "a", name, [{"x_peak": None, "settling_time": None}]) for name in ("slow", "fast")]
    assert winners(short, "peak") == winners(short, "settling_time") == []
    assert math.isinf(short[0].summary("settling_time").median)


def test_who_never_arrives_does_not_win_by_overshooting_least(cell: Result) -> None:
    away = made(cell, "a", "away", [{"overshoot": -0.9, "settling_time_10": None}])
    there = made(cell, "a", "there", [{"overshoot": 0.1}])
    assert winners([away, there], "overshoot") == ["there"]
