"""Figures of the report, as SVG text."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.bench.scores import Score, Summary
from mjxball.evaluate.plots import distance, of_followers
from mjxball.plotting import INK, follower_styles, legend_above, line, logarithmic, pyplot, rendered

POINTS = 240  # of a curve over time
LEAST_PEAK = 1e-4  # lower end of the axis of peaks [m]
HIDDEN = ("stay", "random")  # their errors would dominate every scale


def variant_curves(scores: Sequence[Score], axis: str) -> str:
    """Steady-state peak and RMSE over the variants of one suite, with the interval of every follower, as SVG."""
    plt, names = pyplot(), [name for name in dict.fromkeys(s.follower for s in scores) if name not in HIDDEN]
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
    """Flights of one variant, seed 0, as SVG: the object's x and distance from the goal, pitch commands."""
    plt, shown = pyplot(), [score for score in scores if score.follower not in HIDDEN]
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


def heat_maps(scores: Sequence[Score]) -> str:
    """Steady-state peak over CG speed and object mass as SVG, one map per follower, all on one logarithmic scale."""
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
