"""Figures: SVG text for the report, PNG files of single flights."""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.evaluate.benchmark import Score, Summary
from mjxball.evaluate.results import RESULTS, Result, scenario_stem, scenario_title, to_json
from mjxball.files import write_whole
from mjxball.plotting import logarithmic, pyplot, save
from mjxball.sim.rollout import Trajectory

POINTS = 240  # of a curve over time
PAPER_WIDTH, PAPER_POINTS = 4.5, 700  # [in] readable on a phone; points of a curve: of the paper's figures
COLOURS = {
    "copy": "#8a8a8a",
    "adaptive": "#d1495b",
    "adaptive-mass": "#edae49",
    "oracle": "#222222",
    "lqg": "#2e933c",
    "lqg-slow": "#9bc53d",
    "lqg-known-failures": "#1f6b4f",
    "memoryless": "#8d6a4f",
    "stay": "#b9a7c7",
    "random": "#d9c9b0",
}
POLICY_COLOURS = ("#1b6ca8", "#6f4a8e", "#00798c", "#c2571a", "#7a9e1f")
CYCLE = ("#1b6ca8", "#d1495b", "#2e933c", "#edae49", "#6f4a8e", "#00798c", "#8d6a4f", "#444444")  # in PNG files
LEAST_SPAN = 0.01  # of an axis [m], [deg], [m/s2]
LEAST_ERROR = 0.1  # of the axis of distances [mm]
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


def colours(names: Sequence[str]) -> dict[str, str]:
    """A colour for each follower: fixed for the baselines, in order for policies."""
    policies = [name for name in dict.fromkeys(names) if name not in COLOURS]
    chosen = {name: POLICY_COLOURS[k % len(POLICY_COLOURS)] for k, name in enumerate(policies)}
    return {**COLOURS, **chosen}


def of_followers(flight: Trajectory, index: int) -> np.ndarray:
    """(F, T) number `index` of every follower's command."""
    return flight.follower_command.reshape(len(flight.time), -1, 3)[..., index].T


def variant_curves(scores: Sequence[Score], axis: str) -> str:
    """Steady-state peak and settling over the variants of one suite, every follower with its interval."""
    plt, names = pyplot(), list(dict.fromkeys(score.follower for score in scores))
    variants = list(dict.fromkeys(score.variant for score in scores))
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), constrained_layout=True)
    shade = colours(names)
    for panel, (metric, label) in zip(axes, (("peak", "steady-state peak [m]"), ("rmse", "RMSE [m]")), strict=True):
        for name in names:
            if name in NOT_DRAWN:
                continue
            mine = {score.variant: score.summary(metric) for score in scores if score.follower == name}
            flown = [mine.get(variant, Summary(math.nan, math.nan, math.nan)) for variant in variants]
            rows = np.array([[one.median, one.low, one.high] for one in flown])
            rows[~np.isfinite(rows)] = np.nan
            panel.plot(range(len(variants)), rows[:, 0], marker="o", markersize=3, color=shade[name], label=name)
            panel.fill_between(range(len(variants)), rows[:, 1], rows[:, 2], color=shade[name], alpha=0.15, linewidth=0)
        if metric == "peak" and any(np.isfinite(line.get_ydata()).any() for line in panel.lines):
            logarithmic(panel)
            panel.set_ylim(bottom=max(panel.get_ylim()[0], LEAST_PEAK))
        panel.set_ylabel(label)
        panel.set_xticks(range(len(variants)), variants, fontsize=8, rotation=15 if max(map(len, variants)) > 9 else 0)
        panel.set_xlabel(axis)
        panel.grid(alpha=0.25)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=6, fontsize=8)
    return as_svg(figure)


def flight_curves(scores: Sequence[Score]) -> str:
    """One variant's flights of seed 0: object position along x and z, and the follower's pitch command."""
    plt, names = pyplot(), [score.follower for score in scores]
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(10, 5.6), constrained_layout=True)
    shade, first = colours(names), scores[0].shown.flight
    rows = np.unique(np.linspace(0, len(first.time) - 1, POINTS).astype(int))
    for axis, k in zip(axes[:2], (0, 2), strict=True):
        axis.plot(first.time[rows], first.target[rows, k], color="black", linestyle=":", linewidth=1)
        axis.set_ylabel(f"{'xyz'[k]} [m]")
    for score in scores:
        if score.follower in NOT_DRAWN:
            continue
        flight, style = score.shown.flight, {"color": shade[score.follower], "linewidth": 1.1}
        for axis, k in zip(axes[:2], (0, 2), strict=True):
            axis.plot(flight.time[rows], flight.position[rows, k], label=score.follower, **style)
        for pitch in of_followers(flight, 1):
            axes[2].plot(flight.time[rows], np.degrees(pitch[rows]), **style)
    axes[2].set_ylabel("pitch command [deg]")
    axes[2].set_xlabel("time [s]")
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.margins(x=0)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=6, fontsize=8)
    return as_svg(figure)


