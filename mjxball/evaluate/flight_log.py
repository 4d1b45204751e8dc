"""A recorded flight beside the simulation of the same commands: figures and numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjxball.evaluate.cells import Cell
from mjxball.evaluate.figures import COLOURS, draw_flights
from mjxball.plotting import pyplot

MOMENTS = (1.0, 2.0, 5.0, 10.0)  # [s] after the motors first turned
LOST = 0.25  # [m] of difference from which on a simulation that nobody steers says nothing more


def draw(cells: Sequence[Cell], stand: bool, leader_mount: Sequence[float], out: Path) -> list[Path]:
    """Draw a recorded flight, and a simulated one until it is `LOST`, into the directory `out`; the files written.

    The first is the figure of every simulated flight; of a `stand` there is the one of the paper's experiment too.
    """
    out.mkdir(parents=True, exist_ok=True)
    recorded, simulated = cells
    cells = [recorded, _cut(simulated, followed(recorded, simulated))]
    files = [out / "flight.png"]
    draw_flights(cells, files[0])
    if stand:
        files.append(out / "stand.png")
        _draw_stand(cells, np.array(leader_mount), files[1])
    return files


def _draw_stand(cells: Sequence[Cell], mount: np.ndarray, path: Path) -> None:
    """Leader's height, roll and the follower's vertical acceleration over time: the paper's Fig. 7."""
    plt = pyplot()
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(9, 7), constrained_layout=True)
    for cell, colour in zip(cells, COLOURS, strict=False):
        flight, roll = cell.flight, cell.flight.euler[:, 0]
        height = flight.position[:, 2] + np.cos(roll) * mount[2] + np.sin(roll) * mount[1]
        for axis, curve in zip(axes, (height, np.degrees(roll), flight.follower_command[:, 2]), strict=True):
            axis.plot(flight.time, curve, color=colour, linewidth=1.2, label=cell.follower)
    labels = ("leader's height [m]", "roll [deg]", "follower's vertical command [m/s²]")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label, fontsize="small")
        axis.grid(alpha=0.25)
        axis.margins(x=0)
    axes[0].legend(fontsize="small")
    axes[-1].set_xlabel("time since the motors first turned [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def differences(recorded: Cell, simulated: Cell) -> str:
    """How far both are apart, moment by moment: a table."""
    a, b = recorded.flight, simulated.flight
    moments = [moment for moment in MOMENTS if moment < a.time[-1]] + [float(a.time[-1])]
    lines = ["time s   position mm   height mm   roll deg   (largest difference until then)"]
    for moment in moments:
        rows = a.time <= moment
        apart = a.position[rows] - b.position[rows]
        roll = np.degrees(a.euler[rows, 0] - b.euler[rows, 0])
        numbers = np.linalg.norm(apart, axis=1).max(), np.abs(apart[:, 2]).max(), np.abs(roll).max()
        lines.append(f"{moment:6.1f}{1e3 * numbers[0]:14.1f}{1e3 * numbers[1]:12.1f}{numbers[2]:11.2f}")
    known = followed(recorded, simulated)
    if known < len(a.time):
        lines.append(
            f"nothing steers the simulation: {LOST:g} m away after {a.time[known]:.1f} s, it is not drawn from there on"
        )
    return "\n".join(lines)


def followed(recorded: Cell, simulated: Cell) -> int:
    """For how many rows the simulation is less than `LOST` from the recorded flight."""
    apart = np.linalg.norm(recorded.flight.position - simulated.flight.position, axis=1)
    lost = np.flatnonzero(~(apart < LOST))
    return int(lost[0]) if len(lost) else len(apart)


def _cut(cell: Cell, rows: int) -> Cell:
    """`cell` with nothing to draw of its motion after `rows`."""
    flight, parts = cell.flight, {}
    for name in ("position", "velocity", "euler", "cg_offset"):
        parts[name] = np.array(getattr(flight, name), float)
        parts[name][rows:] = np.nan
    return dataclasses.replace(cell, flight=dataclasses.replace(flight, **parts))
