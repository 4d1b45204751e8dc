"""The report of scores: one HTML file that works offline, rendered from Jinja2 templates."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjxball.baselines import CONTROLLERS
from mjxball.bench.curves import flight_curves, heat_maps, variant_curves
from mjxball.bench.scores import RANKED, Score, Summary, by_variant, winners, wins
from mjxball.bench.suites import GRID, Suite
from mjxball.config import Plant
from mjxball.evaluate.render import film
from mjxball.files import write_atomically
from mjxball.policy import Policy

TEMPLATES = Path(__file__).parent / "templates"
UNITS = {"rmse": "m", "settling_time": "s", "x_peak": "m", "peak": "m", "max_tilt": "rad", "effort": "N"}
UNITS |= {"smoothness": "rad", "command_spread": "rad"}
COUNTED = {"peak": "steady-state peak", "rmse": "RMSE", "settling_time": "settling time", "overshoot": "overshoot"}
RIVALS = ("adaptive", "lqg", "lqg-slow")  # followers that others are compared with one by one
HIDDEN_METADATA = ("config", "plant", "observation", "action", "curve")  # long, and in the policy file
LEAD_START, LEAD_SECONDS, LEAD_SPEED = 15.0, 20.0, 3.0  # of the lead picture: the steady state of long flights

MADE = ("made", "How it was made")  # anchor and heading of the section at the end of every page

Row = dict[str, Any]


def write_report(
    out: Path,
    plant: Plant,
    scores: Sequence[Score],
    suites: Sequence[Suite],
    policies: Sequence[Policy],
    command: str,
    versions: Mapping[str, str],
) -> None:
    """Write `report.html` and `scores.json` into the directory `out`, which is created."""
    out.mkdir(parents=True, exist_ok=True)
    units = [f"{name} {UNITS.get(name, '')}".strip() for name in RANKED]
    picture, caption = lead_picture(plant, scores, [policy.name for policy in policies])
    context = {
        "title": "Suites of scenarios",
        "picture": base64.b64encode(picture).decode() if picture else "",
        "caption": caption,
        "pair": plant.count == 2,
        "num_seeds": max(len(score.metrics) for score in scores),
        "variants": len(by_variant(scores)),
        "verdict": verdict(scores),
        "wins": wins_by_suite(scores),
        "heads": ["suite", "variant", "follower", *units, "failed"],
        "suites": [_suite(suite, [score for score in scores if score.suite == suite.name]) for suite in suites],
        "followers": list(dict.fromkeys(score.follower for score in scores)),
        "rows": _rows(scores),
        "links": [("verdict", "Verdict"), ("all-scores", "All scores"), MADE, *((s.name, s.name) for s in suites)],
    }
    write_page("report.html", out / "report.html", context, policies, command, versions)
    records = {"command": command, "scores": [score.record() for score in scores]}
    write_atomically(out / "scores.json", json.dumps(records, indent=1, allow_nan=False) + "\n")


def write_page(
    template: str,
    path: Path,
    context: Mapping[str, Any],
    policies: Sequence[Policy],
    command: str,
    versions: Mapping[str, str],
) -> None:
    """Render `template` with `context` and the section on how the page was made."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    metadata = {
        p.name: {key: value for key, value in p.metadata.items() if key not in HIDDEN_METADATA} for p in policies
    }
    made = {
        "command": command,
        "versions": json.dumps(dict(versions), indent=1),
        "metadata": {name: json.dumps(one, indent=1, default=str) for name, one in metadata.items()},
    }
    write_atomically(path, environment.get_template(template).render(**context, **made))


def verdict(scores: Sequence[Score]) -> dict[str, Any]:
    """The table of followers: wins by each metric of `COUNTED`, failed flights, and comparisons with the `RIVALS`."""
    counts = {metric: wins(scores, metric) for metric in COUNTED}
    names = sorted(counts["peak"], key=lambda name: -counts["peak"][name])
    rivals = [name for name in RIVALS if name in names]
    failed = {name: sum(score.failures for score in scores if score.follower == name) for name in names}
    rows = []
    for name in names:
        cells = [{"text": str(sum(score.follower == name for score in scores)), "style": ""}]
        cells += [_count(count[name], max(count.values())) for count in counts.values()]
        cells.append({"text": str(failed[name]), "style": "" if failed[name] else "zero"})
        cells += [_comparison(scores, name, rival) for rival in rivals]
        rows.append({"follower": name, "cells": cells})
    heads = ["variants flown", *(f"smallest {label}" for label in COUNTED.values()), "failed flights"]
    return {"heads": [*heads, *(f"peak vs. {rival}" for rival in rivals)], "rows": rows}


