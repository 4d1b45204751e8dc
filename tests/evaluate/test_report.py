"""The report of flights: medians and marks of its table on metrics made by hand, and the page in a real browser."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from command_line import call
from conftest import opened

from mjxball.baselines import make_baseline
from mjxball.commands.evaluate import main as evaluate
from mjxball.config import Plant, preset, with_plant
from mjxball.evaluate import report
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.report import median, score_rows, write_report
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.sim.scenario import Scenario

COLUMNS = ("peak", "settling_time")
SCENARIOS = tuple(Scenario(amplitude=0.05, mass=mass, seconds=0.1) for mass in (0.2, 0.3, 0.4))


def result(follower: str, scenario: Scenario = SCENARIOS[0], **values: Any) -> Result:
    """A result with peaks of `x_peak` along x alone."""
    zero = {**dict.fromkeys(Metrics.__dataclass_fields__, 0.0), "command_spread": None, "failed": False}
    return Result(follower, scenario, Metrics(**{**zero, **values}), None)


def by_name(rows: list[dict[str, Any]], scenario: str) -> dict[str, list[str]]:
    """Texts of the cells of every follower in one scenario, `*` behind the best."""
    own = [row for row in rows if row["scenario"].startswith(scenario)]
    return {row["follower"]: [cell["text"] for cell in row["cells"]] + ["*"] * row["best"] for row in own}


def test_no_infinity_is_averaged_away() -> None:
    assert median([0.3, 0.1, 0.2]) == 0.2
    assert median([0.1, math.nan, 0.2]) == 0.2  # of two the larger one; NaN is no value
    assert math.isinf(median([0.1, math.inf]))
    assert math.isnan(median([math.nan]))


def test_medians_over_scenarios_and_the_best_of_each() -> None:
    peaks = {"steady": (0.02, 0.02, 0.02), "better": (0.01, 0.01, 0.03), "oracle": (0.0, 0.0, 0.0)}
    flown = [
        [result(name, scenario, x_peak=own[k], settling_time=2.0 + k) for name, own in peaks.items()]
        for k, scenario in enumerate(SCENARIOS)
    ]
    rows = score_rows(flown, COLUMNS)
    assert by_name(rows, "median of 3") == {
        "steady": ["0.0200", "3.00", "0/3"],
        "better": ["0.0100", "3.00", "0/3", "*"],
        "oracle": ["0.0000", "3.00", "0/3"],
    }
    assert by_name(rows, "CG 0.05 m at 0.31 rad/s, object 0.4 kg")["steady"] == ["0.0200", "4.00", "0/1", "*"]
    assert len(rows) == 3 + 9


def test_a_failed_flight_is_infinitely_bad() -> None:
    fell = [result("fell", scenario, x_peak=1e-6, failed=k > 0) for k, scenario in enumerate(SCENARIOS)]
    slow = [result("slow", scenario, x_peak=0.5, settling_time=None) for scenario in SCENARIOS]
    rows = score_rows([list(pair) for pair in zip(fell, slow, strict=True)], COLUMNS)
    assert by_name(rows, "median") == {"fell": ["failed", "never", "2/3"], "slow": ["0.5000", "never", "0/3", "*"]}
    assert [float(cell["key"]) for cell in rows[0]["cells"]] == [1e299, 1e299, 2]  # sorted behind every number


def test_one_scenario_has_no_medians_and_one_follower_no_mark() -> None:
    (row,) = score_rows([[result("alone", x_peak=None)]], COLUMNS)
    assert row["scenario"].startswith("CG ")
    assert not row["best"]
    assert row["cells"][0]["text"] == "-"


def test_the_sway_of_the_pair_is_explained_for_pairs_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    setup = preset("paper")
    monkeypatch.setattr(report, "film", lambda *_: (None, "not drawn in this test"))
    flown = fly_scenarios(setup, [make_baseline("copy", setup)], SCENARIOS[:2], "newton-euler")
    for plant, said in ((Plant(), True), (with_plant(setup, "team4").plant, False)):
        write_report(tmp_path, plant, flown, [], "", {})
        assert ("the pair sways" in (tmp_path / "report.html").read_text()) == said


# --- the command line and the page ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of three followers in four scenarios, through the command line."""
    out = tmp_path_factory.mktemp("flown") / "report"
    flags = [
        "policies/archive/transport-large.npz",
        "--followers",
        "copy",
        "adaptive",
        "--omega",
        0.31,
        1,
        "--mass",
        0.2,
        0.4,
    ]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(report, "LEAD_SECONDS", 4.0)  # of the moving picture, most of whose time is rendering
        assert call(evaluate, [*flags, "--seconds", 24, "--physics", "newton-euler", "--out", out]) == 0
    return out


@pytest.mark.slow
def test_the_report_says_how_it_was_made(written: Path) -> None:
    text = (written / "report.html").read_text()
    assert "python eval.py policies/archive/transport-large.npz --followers copy adaptive" in text
    assert "metadata of <b>transport-large</b>" in text
    assert "image/webp;base64" in text or "No picture: MuJoCo" in text
    assert len(json.loads((written / "cells.json").read_text())["cells"]) == 4 * 3


@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_the_report_opens_in_a_browser(browser: Any, written: Path, width: int) -> None:
    tab = opened(browser, written / "report.html", width)
    assert tab.locator("#table tbody tr").count() == 3 + 4 * 3
    assert tab.locator("details .scroll > svg").count() == 4
    tab.evaluate("window.scrollTo(0, 2000)")
    tab.wait_for_function("window.scrollY > 500")
    assert tab.locator("nav").bounding_box()["y"] == pytest.approx(0, abs=1)  # it stays in view
    box = tab.locator("details .scroll > svg").first.bounding_box()
    assert box["width"] > 0.8 * (min(width, 1100) - 32)
    assert box["height"] > 80
    tab.close()


def test_the_report_sorts_and_filters(browser: Any, written: Path) -> None:
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    tab.goto((written / "report.html").as_uri())

    def column() -> list[float]:
        return tab.eval_on_selector_all(
            "#table tbody tr:not([hidden]) td:nth-child(8)", "c => c.map(x => +x.dataset.v)"
        )

    tab.click("#table th:nth-child(8) button")
    assert column() == sorted(column())
    tab.click("#table th:nth-child(8) button")
    assert column() == sorted(column(), reverse=True)
    assert len(column()) == 15
    tab.select_option("#follower", "transport-large")
    assert len(column()) == 5
    tab.select_option("#scenario", "median of 4")
    assert len(column()) == 1
    tab.close()
