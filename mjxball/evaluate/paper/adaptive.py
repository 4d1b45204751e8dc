"""The paper's Fig. 3: the trained followers beside the adaptive controller."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.config import Config
from mjxball.control.followers import Follower, make_baseline
from mjxball.evaluate import svg
from mjxball.evaluate.cells import REFERENCE, Cell, run_cells
from mjxball.evaluate.page import COPYING, WHY_COPYING_LOSES
from mjxball.evaluate.paper.figure import (
    Figure,
    Table,
    called,
    draw_position,
    legend_above,
    listed,
    metres,
    mimics,
    panels,
    seconds,
)
from mjxball.policy import Policy
from mjxball.rollout import Trajectory

COPY, ADAPTIVE = "copy", "adaptive"
SWING = 0.01  # [m] on either side of the goal that an oscillation must pass
SHOWS = (
    "Position of the object's centre O over time, its goal dotted: CG ±0.05 m at 0.31 rad/s, object of 0.2 kg. The "
    "adaptive follower is ours, since the paper's is not public, and copy is the known optimum of the paper's reward. "
    "Swings: how often O passes from more than 1 cm on one side of its goal to more than 1 cm on the other, all axes. "
    "Peak: root of the squares of the largest errors along the three axes."
)


def swings(flight: Trajectory) -> int:
    """Passages of O from beyond `SWING` on one side of the goal to beyond it on the other, summed over x, y, z."""
    count = 0
    for error in flight.error.T:
        sides = np.sign(error[np.abs(error) > SWING])
        count += int(np.count_nonzero(np.diff(sides)))
    return count


def draw(setup: Config, policies: Sequence[Policy], physics: str) -> Figure:
    """Fly and draw."""
    followers: list[Follower] = [*(make_baseline(name, setup) for name in (COPY, ADAPTIVE)), *policies]
    cells = run_cells(setup, followers, [REFERENCE], physics)
    shade = svg.colours([cell.follower for cell in cells])
    figure, axes = panels([1.5] * 3)
    draw_position(axes[:, 0], cells, [{"color": shade[c.follower], "label": c.follower} for c in cells])
    axes[-1, 0].set_xlabel("time [s]")
    legend_above(figure, axes[:1, 0])
    agrees, differs = judged(cells, [policy.name for policy in policies if mimics(policy)])
    return Figure(
        name="adaptive",
        title="Beside the adaptive controller",
        number=3,
        drawing=svg.as_text(figure),
        shows=SHOWS,
        table=Table(
            ("follower", "swings", "overshoot", "peak after 20 s", "settles"), tuple(_row(cell) for cell in cells)
        ),
        agrees=agrees,
        differs=differs,
    )


def judged(cells: Sequence[Cell], copyists: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Sentences on what of "lesser oscillations, peaks, and better settling time" holds, and on what does not."""
    known = {cell.follower: cell for cell in cells}
    adaptive, agrees, differs = known[ADAPTIVE], [], []
    for name in (name for name in known if name not in (COPY, ADAPTIVE)):
        better, worse = _compared(known[name], adaptive)
        if better:
            agrees.append(f"{called(name)} beats adaptive in {listed(better)}.")
        if worse:
            differs.append(f"{called(name)} does not beat adaptive in {listed(worse)}.")
        if worse and name in copyists:
            differs.append(f"{called(name)} is a mimic. {WHY_COPYING_LOSES}")
    _, worse = _compared(known[COPY], adaptive)
    if worse:
        differs.append(
            f"copy, the most that a follower trained on the paper's reward can become, does not beat adaptive in "
            f"{listed(worse)}: to mimic better is to come nearer to that." + ("" if copyists else f" {COPYING}")
        )
    return tuple(agrees), tuple(differs)


def _compared(cell: Cell, adaptive: Cell) -> tuple[list[str], list[str]]:
    """What of the paper's claims `cell` does better than the adaptive follower, and what not, with both numbers."""
    mine, other = _claims(cell), _claims(adaptive)
    better: list[str] = []
    worse: list[str] = []
    for name, (value, text) in mine.items():
        against, written = other[name]
        (better if value < against else worse).append(f"{name} ({text} against {written})")
    if cell.metrics.failed:
        return [], ["anything, its flight failed"]
    return better, worse


def _claims(cell: Cell) -> dict[str, tuple[float, str]]:
    """Name -> (number, the same in words); less is better."""
    metrics, count, peak = cell.metrics, swings(cell.flight), steady_peak(cell)
    over, settled = metrics.overshoot, metrics.settling_time
    return {
        "swings": (count, f"{count}"),
        "overshoot": (math.inf if over is None else over, _percent(over)),
        "peak after 20 s": (peak, metres(peak)),
        "settling": (math.inf if settled is None else settled, seconds(settled)),
    }


def steady_peak(cell: Cell) -> float:
    """Root of the squared x, y, z peaks after 20 s [m], as the judge ranks; NaN of a shorter flight."""
    return cell.metrics.peak


def _row(cell: Cell) -> tuple[str, ...]:
    said = tuple(text for _, text in _claims(cell).values())
    return (f"{cell.follower} (failed)" if cell.metrics.failed else cell.follower, *said)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
