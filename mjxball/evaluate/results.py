"""Results of single flights: every follower on every scenario, as a table and as JSON."""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball import terminal
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics, fly_and_measure
from mjxball.sim.scenario import Scenario, of_plant
from mjxball.sim.trajectory import Trajectory

RESULTS = "cells.json"  # in the output directory
# The metrics in `--json`, a fixed format.
JSON_METRICS = (
    *("rmse", "settling_time", "overshoot", "x_peak", "y_peak", "z_peak", "plane_peak"),
    *("max_tilt", "action_error", "failed", "rotors_at_limit", "rotor_power", "command_spread"),
)


@dataclass(frozen=True)
class Result:
    """One follower on one scenario."""

    follower: str
    scenario: Scenario
    metrics: Metrics
    flight: Trajectory
    motion: str = "sine"  # how the CG moved: sine, waveform or rolling

    def record(self) -> dict[str, Any]:
        """The result as `eval.py --json` writes it (keys: docs/metrics.md).

        Only a motion other than a sine (omega and amplitude are then None) and mass changes add keys.
        """
        s = self.scenario
        believed = s.mass if s.believed_mass is None else s.believed_mass
        sine = self.motion == "sine"
        keys: dict[str, Any] = {
            "omega": s.omega if sine else None,
            "amplitude": s.amplitude if sine else None,
            "mass": s.mass,
            "believed_mass": believed,
        }
        if not sine:
            keys["motion"] = self.motion
        if s.mass_changes:
            keys["mass_changes"] = [list(change) for change in s.mass_changes]
        return {"follower": self.follower, **keys, **{name: getattr(self.metrics, name) for name in JSON_METRICS}}


def fly_scenarios(
    config: Config,
    followers: Sequence[Follower],
    scenarios: Sequence[Scenario],
    physics: str,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Result]:
    """Fly every follower through every scenario; results are ordered by scenario, then by follower.

    `progress` is called with the share that is flown.
    """
    scenarios = [of_plant(config, scenario) for scenario in scenarios]
    flights_of = [(follower, scenarios) for follower in followers]
    flights, measured = fly_and_measure(config, flights_of, physics, progress=progress)
    results = []
    for (i, scenario), (j, follower) in itertools.product(enumerate(scenarios), enumerate(followers)):
        index = j * len(scenarios) + i
        results.append(Result(follower.name, scenario, measured[index], flights.world(index), config.motion.kind))
    return results


# Of a table: metric -> its head, factor and digits.
COLUMNS = {
    "peak": ("peak\nm", 1.0, 4),
    "rmse": ("rmse\nm", 1.0, 3),
    "settling_time": ("settle\ns", 1.0, 2),
    "overshoot": ("over\n%", 100.0, 1),
    "x_peak": ("x-peak\nm", 1.0, 4),
    "y_peak": ("y-peak\nm", 1.0, 4),
    "z_peak": ("z-peak\nm", 1.0, 4),
    "plane_peak": ("plane\nm", 1.0, 4),
    "max_tilt": ("tilt\ndeg", 180 / math.pi, 1),
    "action_error": ("act.err\n", 1.0, 3),
    "effort": ("effort\nN", 1.0, 3),
    "smoothness": ("smooth.\nmrad", 1e3, 2),
    "saturation": ("satur.\n%", 100.0, 1),
    "rotors_at_limit": ("limit\n%", 100.0, 1),
    "rotor_power": ("power\nhover=1", 1.0, 3),
    "command_spread": ("spread\ndeg", 180 / math.pi, 2),
}
SHOWN = (
    *("rmse", "settling_time", "overshoot", "x_peak", "y_peak", "z_peak", "plane_peak", "max_tilt", "action_error"),
    *("rotors_at_limit", "rotor_power", "command_spread"),
)
MARK = "*"  # of what is flown on the reference scenario


def metric_text(name: str, value: float | None) -> str:
    """The metric `name` as tables have it: a dash for none, `never` for a flight that did not settle."""
    if name == "settling_time" and (value is None or value == math.inf):
        return "never"
    if value is None or math.isnan(value):
        return "-"
    _, factor, digits = COLUMNS[name]
    return "failed" if math.isinf(value) else f"{value * factor:.{digits}f}"


def table(results: Sequence[Result], reference: Scenario) -> str:
    """One line per result, and a line that explains them; `MARK` before those on the `reference` scenario."""
    # Where the load moves along a line, the error in the plane is hardly more than along it; a pair has no spread.
    in_plane = any(np.ndim(result.flight.cg_offset) > 1 for result in results)
    several = any(result.metrics.command_spread is not None for result in results)
    columns = [name for name in SHOWN if {"plane_peak": in_plane, "command_spread": several}.get(name, True)]
    conditions = {"omega": "omega\nrad/s", "amplitude": "ampl.\nm", "mass": "mass\nkg", "believed_mass": "believed\nkg"}
    records = [result.record() for result in results]
    if all(record["mass"] == record["believed_mass"] for record in records):
        del conditions["believed_mass"]
    failed = any(result.metrics.failed for result in results)
    rows = []
    for result, record in zip(results, records, strict=True):
        row = [MARK if result.scenario == reference else ""]
        row += ["-" if record[name] is None else f"{record[name]:g}" for name in conditions]
        row += [result.follower, *["FAILED" if result.metrics.failed else ""] * failed]
        rows.append([*row, *(metric_text(name, record[name]) for name in columns)])
    follower = 1 + len(conditions)
    heads = ["", *conditions.values(), "follower", *[""] * failed]
    shown = terminal.table(
        [*heads, *(COLUMNS[name][0] for name in columns)], rows, (follower, follower + failed), follower
    )
    return f"{shown}\n{terminal.fitted_to(sys.stdout, _legend(reference, results[0].motion))}"


def _legend(reference: Scenario, motion: str) -> str:
    sine = f"omega {reference.omega:g}, ampl. {reference.amplitude:g}, " if motion == "sine" else ""
    return (
        "x-peak is the largest |error along x| from 20 s on; act.err how far commands are from the leader's, rms; "
        "limit the time with a rotor at its limit; - says that there is none; "
        f"{MARK} the reference scenario, which is {sine}mass {reference.mass:g}"
    )


def to_json(results: Sequence[Result]) -> str:
    """`{"cells": [...]}`, the fixed format of `eval.py --json`."""
    return json.dumps({"cells": [result.record() for result in results]}, indent=2, allow_nan=False) + "\n"


def scenario_title(result: Result) -> str:
    """The scenario in words, as a figure's title."""
    s = result.scenario
    motion = {
        "sine": f"{s.amplitude:g} m at {s.omega:g} rad/s" if s.amplitude else "at rest",
        "waveform": "given waveform",
        "rolling": f"rolling ball from {s.ball_start:g} m",
    }
    believed = "" if s.believed_mass is None else f", believed {s.believed_mass:g} kg"
    changes = "".join(f", {mass:+g} kg at {time:g} s" for time, mass in s.mass_changes)
    return f"CG {motion[result.motion]}, object {s.mass:g} kg{believed}{changes}"


def scenario_stem(result: Result) -> str:
    """The scenario as the stem of a file name."""
    s = result.scenario
    motion = f"omega{s.omega:g}_amplitude{s.amplitude:g}" if result.motion == "sine" else result.motion
    believed = "" if s.believed_mass is None else f"_believed{s.believed_mass:g}"
    changes = "".join(f"_{mass:+g}kg_at{time:g}s" for time, mass in s.mass_changes)
    return f"{motion}_mass{s.mass:g}{believed}{changes}"