def heat_maps(scores: Sequence[Score]) -> str:
    """Steady-state peak over (CG speed, object mass), one map for each follower, all on one logarithmic scale."""
    speeds = sorted({score.shown.scenario.omega for score in scores})
    masses = sorted({score.shown.scenario.mass for score in scores})
    peaks: dict[str, np.ndarray] = {}
    for score in scores:
        table = peaks.setdefault(score.follower, np.full((len(masses), len(speeds)), np.nan))
        place = masses.index(score.shown.scenario.mass), speeds.index(score.shown.scenario.omega)
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
            axis.text(j, i, text, ha="center", va="center", fontsize=6, color="white" if dark else "black")
        axis.set_xticks(range(len(speeds)), [f"{speed:g}" for speed in speeds], fontsize=7)
        axis.set_yticks(range(len(masses)), [f"{mass:g}" for mass in masses], fontsize=7)
        axis.set_title(name, fontsize=9)
    for axis in list(axes.flat)[len(peaks) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("CG speed [rad/s]", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("mass [kg]", fontsize=8)
    figure.colorbar(image, ax=axes, label="peak [m]", shrink=0.8)
    return as_svg(figure)


def as_svg(figure: Any) -> str:
    """The figure as an `svg` element that scales with the page."""
    import matplotlib as mpl

    stream = io.StringIO()
    # Text stays text; ids are drawn from the content, so that figures of one page do not share clip paths.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": None, "font.family": "sans-serif"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    pyplot().close(figure)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r' d="[^"]*"', lambda found: re.sub(r"(\.\d\d)\d+", r"\1", found[0]), text)
    return re.sub(r'<svg([^>]*?) width="[^"]*"', r'<svg\1 role="img"', text, count=1).replace(
        ' height="', ' data-h="', 1
    )


def draw_flights(results: Sequence[Result], title: str, path: Path) -> None:
    """Draw all followers of one scenario over time: position and distance, CG offset (y dotted), all commands."""
    plt = pyplot()
    # Fixed margins: to fit them takes Matplotlib as long as to draw.
    margins = {"left": 0.115, "right": 0.985, "top": 0.96, "bottom": 0.035, "hspace": 0.1}
    figure, axes = plt.subplots(len(PANELS), 1, sharex=True, figsize=(9, 14.5), gridspec_kw=margins)
    for axis, panel in zip(axes, PANELS, strict=True):
        _draw_panel(axis, results, *panel)
    axes[0].legend(loc="lower right", ncol=3, fontsize="small")
    if results[0].flight.cg_offset.ndim > 1:  # in the plane
        axes[4].legend(loc="lower right", ncol=2, fontsize="small")
    axes[5].legend(loc="upper right", ncol=4, fontsize="small")
    axes[-1].set_xlabel("time [s]")
    axes[-1].xaxis.set_label_coords(0.5, -0.22)
    figure.suptitle(title, y=0.985)
    save(figure, path)
    plt.close(figure)


def _draw_panel(axis: Any, results: Sequence[Result], kind: str, index: int | None, label: str) -> None:
    time = results[0].flight.time
    if kind == "position":
        goal = results[0].flight.target[:, index]
        axis.plot(time, goal, color="black", linestyle=":", linewidth=1, label="goal")
    for number, (result, colour) in enumerate(zip(results, itertools.cycle(CYCLE), strict=False)):
        if kind == "position":
            axis.plot(time, result.flight.position[:, index], color=colour, linewidth=1.3, label=result.follower)
        elif kind == "error":
            error = 1e3 * np.linalg.norm(result.flight.position - result.flight.target, axis=1)
            axis.plot(time, np.maximum(error, LEAST_ERROR), color=colour, linewidth=1.1)
        elif kind == "cg_offset":
            moved = result.flight.cg_offset
            if number and np.array_equal(moved, results[0].flight.cg_offset):
                continue
            shade = colour if number else "black"
            for along, style, letter in zip(moved.reshape(len(time), -1).T, CG_STYLES, "xy", strict=False):
                shown = None if number else f"along {letter}"
                axis.plot(time, along, color=shade, linewidth=1.2, linestyle=style, label=shown)
        else:
            factor = 1.0 if index == 2 else 57.29577951308232
            flight, name = result.flight, None if number else "dashed: leader"
            for which, followed in enumerate(of_followers(flight, index or 0)):
                own = None if which else result.follower
                axis.plot(time, factor * followed, color=colour, linewidth=1.1, label=own)
            dashed: dict[str, Any] = {"linewidth": 0.8, "linestyle": "--", "alpha": 0.7, "label": name}
            axis.plot(time, factor * flight.leader_command[:, index], color=colour, **dashed)
    if kind == "error":
        logarithmic(axis)
    low, high = axis.get_ylim()
    if high - low < LEAST_SPAN:  # rounding errors must not look like motion
        axis.set_ylim((low + high - LEAST_SPAN) / 2, (low + high + LEAST_SPAN) / 2)
    axis.set_ylabel(label, fontsize="small")
    axis.yaxis.set_label_coords(-0.09, 0.5)  # to find a place for the labels takes as long as all else that is drawn
    axis.grid(alpha=0.25)
    axis.margins(x=0)


def write_results(results: Sequence[Result], out: Path) -> None:
    """Write `cells.json` and one PNG for each scenario into the directory `out`, which is made."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / RESULTS, to_json(results))
    for _, group in itertools.groupby(results, key=lambda result: result.scenario):
        same = list(group)
        draw_flights(same, scenario_title(same[0]), out / f"{scenario_stem(same[0])}.png")


@dataclass(frozen=True)
class Figure:
    """One figure: its drawing, a caption, and a table of numbers computed from the curves."""

    name: str
    title: str
    number: int  # of the paper's figure
    svg: str
    caption: str
    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def panels(heights: Sequence[float], columns: int = 1) -> tuple[Any, np.ndarray]:
    """A figure with panels (rows, columns) of `heights` [in] over one time axis."""
    figure, axes = pyplot().subplots(
        len(heights),
        columns,
        sharex=True,
        figsize=(PAPER_WIDTH, sum(heights) + 0.5),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.grid(alpha=0.25)
        axis.margins(x=0)
    return figure, axes


def legend_above(figure: Any, axes: Iterable[Any]) -> None:
    """One legend above the panels with every label of `axes`, each once."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles, loc="outside upper center", ncol=4, frameon=False)


def thinned(count: int) -> np.ndarray:
    """Rows of a curve of `count` that are drawn."""
    return np.unique(np.linspace(0, count - 1, PAPER_POINTS).astype(int))
