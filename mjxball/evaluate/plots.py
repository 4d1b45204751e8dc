"""Figures of flights over time."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.evaluate.results import RESULTS, Result, scenario_stem, scenario_title, to_json
from mjxball.files import write_atomically
from mjxball.plotting import (
    INK,
    file_format,
    follower_styles,
    legend_above,
    line,
    logarithmic,
    pyplot,
    save,
    style,
)
from mjxball.sim.trajectory import Trajectory

PAPER_POINTS = 700  # points per curve in the paper's figures
LEAST_SPAN = 0.01  # smallest range of an axis [m], [deg], [m/s2]
LEAST_ERROR = 1e-3  # lower end of the axis of distances: less is rounding [mm]
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


def of_followers(flight: Trajectory, index: int) -> np.ndarray:
    """(F, T) component `index` of every follower's command."""
    return flight.follower_command.reshape(len(flight.time), -1, 3)[..., index].T


def distance(flight: Trajectory) -> np.ndarray:
    """(T,) distance of O from its goal [mm], with a lower bound for logarithmic axes."""
    return np.maximum(1e3 * np.linalg.norm(flight.position - flight.target, axis=-1), LEAST_ERROR)


def plot_flights(
    results: Sequence[Result], title: str, path: Path, panels: Sequence[tuple[str, int | None, str]] = PANELS
) -> None:
    """Write the figure of `draw_flights` to `path`."""
    save(draw_flights(results, title, panels), path)


def draw_flights(
    results: Sequence[Result], title: str | None, panels: Sequence[tuple[str, int | None, str]] = PANELS
) -> Any:
    """Figure of the flights of all followers in one scenario over time, one panel of `PANELS` below the other.

    Position with the goal dotted, distance, CG offset (y dotted), commands (the leader's thin). A panel or curve
    without a finite value is left out.
    """
    plt = pyplot()
    panels = [panel for panel in panels if any(_is_known(_values(one.flight, *panel[:2])) for one in results)]
    wide = 7.5 if file_format() == "svg" else plt.rcParams["figure.figsize"][0]
    size = wide, 1.0 + len(panels) * (0.5 + 0.14 * wide)
    figure, grid = plt.subplots(len(panels), 1, sharex=True, figsize=size, layout="constrained", squeeze=False)
    axes = grid[:, 0]
    looks = follower_styles(result.follower for result in results)
    for axis, panel in zip(axes, panels, strict=True):
        _plot_panel(axis, results, looks, *panel)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    legend_above(figure, axes, 4 if wide > 5 else 3, title)
    return figure


def _is_known(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).any())


def _values(flight: Trajectory, kind: str, index: int | None) -> np.ndarray:
    """Curves (n, T) of one panel for `flight`; among commands the leader's is last."""
    if kind == "position":
        return flight.position[None, :, index]
    if kind == "error":
        return distance(flight)[None]
    if kind == "cg_offset":
        return flight.cg_offset.reshape(len(flight.time), -1).T
    values = np.vstack([of_followers(flight, index or 0), flight.leader_command[None, :, index]])
    return values if index == 2 else np.degrees(values)


def _plot_panel(
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
    """Write `cells.json` and, for each scenario, a PNG (PDF in the style `paper`) into `out`, which is created."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / RESULTS, to_json(results))
    with style(look):
        ending = "png" if file_format() == "svg" else file_format()
        for _, group in itertools.groupby(results, key=lambda result: result.scenario):
            same = list(group)
            plot_flights(same, scenario_title(same[0]), out / f"{scenario_stem(same[0])}.{ending}")


@dataclass(frozen=True)
class Figure:
    """One figure with its caption and a table of values computed from its curves."""

    name: str
    title: str
    number: int  # in the paper
    picture: bytes  # a file of the style's format
    caption: str
    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def panels(heights: Sequence[float], columns: int = 1, sharex: bool = True) -> tuple[Any, np.ndarray]:
    """A figure of the style's width with panels (rows, columns) of `heights` [in], for a width of 4.5 in, over time."""
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
    """Indices of the plotted points of a curve of `count` points."""
    return np.unique(np.linspace(0, count - 1, PAPER_POINTS).astype(int))
