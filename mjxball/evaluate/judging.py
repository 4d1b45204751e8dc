"""`eval.py --families`: judge followers on scenario families, print, and write the report."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate import page
from mjxball.evaluate.animation import animate
from mjxball.evaluate.cells import Cell
from mjxball.evaluate.families import Family, Level
from mjxball.evaluate.figures import scenario_title
from mjxball.evaluate.judge import Score, judge
from mjxball.policy import Policy

SHOWN = ("peak", "rmse", "settling_time", "overshoot", "saturation")


def judge_families(
    setup: Config, followers: Sequence[Follower], families: Sequence[Family], seeds: int, physics: str
) -> list[Score]:
    """Fly everything, saying on stderr how far it is; print the table."""
    started = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - started:6.1f} s  {text}", file=sys.stderr)  # noqa: T201

    scores = judge(setup, followers, families, seeds, physics, say)
    print(text_table(scores))  # noqa: T201
    return scores


def text_table(scores: Sequence[Score]) -> str:
    """Medians over the seeds, one line for each level and follower."""
    width = [max(len(getattr(score, name)) for score in scores) for name in ("family", "level", "follower")]
    heads = ("family", "level", "follower")
    lines = [" ".join(f"{head:<{w}}" for head, w in zip(heads, width, strict=True))]
    lines[0] += "".join(f"{name:>15}" for name in (*SHOWN, "failed"))
    for score in scores:
        names = (score.family, score.level, score.follower)
        line = " ".join(f"{name:<{w}}" for name, w in zip(names, width, strict=True))
        line += "".join(f"{score.summary(name).median:15.4g}" for name in SHOWN)
        lines.append(line + f"{score.failures:>11}/{len(score.metrics)}")
    return "\n".join(lines)


def scores_of(cells: Sequence[Cell]) -> tuple[list[Score], list[Family]]:
    """Cells of single flights as scores of one family, whose levels are their scenarios."""
    titles = {cell.scenario: scenario_title(cell) for cell in cells}
    levels = tuple(Level(title, scenario) for scenario, title in titles.items())
    family = Family("scenarios", "what the command line asked for", "scenario", levels)
    scores = [Score(family.name, titles[cell.scenario], cell.follower, (cell.metrics,), cell) for cell in cells]
    return scores, [family]


def write_judgement(
    out: Path,
    setup: Config,
    scores: Sequence[Score],
    families: Sequence[Family],
    policies: Sequence[Policy],
    command: str,
    versions: Mapping[str, str],
) -> None:
    """Write `report.html` and `scores.json` into the directory `out`, which is made."""
    out.mkdir(parents=True, exist_ok=True)
    picture, text = _film(setup, scores, [policy.name for policy in policies])
    seeds = max(len(score.metrics) for score in scores)
    cards: dict[str, Mapping[str, Any]] = {policy.name: policy.card for policy in policies}
    report = page.Report(scores, families, seeds, command, versions, cards, picture, text)
    page.write_page(report, out / "report.html")
    records = {"command": command, "scores": [score.record() for score in scores]}
    (out / "scores.json").write_text(json.dumps(records, indent=1, allow_nan=False) + "\n")


def _film(setup: Config, scores: Sequence[Score], policies: Sequence[str]) -> tuple[bytes | None, str]:
    """The first level's flights of the copying follower and of the first policy, side by side."""
    first = [score for score in scores if (score.family, score.level) == (scores[0].family, scores[0].level)]
    wanted = [name for name in ("copy", *policies[:1]) if any(score.follower == name for score in first)]
    wanted = wanted or [first[0].follower]
    flights = [next(s for s in first if s.follower == name).shown.flight for name in wanted]
    picture, why = animate(setup.plant, flights)
    what = f"{' and '.join(wanted)}: {scores[0].family} {scores[0].level}, the first 10 s"
    return picture, what if picture else f"No animation: {why}."
