"""Figures of flights as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjxball.evaluate.cells import Cell
from mjxball.plotting import pyplot

COLOURS = ("#1b6ca8", "#d1495b", "#2e933c", "#edae49", "#6f4a8e", "#00798c", "#8d6a4f", "#444444")
LEAST_SPAN = 0.01  # of an axis [m], [deg], [m/s2]
PANELS = (
    ("position", 0, "x [m]"),
    ("position", 1, "y [m]"),
    ("position", 2, "z [m]"),
    ("cg_offset", None, "CG offset [m]"),
    ("command", 0, "roll command [deg]"),
    ("command", 1, "pitch command [deg]"),
    ("command", 2, "vertical command [m/s²]"),
)


def scenario_title(cell: Cell) -> str:
    """What a figure says about its scenario."""
    s = cell.scenario
    moves = {
        "sine": f"{s.amplitude:g} m at {s.omega:g} rad/s",
        "waveform": "given waveform",
        "rolling": f"rolling ball from {s.ball_start:g} m",
    }
    believed = "" if s.believed_mass is None else f", believed {s.believed_mass:g} kg"
    changes = "".join(f", {mass:+g} kg at {time:g} s" for time, mass in s.mass_changes)
    return f"CG: {moves[cell.motion]}, object {s.mass:g} kg{believed}{changes}"


def scenario_name(cell: Cell) -> str:
    """Stem of a figure's file name."""
    s = cell.scenario
    motion = f"omega{s.omega:g}_amplitude{s.amplitude:g}" if cell.motion == "sine" else cell.motion
    believed = "" if s.believed_mass is None else f"_believed{s.believed_mass:g}"
    changes = "".join(f"_{mass:+g}kg_at{time:g}s" for time, mass in s.mass_changes)
    return f"{motion}_mass{s.mass:g}{believed}{changes}"


def draw_flights(cells: Sequence[Cell], path: Path) -> None:
    """Draw all followers of one scenario over time: position with goal, CG offset, both drones' commands."""
    plt = pyplot()
    figure, axes = plt.subplots(len(PANELS), 1, sharex=True, figsize=(9, 13), constrained_layout=True)
    for axis, panel in zip(axes, PANELS, strict=True):
        _draw_panel(axis, cells, *panel)
    axes[0].legend(loc="lower right", ncol=3, fontsize="small")
    axes[4].legend(loc="upper right", ncol=4, fontsize="small")
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(scenario_title(cells[0]))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_panel(axis: Any, cells: Sequence[Cell], kind: str, index: int | None, label: str) -> None:
    time = cells[0].flight.time
    if kind == "position":
        axis.axhline(cells[0].flight.goal[index], color="black", linestyle=":", linewidth=1, label="goal")
    for number, (cell, colour) in enumerate(zip(cells, _cycle(len(cells)), strict=True)):
        if kind == "position":
            axis.plot(time, cell.flight.position[:, index], color=colour, linewidth=1.3, label=cell.follower)
        elif kind == "cg_offset":
            axis.plot(time, cell.flight.cg_offset, color=colour, linewidth=1.2)
        else:
            factor = 1.0 if index == 2 else 57.29577951308232
            led, followed = cell.flight.leader_command, cell.flight.follower_command
            axis.plot(time, factor * followed[:, index], color=colour, linewidth=1.1, label=f"{cell.follower}")
            name = None if number else "dashed: their leaders"
            axis.plot(time, factor * led[:, index], color=colour, linewidth=0.8, linestyle="--", label=name, alpha=0.7)
    low, high = axis.get_ylim()
    if high - low < LEAST_SPAN:  # rounding errors must not look like motion
        axis.set_ylim((low + high - LEAST_SPAN) / 2, (low + high + LEAST_SPAN) / 2)
    axis.set_ylabel(label, fontsize="small")
    axis.grid(alpha=0.25)
    axis.margins(x=0)


def _cycle(count: int) -> list[str]:
    return [COLOURS[i % len(COLOURS)] for i in range(count)]
