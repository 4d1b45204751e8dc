"""Figures: SVG text for the report, PNG files of single flights."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.evaluate.benchmark import Score, Summary
from mjxball.evaluate.results import RESULTS, Result, scenario_stem, scenario_title, to_json
from mjxball.files import write_whole
from mjxball.plotting import (
    INK,
    file_format,
    follower_styles,
    legend_above,
    line,
    logarithmic,
    pyplot,
    rendered,
    save,
    style,
)
from mjxball.sim.rollout import Trajectory

POINTS = 240  # of a curve over time
PAPER_POINTS = 700  # of a curve of the paper's figures
LEAST_SPAN = 0.01  # of an axis [m], [deg], [m/s2]
LEAST_ERROR = 1e-3  # of the axis of distances: less is rounding [mm]
LEAST_PEAK = 1e-4  # of the axis of peaks [m]
PANELS = (
    ("position", 0, "x [m]"),
    ("position", 1, "y [m]"),
    ("position", 2, "z [m]"),
    ("error", None, "distance to goal [mm]"),
    ("cg_offset", None, "CG offset [m]"),
    ("command", 0, "roll command [deg]"),
    ("command", 1, "pitch command [deg]"),
    ("command", 2, "vertical command [m/s²]"),
)
CG_STYLES = ("-", ":")  # along the line, or along x and y
NOT_DRAWN = ("stay", "random")  # they would flatten every scale


def of_followers(flight: Trajectory, index: int) -> np.ndarray:
    """(F, T) number `index` of every follower's command."""
    return flight.follower_command.reshape(len(flight.time), -1, 3)[..., index].T


def variant_curves(scores: Sequence[Score], axis: str) -> str:
    """Steady-state peak and settling over the variants of one suite, every follower with its interval."""
    plt, names = pyplot(), [name for name in dict.fromkeys(s.follower for s in scores) if name not in NOT_DRAWN]
    variants = list(dict.fromkeys(score.variant for score in scores))
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    looks = follower_styles(names)
    for panel, (metric, label) in zip(axes, (("peak", "steady-state peak [m]"), ("rmse", "RMSE [m]")), strict=True):
        for name in names:
            mine = {score.variant: score.summary(metric) for score in scores if score.follower == name}
            flown = [mine.get(variant, Summary(math.nan, math.nan, math.nan)) for variant in variants]
            rows = np.array([[one.median, one.low, one.high] for one in flown])
            rows[~np.isfinite(rows)] = np.nan
            panel.plot(range(len(variants)), rows[:, 0], markersize=4, label=name, **looks[name])
            shade = {"color": looks[name]["color"], "alpha": 0.15, "linewidth": 0}
            panel.fill_between(range(len(variants)), rows[:, 1], rows[:, 2], **shade)
        if any(np.isfinite(line.get_ydata()).any() for line in panel.lines):
            logarithmic(panel)
            panel.set_ylim(bottom=max(panel.get_ylim()[0], LEAST_PEAK))
        panel.set_ylabel(label)
        panel.set_xticks(range(len(variants)), variants, fontsize=8, rotation=15 if max(map(len, variants)) > 9 else 0)
        panel.set_xlabel(axis)
        panel.grid()
    legend_above(figure, axes[:1], 6)
    return rendered(figure, "svg").decode()


