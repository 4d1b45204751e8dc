"""What the paper's figures share: a drawing with its caption, and how curves over time are drawn and described."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball.evaluate import svg
from mjxball.evaluate.cells import Cell
from mjxball.plotting import pyplot
from mjxball.policy import Policy

WIDTH = 4.5  # [in] of every drawing, so that its letters stay readable on a phone
POINTS = 700  # of a curve over time: 15 for each cycle of the fastest CG
# The letters of every drawing [pt].
LETTERS = {"font.size": 8, "axes.titlesize": 8.5, "legend.fontsize": 7.5, "legend.handlelength": 1.3}


@dataclass(frozen=True)
class Table:
    """Numbers of a caption; the first column names the row."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Figure:
    """One figure of the paper, drawn from our flights. Every number in it is computed from what is drawn."""

    name: str  # on the command line
    title: str
    number: int  # of the paper's figure
    drawing: str  # an svg element
    shows: str
    table: Table | None
    agrees: tuple[str, ...]  # with the paper's words, one sentence each
    differs: tuple[str, ...]

    def markup(self) -> str:
        """Heading, drawing and caption as HTML."""
        said = _said("Agrees with the paper:", self.agrees) + _said("Does not agree:", self.differs)
        return (
            f'<h2 id="{self.name}">{html.escape(self.title)} <small>(the paper\'s Fig. {self.number})</small></h2>'
            f'<figure class="paper">{self.drawing}<figcaption id="{self.name}-caption"><p>{html.escape(self.shows)}</p>'
            f"{_table(self.table)}{said}</figcaption></figure>"
        )


def _said(head: str, sentences: Sequence[str]) -> str:
    spoken = " ".join(sentences) or "nothing."
    return f"<p><b>{head}</b> {html.escape(spoken)}</p>"


def _table(table: Table | None) -> str:
    if table is None:
        return ""
    heads = "".join(f"<th>{html.escape(head)}</th>" for head in table.heads)
    rows = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in table.rows)
    return f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'


def panels(heights: Sequence[float], columns: int = 1) -> tuple[Any, np.ndarray]:
    """A figure with panels (rows, columns), as high as `heights` [in] say, over one axis of time."""
    figure, axes = pyplot().subplots(
        len(heights),
        columns,
        sharex=True,
        figsize=(WIDTH, sum(heights) + 0.5),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.grid(alpha=0.25)
        axis.margins(x=0)
    return figure, axes


def draw_position(axes: Iterable[Any], cells: Sequence[Cell], styles: Sequence[Mapping[str, Any]]) -> None:
    """x, y, z of O over time into three panels, the goal dotted."""
    for k, axis in enumerate(axes):
        target = cells[0].flight.target[:, k]
        axis.plot(cells[0].flight.time, target, color="black", linestyle=":", linewidth=1)
        for cell, style in zip(cells, styles, strict=True):
            rows = thinned(len(cell.flight.time))
            axis.plot(cell.flight.time[rows], cell.flight.position[rows, k], linewidth=1.1, **style)
        axis.set_ylabel(f"{'xyz'[k]} [m]")


def legend_above(figure: Any, axes: Iterable[Any], columns: int = 4) -> None:
    """One legend above the panels with every label of `axes`, each once."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles, loc="outside upper center", ncol=columns, frameon=False)


def thinned(count: int) -> np.ndarray:
    """At most `POINTS` of `count` rows, evenly, both ends included."""
    return np.unique(np.linspace(0, count - 1, POINTS).astype(int))


def mimics(policy: Policy) -> bool:
    """Whether `policy` was trained on the paper's reward, as far as its card says."""
    trained = policy.card.get("config")
    rewarded = trained.get("reward") if isinstance(trained, dict) else None
    return isinstance(rewarded, dict) and rewarded.get("kind") == "paper"


def called(name: str) -> str:
    """A follower in a sentence: policies in quotes, for one may be called `paper`."""
    return name if name in svg.COLOURS else f'"{name}"'


def metres(value: float | None) -> str:
    """A length as captions give it."""
    return "-" if value is None else f"{value:.3f} m"


def seconds(value: float | None) -> str:
    """A settling time as captions give it."""
    return "never" if value is None else f"{value:.1f} s"


def listed(words: Sequence[str]) -> str:
    """'a', 'a and b', 'a, b and c'."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1]))) if words else ""
