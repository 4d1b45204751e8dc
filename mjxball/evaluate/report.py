"""Pages that work offline, rendered from Jinja2 templates; one of them is the report of flights."""

from __future__ import annotations

import base64
import dataclasses
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.baselines import CONTROLLERS
from mjxball.config import Plant
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.plots import PANELS, draw_flights
from mjxball.evaluate.render import film
from mjxball.evaluate.results import COLUMNS, Result, metric_text, scenario_title
from mjxball.files import write_atomically
from mjxball.plotting import rendered
from mjxball.policy import Policy

TEMPLATES = Path(__file__).parent / "templates"
SHOWN = (
    *("peak", "rmse", "settling_time", "overshoot", "x_peak", "max_tilt", "effort", "smoothness", "saturation"),
    *("rotors_at_limit", "rotor_power", "command_spread"),
)
FLOORS = ("stay", "random")  # their errors would dominate the scale of every curve
ORACLE = "oracle"
CURVES = tuple(PANELS[k] for k in (0, 3, 6))  # x, distance to the goal, pitch command
POINTS = 240  # of a curve over time
HIDDEN_METADATA = ("config", "plant", "observation", "action", "curve")  # long, and in the policy file
LEAD_START, LEAD_SECONDS, LEAD_SPEED = 15.0, 20.0, 3.0  # of the lead picture: the steady state of long flights
MADE = ("made", "How it was made")  # anchor and heading of the section at the end of every page
Row = dict[str, Any]


def write_report(
    out: Path,
    plant: Plant,
    results: Sequence[Result],
    policies: Sequence[Policy],
    command: str,
    versions: Mapping[str, str],
) -> None:
    """Write `report.html`, about results that are ordered by scenario, into the directory `out`, which is created."""
    out.mkdir(parents=True, exist_ok=True)
    scenarios = [list(group) for _, group in itertools.groupby(results, key=lambda result: result.scenario)]
    names = list(dict.fromkeys(result.follower for result in results))
    picture, caption = lead_picture(plant, results, [policy.name for policy in policies])
    columns = [name for name in SHOWN if any(not math.isnan(_value(result.metrics, name)) for result in results)]
    units = [COLUMNS[name][0].partition("\n")[2] for name in columns]
    rows = score_rows(scenarios, columns)
    context = {
        "title": "Flights of followers",
        "picture": base64.b64encode(picture).decode() if picture else "",
        "caption": caption,
        "pair": plant.count == 2,
        "heads": [f"{name} {unit}".strip() for name, unit in zip(columns, units, strict=True)],
        "rows": rows,
        "followers": names,
        "scenarios": list(dict.fromkeys(row["scenario"] for row in rows)),
        "flights": [{"title": scenario_title(group[0]), "figure": flight_curves(group)} for group in scenarios],
        "links": [("scores", "Scores"), ("flights", "Flights over time"), MADE],
    }
    write_page("report.html", out / "report.html", context, policies, command, versions)


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


def score_rows(scenarios: Sequence[Sequence[Result]], columns: Sequence[str]) -> list[Row]:
    """A row for each scenario and follower; before them, of several scenarios, each follower's medians over them."""
    groups = [
        (scenario_title(group[0]), {result.follower: [result.metrics] for result in group}) for group in scenarios
    ]
    if len(scenarios) > 1:
        flown: dict[str, list[Metrics]] = {}
        for result in itertools.chain(*scenarios):
            flown.setdefault(result.follower, []).append(result.metrics)
        groups.insert(0, (f"median of {len(scenarios)}", flown))
    rows = []
    for title, members in groups:
        best = _best(members)
        for name, metrics in members.items():
            failed = sum(one.failed for one in metrics)
            cells = [_cell(column, median(_value(one, column) for one in metrics)) for column in columns]
            cells.append({"key": failed, "text": f"{failed}/{len(metrics)}"})
            rows.append({"scenario": title, "follower": name, "best": name == best, "cells": cells})
    return rows


def _best(members: Mapping[str, Sequence[Metrics]]) -> str | None:
    """The follower with the smallest median peak, of several; the oracle, which knows the CG, is left out."""
    peaks = {name: median(_value(one, "peak") for one in flown) for name, flown in members.items() if name != ORACLE}
    finite = {name: peak for name, peak in peaks.items() if math.isfinite(peak)}
    return min(finite, key=lambda name: finite[name]) if finite and len(members) > 1 else None


def median(values: Iterable[float]) -> float:
    """Median of all `values` but NaN; of an even number the larger, so that no infinity is averaged away."""
    known = sorted(value for value in values if not math.isnan(value))
    return known[len(known) // 2] if known else math.nan


def _value(metrics: Metrics, name: str) -> float:
    """A metric: infinite where the flight failed or never settled, NaN where there is none."""
    if metrics.failed:
        return math.inf
    value = getattr(metrics, name)
    if value is None:
        return math.inf if name == "settling_time" else math.nan
    return float(value)


def _cell(name: str, value: float) -> Row:
    """A number as the printed table has it, and by what the page sorts it."""
    key = f"{value:.9g}" if math.isfinite(value) else "1e299" if math.isinf(value) else "1e300"
    return {"key": key, "text": metric_text(name, value)}


def flight_curves(results: Sequence[Result]) -> str:
    """Flights of one scenario as SVG: the object's x and distance from the goal, pitch commands."""
    rows = np.unique(np.linspace(0, len(results[0].flight.time) - 1, POINTS).astype(int))
    shown = [result for result in results if result.follower not in FLOORS] or results
    thinned = [dataclasses.replace(result, flight=result.flight.row(rows)) for result in shown]
    return rendered(draw_flights(thinned, None, CURVES), "svg").decode()


def lead_picture(plant: Plant, results: Sequence[Result], policies: Sequence[str]) -> tuple[bytes | None, str]:
    """(animated WebP, caption): copy, the best policy and the best other baseline on the first scenario.

    (None, reason) if MuJoCo cannot render.
    """
    first = {result.follower: result for result in results if result.scenario == results[0].scenario}
    peaks = {name: median(_value(one.metrics, "peak") for one in results if one.follower == name) for name in first}
    classical = [name for name in first if name in CONTROLLERS and name not in ("copy", ORACLE, *FLOORS)]
    trained = [name for name in first if name in policies]
    groups = [names for names in (trained, classical) if names]
    best = [min(names, key=lambda name: (math.isnan(peaks[name]), peaks[name])) for names in groups]
    shown = [name for name in ("copy", *best) if name in first] or [results[0].follower]
    flights = {name: first[name].flight for name in shown}
    start = LEAD_START if flights[shown[0]].time[-1] >= LEAD_START + LEAD_SECONDS else 0.0
    picture, why = film(plant, flights, LEAD_SECONDS, start, LEAD_SPEED)
    if picture is None:
        return None, f"No picture: {why}."
    alike = " with the same load" if len(flights) > 1 else ""
    what = scenario_title(results[0])
    return picture, f"{', '.join(shown)}{alike} ({what}); green: the goal, yellow: the CG, ×{LEAD_SPEED:g}."