def flight_curves(scores: Sequence[Score]) -> str:
    """One variant's flights of seed 0: x and distance from the goal of the object, and the follower's pitch command."""
    plt, shown = pyplot(), [score for score in scores if score.follower not in NOT_DRAWN]
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(10, 5.8), layout="constrained")
    looks, first = follower_styles(score.follower for score in scores), scores[0].first.flight
    rows = np.unique(np.linspace(0, len(first.time) - 1, POINTS).astype(int))
    axes[0].plot(first.time[rows], first.target[rows, 0], color=INK, linestyle=":", linewidth=1, label="goal")
    for score in shown:
        flight, look = score.first.flight, line(looks[score.follower])
        axes[0].plot(flight.time[rows], flight.position[rows, 0], label=score.follower, **look)
        axes[1].plot(flight.time[rows], distance(flight)[rows], **look)
        for pitch in of_followers(flight, 1):
            axes[2].plot(flight.time[rows], np.degrees(pitch[rows]), **look)
    if shown:
        logarithmic(axes[1])
    for axis, label in zip(axes, ("x [m]", "distance to goal [mm]", "pitch command [deg]"), strict=True):
        axis.set_ylabel(label)
        axis.grid()
        axis.margins(x=0)
    axes[2].set_xlabel("time [s]")
    legend_above(figure, axes[:1], 6)
    return rendered(figure, "svg").decode()


def distance(flight: Trajectory) -> np.ndarray:
    """(T,) of O from its goal, for a logarithmic axis [mm]."""
    return np.maximum(1e3 * np.linalg.norm(flight.position - flight.target, axis=-1), LEAST_ERROR)