def wins_by_suite(scores: Sequence[Score]) -> dict[str, Any]:
    """The table of suites: the number of variants in which each follower has the smallest steady-state peak."""
    total = wins(scores)
    names, rows = sorted(total, key=lambda name: -total[name]), []
    for suite in dict.fromkeys(score.suite for score in scores):
        mine = [score for score in scores if score.suite == suite]
        count = wins(mine)
        best = max(count.values())
        cells = [_count(count[name], best) if name in count else {"text": "–", "style": "zero"} for name in names]
        rows.append({"suite": suite, "total": len(by_variant(mine)), "cells": cells})
    return {"names": names, "rows": rows}


def compare(scores: Sequence[Score], follower: str, rival: str) -> tuple[int, int]:
    """Numbers of variants in which the steady-state peak of `follower` is (smaller, larger) than that of `rival`.

    A follower that failed in any seed of a variant counts as infinitely bad there. Variants that one of the two did not
    fly are not counted.
    """
    smaller = larger = 0
    for group in by_variant(scores).values():
        peaks = {s.follower: math.inf if s.failures else s.summary("peak").median for s in group}
        mine, other = peaks.get(follower, math.nan), peaks.get(rival, math.nan)
        smaller, larger = smaller + (mine < other), larger + (mine > other)  # NaN is neither
    return smaller, larger


def lead_picture(plant: Plant, scores: Sequence[Score], policies: Sequence[str]) -> tuple[bytes | None, str]:
    """(animated WebP, caption): copy, the best policy and the best other baseline on the first variant.

    (None, reason) if MuJoCo cannot render.
    """
    first = next(iter(by_variant(scores).values()))
    flown = [score.follower for score in first]
    count = {name: number for name, number in wins(scores).items() if name in flown}
    classical = [name for name in count if name in CONTROLLERS and name not in ("copy", "stay", "random")]
    trained = [name for name in count if name in policies]
    best = [max(names, key=lambda name: count[name]) for names in (trained, classical) if names]
    wanted = ["copy", *best]
    shown = [score for name in wanted for score in first if score.follower == name] or first[:1]
    start = LEAD_START if shown[0].first.flight.time[-1] >= LEAD_START + LEAD_SECONDS else 0.0
    flights = {score.follower: score.first.flight for score in shown}
    picture, why = film(plant, flights, LEAD_SECONDS, start, LEAD_SPEED)
    if picture is None:
        return None, f"No picture: {why}."
    names = ", ".join(flights)
    what = f"{shown[0].suite}, {shown[0].variant}, seed 0"
    alike = " with the same load" if len(flights) > 1 else ""
    return picture, f"{names}{alike} ({what}); green: the goal, yellow: the CG, ×{LEAD_SPEED:g}."


def _suite(suite: Suite, scores: Sequence[Score]) -> Row:
    grid = suite.name == GRID
    found: Row = {
        "name": suite.name,
        "about": suite.about,
        "axis": suite.axis,
        "grid": grid,
        "figure": "",
        "variants": [],
    }
    if grid:
        return {**found, "figure": heat_maps(scores)}
    if len(suite.variants) > 1:
        found["figure"] = variant_curves(scores, suite.axis)
    for (_, label), group in by_variant(scores).items():
        found["variants"].append({"label": label, "figure": flight_curves(group), "rows": _rows(group)})
    return found


def _rows(scores: Sequence[Score]) -> list[Row]:
    best = {key: winners(group, "peak") for key, group in by_variant(scores).items()}
    return [
        {
            "suite": score.suite,
            "variant": score.variant,
            "follower": score.follower,
            "best": score.follower in best[score.suite, score.variant],
            "cells": [
                *(_number(score.summary(name)) for name in RANKED),
                {"key": score.failures, "text": f"{score.failures}/{len(score.metrics)}", "interval": ""},
            ],
        }
        for score in scores
    ]


def _number(summary: Summary) -> Row:
    median, low, high = dataclasses.astuple(summary)
    if math.isnan(median):
        return {"key": "1e300", "text": "-", "interval": ""}
    if math.isinf(median):
        return {"key": "1e299", "text": "never", "interval": ""}
    end = f"{high:.3g}" if math.isfinite(high) else "never"
    return {"key": f"{median:.9g}", "text": f"{median:.3g}", "interval": "" if low == high else f"[{low:.3g}, {end}]"}


def _count(count: int, most: int) -> Row:
    return {"text": str(count), "style": "zero" if not count else "best" if count == most else ""}


def _comparison(scores: Sequence[Score], follower: str, rival: str) -> Row:
    if follower == rival:
        return {"text": "–", "style": "zero"}
    smaller, larger = compare(scores, follower, rival)
    return {"text": f"{smaller} : {larger}", "style": "best" if smaller > larger else ""}
