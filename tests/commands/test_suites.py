"""Benchmark suites, scores over seeds, the verdict, and the report in a real browser."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from conftest import opened

from mjxball.baselines import make_baseline
from mjxball.bench import report as report_page
from mjxball.bench import suites
from mjxball.bench.report import compare, verdict
from mjxball.bench.scores import Score, bootstrap, by_variant, fly_suites, wins
from mjxball.bench.suites import Suite
from mjxball.commands.evaluate import main as evaluate
from mjxball.config import preset
from mjxball.sim.scenario import check_scenario
from seeds import FLIGHTS, read_levels

CONFIG = preset("paper")
SHORT = ("delay", "mass-change")


def shortened(name: str, seconds: float = 24.0) -> Suite:
    """A suite whose flights are cut short."""
    suite = suites.BY_NAME[name]
    variants = tuple(
        dataclasses.replace(variant, scenario=dataclasses.replace(variant.scenario, seconds=seconds))
        for variant in suite.variants
    )
    return dataclasses.replace(suite, variants=variants)


@pytest.fixture(scope="module")
def scores() -> list[Score]:
    """Three followers on two short suites, two seeds."""
    followers = [make_baseline(name, CONFIG) for name in ("copy", "adaptive", "oracle")]
    return fly_suites(CONFIG, followers, [shortened(name) for name in SHORT], 2, "newton-euler")


def test_every_variant_is_sound_for_every_seed() -> None:
    for suite in suites.SUITES:
        assert len({variant.label for variant in suite.variants}) == len(suite.variants)
        for variant in suite.variants:
            for seed in range(2):
                check_scenario(variant.config(CONFIG, seed), variant.seeded(seed))


def test_seeds_are_reproducible_and_differ() -> None:
    variant = suites.BY_NAME["noise"].variants[0]
    assert variant.seeded(3) == variant.seeded(3)
    assert variant.seeded(3) != variant.seeded(4)
    assert variant.seeded(0).phase == 0.0
    walk = suites.BY_NAME["waveform"].variants[1]
    assert walk.config(CONFIG, 1).motion == walk.config(CONFIG, 1).motion != walk.config(CONFIG, 2).motion


def test_rolling_balls_differ_between_seeds() -> None:
    variant = suites.BY_NAME["rolling-ball"].variants[0]
    starts = {variant.seeded(seed).ball_start for seed in range(6)}
    assert len(starts) == 6
    assert max(map(abs, starts)) == variant.scenario.ball_start


def test_bootstrap_interval_covers_the_median_as_often_as_it_says() -> None:
    random = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        found = bootstrap(random.normal(size=25))
        hits += found.low <= 0 <= found.high
    # A percentile interval of a median covers a little less or more than 95 %; 200 trials have a deviation of 1.5 %.
    assert 0.89 <= hits / 200 <= 1.0


def test_failures_are_never_averaged_away() -> None:
    assert math.isinf(bootstrap(np.array([0.1, math.inf, math.inf])).median)
    assert math.isinf(bootstrap(np.array([0.1, math.inf])).median)  # of two the worse one
    assert bootstrap(np.array([0.1, 0.2, math.inf])).median == 0.2
    assert math.isnan(bootstrap(np.array([math.nan])).median)


@pytest.mark.slow
def test_scores_hold_every_seed_and_one_flight(scores) -> None:
    assert len(scores) == (3 + 3) * 3
    for score in scores:
        assert len(score.metrics) == 2
        assert score.first.flight is not None
        assert score.failures == 0
    delays = [s.summary("peak").median for s in scores if s.suite == "delay" and s.follower == "copy"]
    assert len(set(delays)) == 3  # the variants really differ


@pytest.mark.slow
def test_oracle_is_left_out_of_the_wins(scores) -> None:
    won = wins(scores)
    assert "oracle" not in won
    assert sum(won.values()) == len(by_variant(scores)) == 6
    assert won["adaptive"] == 6


def with_peaks(score: Score, name: str, peak: float) -> Score:
    metrics = tuple(dataclasses.replace(m, x_peak=peak, y_peak=0.0, z_peak=0.0) for m in score.metrics)
    return dataclasses.replace(score, follower=name, metrics=metrics)


@pytest.mark.slow
def test_verdict_counts_wins_and_compares_peaks(scores) -> None:
    """`mine` has the largest peak of all, then the smallest."""
    for peak, won, duel in ((5.0, "0", "0 : 6"), (1e-6, "6", "6 : 0")):
        mine = [with_peaks(s, "mine", peak) for s in scores if s.follower == "copy"]
        found = verdict([*scores, *mine])
        row = next(row for row in found["rows"] if row["follower"] == "mine")
        assert [cell["text"] for cell in row["cells"][:2]] == ["6", won]
        assert row["cells"][-1]["text"] == duel
        assert len(found["heads"]) == len(row["cells"]) == 7
        assert compare([*scores, *mine], "mine", "adaptive") == (6 - 6 * (peak > 1), 6 * (peak > 1))


# --- the command line and the page ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of two followers on one suite, through the command line."""
    out = tmp_path_factory.mktemp("judged") / "report"
    flags = ["suites", "--followers", "copy", "adaptive", "policies/archive/transport.npz"]
    flags += ["--only", "delay", "start-errors"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(report_page, "LEAD_SECONDS", 4.0)  # of the moving picture, most of whose time is rendering
        assert evaluate([*flags, "--num-seeds", "1", "--physics", "newton-euler", "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_scores_are_json_without_infinities(report: Path) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(text)

    found = json.loads((report / "scores.json").read_text(), parse_constant=refuse)["scores"]
    assert len(found) == 6 * 3
    assert {row["follower"] for row in found} == {"copy", "adaptive", "transport"}
    assert {"paper_return", "settling_time_10", "y_peak", "action_error"} <= set(found[0])
    assert all(row["seeds"] == 1 and len(row["rmse"]) == 3 for row in found)
    never = next(row for row in found if row["follower"] == "copy")["settling_time"]
    assert never == [None, None, None]


def test_list_names_every_suite(capsys: pytest.CaptureFixture) -> None:
    assert evaluate(["suites", "--list"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{suite.name}: " in printed for suite in suites.SUITES)


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["suites", "--only", "nothing"], "invalid choice: 'nothing'"),
        (["suites", "--omega", "1"], "unrecognized arguments: --omega"),
        (["suites", "--num-seeds", "0"], "--num-seeds must be"),
        (["--num-seeds", "3"], "unrecognized arguments: --num-seeds"),
    ],
)
def test_unsound_requests_are_refused(flags, word, capsys: pytest.CaptureFixture) -> None:
    assert call(evaluate, flags) == 2
    message = capsys.readouterr().err
    assert word in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_report_opens_in_a_browser(browser, report: Path, width: int) -> None:
    tab = opened(browser, report / "report.html", width)
    assert tab.locator("#verdict-table tbody tr").count() == 3
    assert tab.locator("#wins-table tbody tr").count() == 2
    tab.evaluate("window.scrollTo(0, 2000)")
    tab.wait_for_function("window.scrollY > 500")
    assert tab.locator("nav").bounding_box()["y"] == pytest.approx(0, abs=1)  # it stays in view
    tab.evaluate("window.scrollTo({top: 0, behavior: 'instant'})")
    for section in ("delay", "start-errors"):
        assert tab.locator(f"h2#{section} ~ .scroll > svg").count() >= 1
        box = tab.locator(f"h2#{section} ~ .scroll > svg").first.bounding_box()
        assert box["width"] > 0.8 * (min(width, 1100) - 32)
        assert box["height"] > 80
    tab.close()


def test_report_sorts_and_filters(browser, report: Path) -> None:
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    tab.goto((report / "report.html").as_uri())

    def column() -> list[float]:
        return tab.eval_on_selector_all(
            "#scores tbody tr:not([hidden]) td:nth-child(8)", "c => c.map(x => +x.dataset.v)"
        )

    tab.click("#scores th:nth-child(8) button")
    assert column() == sorted(column())
    tab.click("#scores th:nth-child(8) button")
    assert column() == sorted(column(), reverse=True)
    assert len(column()) == 18
    tab.select_option("#follower", "transport")
    assert len(column()) == 6
    tab.select_option("#suite", "delay")
    assert len(column()) == 3
    tab.close()


@pytest.mark.slow
def test_report_says_how_it_was_made(report: Path) -> None:
    text = (report / "report.html").read_text()
    assert "python eval.py suites --followers copy adaptive" in text
    assert "metadata of <b>transport</b>" in text
    assert "image/webp;base64" in text or "No picture: MuJoCo" in text


def test_the_frozen_levels_are_flights_of_the_pair() -> None:
    levels = [level for suite in read_levels() for level in suite.variants]
    assert len(levels) == 80
    for level in levels:
        for seed in range(FLIGHTS):
            config = level.config(CONFIG, seed)
            check_scenario(config, level.seeded(seed))
            assert (config.motion.kind == "waveform") == bool(level.waveforms)