def heat_maps(scores: Sequence[Score]) -> str:
    """Steady-state peak over (CG speed, object mass), one map for each follower, all on one logarithmic scale."""
    speeds = sorted({score.first.scenario.omega for score in scores})
    masses = sorted({score.first.scenario.mass for score in scores})
    peaks: dict[str, np.ndarray] = {}
    for score in scores:
        table = peaks.setdefault(score.follower, np.full((len(masses), len(speeds)), np.nan))
        place = masses.index(score.first.scenario.mass), speeds.index(score.first.scenario.omega)
        table[place] = score.summary("peak").median
    plt = pyplot()
    from matplotlib.colors import LogNorm

    columns = min(4, len(peaks))
    rows = math.ceil(len(peaks) / columns)
    figure, axes = plt.subplots(rows, columns, figsize=(2.9 * columns, 2.5 * rows), squeeze=False, layout="constrained")
    image = None
    for axis, (name, table) in zip(axes.flat, peaks.items(), strict=False):
        shown = np.where(np.isfinite(table), table, np.nan)
        image = axis.imshow(shown, norm=LogNorm(1e-3, 1.0), cmap="viridis_r", aspect="auto", origin="lower")
        for (i, j), value in np.ndenumerate(table):
            text = "failed" if not math.isfinite(value) else f"{1e3 * value:.0f}"
            dark = math.isfinite(value) and value > 0.05
            axis.text(
                j,
                i,
                text,
                ha="center",
                va="center",
                fontsize=6,
                color="white" if dark else "black" if math.isfinite(value) else INK,
            )
        axis.set_xticks(range(len(speeds)), [f"{speed:g}" for speed in speeds], fontsize=7)
        axis.set_yticks(range(len(masses)), [f"{mass:g}" for mass in masses], fontsize=7)
        axis.set_title(name, fontsize=9)
    for axis in list(axes.flat)[len(peaks) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("CG speed [rad/s]", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("mass [kg]", fontsize=8)
    figure.colorbar(image, ax=axes, label="peak [m]", shrink=0.8, format="%g")
    return rendered(figure, "svg").decode()


def draw_flights(
    results: Sequence[Result], title: str, path: Path, panels: Sequence[tuple[str, int | None, str]] = PANELS
) -> None:
    """Draw all followers of one scenario over time, one of `PANELS` below the other.

    Position with the goal dotted, distance, CG offset (y dotted), or commands, the leader's thin. A panel or a curve
    without a finite number is left out.
    """
    plt = pyplot()
    panels = [panel for panel in panels if any(_is_known(_values(one.flight, *panel[:2])) for one in results)]
    wide = 7.5 if file_format() == "svg" else plt.rcParams["figure.figsize"][0]
    size = wide, 1.0 + len(panels) * (0.5 + 0.14 * wide)
    figure, grid = plt.subplots(len(panels), 1, sharex=True, figsize=size, layout="constrained", squeeze=False)
    axes = grid[:, 0]
    looks = follower_styles(result.follower for result in results)
    for axis, panel in zip(axes, panels, strict=True):
        _draw_panel(axis, results, looks, *panel)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    legend_above(figure, axes, 4 if wide > 5 else 3, title)
    save(figure, path)


def _is_known(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).any())


def _values(flight: Trajectory, kind: str, index: int | None) -> np.ndarray:
    """(curves, T) what a panel shows of `flight`; of commands the leader's is the last."""
    if kind == "position":
        return flight.position[None, :, index]
    if kind == "error":
        return distance(flight)[None]
    if kind == "cg_offset":
        return flight.cg_offset.reshape(len(flight.time), -1).T
    values = np.vstack([of_followers(flight, index or 0), flight.leader_command[None, :, index]])
    return values if index == 2 else np.degrees(values)


def _draw_panel(
    axis: Any, results: Sequence[Result], looks: dict[str, dict[str, Any]], kind: str, index: int | None, label: str
) -> None:
    time = results[0].flight.time

    def plot(values: np.ndarray, **given: Any) -> None:
        if _is_known(values):
            axis.plot(time, values, **given)

    if kind == "position":
        plot(results[0].flight.target[:, index], color=INK, linestyle=":", linewidth=1, label="goal")
    for number, result in enumerate(results):
        curves, look = _values(result.flight, kind, index), line(looks[result.follower])
        if kind == "cg_offset":
            if number and np.array_equal(result.flight.cg_offset, results[0].flight.cg_offset):
                continue
            shade = look["color"] if number else INK
            for along, dash, letter in zip(curves, CG_STYLES, "xy", strict=False):
                shown = f"CG along {letter}" if len(curves) > 1 and not number else None
                plot(along, color=shade, linewidth=1.2, linestyle=dash, label=shown)
            continue
        *followed, last = curves
        for values in followed:
            plot(values, **look)
        if kind == "position":
            look["label"] = result.follower
        elif kind == "command":
            look |= {"linewidth": max(0.5, 0.4 * look["linewidth"]), "label": None if number else "thin: leader"}
        plot(last, **look)
    if kind == "error":
        logarithmic(axis)
    low, high = axis.get_ylim()
    if high - low < LEAST_SPAN:  # rounding errors must not look like motion
        axis.set_ylim((low + high - LEAST_SPAN) / 2, (low + high + LEAST_SPAN) / 2)
    axis.set_ylabel(label, fontsize="small")
    axis.grid()
    axis.margins(x=0)


def write_results(results: Sequence[Result], out: Path, look: str = "screen") -> None:
    """Write `cells.json` and a PNG, or PDF of the style `paper`, for each scenario into `out`, which is made."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / RESULTS, to_json(results))
    with style(look):
        ending = "png" if file_format() == "svg" else file_format()
        for _, group in itertools.groupby(results, key=lambda result: result.scenario):
            same = list(group)
            draw_flights(same, scenario_title(same[0]), out / f"{scenario_stem(same[0])}.{ending}")


@dataclass(frozen=True)
class Figure:
    """One figure: its drawing, a caption, and a table of numbers computed from the curves."""

    name: str
    title: str
    number: int  # of the paper's figure
    picture: bytes  # a file of the style's format
    caption: str
    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def panels(heights: Sequence[float], columns: int = 1, sharex: bool = True) -> tuple[Any, np.ndarray]:
    """A figure of the style's width with panels (rows, columns) of `heights` [in for a width of 4.5 in] over time."""
    plt = pyplot()
    width = plt.rcParams["figure.figsize"][0]
    figure, axes = plt.subplots(
        len(heights),
        columns,
        sharex=sharex,
        figsize=(width, (sum(heights) + 0.5) * width / 4.5),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.grid()
        axis.margins(x=0)
    return figure, axes


def thinned(count: int) -> np.ndarray:
    """Rows of a curve of `count` that are drawn."""
    return np.unique(np.linspace(0, count - 1, PAPER_POINTS).astype(int))
