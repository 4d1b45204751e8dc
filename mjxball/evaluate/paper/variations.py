"""The paper's Figs. 4 and 5: one trained follower at other CG speeds, and with other and with changing masses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mjxball.config import Config
from mjxball.control.followers import make_baseline
from mjxball.evaluate import svg
from mjxball.evaluate.cells import Cell, run_cells
from mjxball.evaluate.families import BY_NAME, Family
from mjxball.evaluate.paper.adaptive import COPY, steady_peak
from mjxball.evaluate.paper.figure import Figure, Table, called, draw_position, listed, metres, panels, seconds
from mjxball.plotting import pyplot
from mjxball.policy import Policy

HEADS = ("flown", "peak after 20 s", "settles", "off its goal at the end")
NEAR = 0.9  # of copying's peak: from there on a follower does hardly anything that copying would not
TITLES = {"mass-known": "known mass", "mass-change": "mass changes"}
NOUNS = {"cg-speed": "CG speed", "mass-known": "known object mass", "mass-change": "change of mass in flight"}
Flown = dict[str, list[tuple[str, Cell]]]  # follower -> (label of the level, its flight)


def draw_speeds(setup: Config, policies: Sequence[Policy], physics: str) -> Figure:
    """Fly and draw the CG speeds: each policy a column, copying the last one."""
    family = BY_NAME["cg-speed"]
    flown = _fly(setup, [*policies, make_baseline(COPY, setup)], family, physics)
    columns = list(flown.items())
    differs = [*_failed(family, flown, policies), *_unsettled(family, flown, policies)]
    differs += [sentence for policy in policies for sentence in _like_copy(policy.name, flown)]
    return Figure(
        name="speeds",
        title="CG speeds",
        number=4,
        drawing=_columns(columns),
        shows=(
            "Position of O for five speeds of the CG, ±0.05 m along the rod, object of 0.2 kg, goal dotted. The last "
            "column, copying, is not in the paper: what is no better than that is not the follower's doing."
        ),
        table=_table(columns),
        agrees=tuple(_stable(family, flown, policies)),
        differs=tuple(differs),
    )


def draw_masses(setup: Config, policies: Sequence[Policy], physics: str) -> Figure:
    """Fly and draw the object masses: for each policy a column of known ones and one of changes in flight."""
    known, changed = BY_NAME["mass-known"], BY_NAME["mass-change"]
    flown = {family.name: _fly(setup, policies, family, physics) for family in (known, changed)}
    columns = [
        (f"{policy.name}, {TITLES[family.name]}", flown[family.name][policy.name])
        for policy in policies
        for family in (known, changed)
    ]
    agrees = [sentence for family in (known, changed) for sentence in _stable(family, flown[family.name], policies)]
    differs = [
        sentence
        for judged in (_failed, _unsettled)
        for family in (known, changed)
        for sentence in judged(family, flown[family.name], policies)
    ]
    return Figure(
        name="masses",
        title="Object masses",
        number=5,
        drawing=_columns(columns),
        shows=(
            "Position of O, goal dotted, CG ±0.05 m at 0.31 rad/s. Left: objects whose mass the hover thrust is told. "
            "Right: mass added to or dropped from an object of 0.2 kg in flight, of which nobody is told; the leader "
            "has no integral term, so that what the follower does not carry stays as a height error. The paper does "
            "not say which of the two its figure shows."
        ),
        table=_table(columns),
        agrees=tuple(agrees),
        differs=tuple(differs),
    )


def _fly(setup: Config, followers: Sequence[Any], family: Family, physics: str) -> Flown:
    cells = run_cells(setup, followers, [level.seeded(0) for level in family.levels], physics)
    unit = " rad/s" if family.name == "cg-speed" else ""
    labels = [level.label + unit for level in family.levels]
    return {
        follower.name: list(zip(labels, cells[k :: len(followers)], strict=True))
        for k, follower in enumerate(followers)
    }


def _stable(family: Family, flown: Flown, policies: Sequence[Policy]) -> list[str]:
    """Who "can stably tolerate" every level, as the paper says."""
    fine = [called(p.name) for p in policies if not any(cell.metrics.failed for _, cell in flown[p.name])]
    return [f"At every {NOUNS[family.name]} the pair flies stably with {listed(fine)}."] if fine else []


def _failed(family: Family, flown: Flown, policies: Sequence[Policy]) -> list[str]:
    fell = {p.name: [label for label, cell in flown[p.name] if cell.metrics.failed] for p in policies}
    return [
        f"{called(name)} fails at {_where(family, labels, flown, 'every')}." for name, labels in fell.items() if labels
    ]


def _unsettled(family: Family, flown: Flown, policies: Sequence[Policy]) -> list[str]:
    sentences = []
    for policy in policies:
        never = [
            (label, cell)
            for label, cell in flown[policy.name]
            if cell.metrics.settling_time is None and not cell.metrics.failed
        ]
        if never:
            label, cell = max(never, key=lambda pair: steady_peak(pair[1]))
            where = _where(family, [label for label, _ in never], flown, "any")
            off = f"it is up to {metres(steady_peak(cell))} off after 20 s, at {label}"
            sentences.append(f"{called(policy.name)} does not settle at {where}: {off}.")
    return sentences


def _where(family: Family, labels: Sequence[str], flown: Flown, all_of_them: str) -> str:
    """The levels `labels`, or in one word all of them."""
    everything = len(labels) == len(next(iter(flown.values())))
    return f"{all_of_them} {NOUNS[family.name]}" if everything else listed(labels)


def _like_copy(name: str, flown: Flown) -> list[str]:
    pairs = zip(flown[name], flown[COPY], strict=True)
    near = [
        f"{label} ({metres(steady_peak(mine))} against {metres(steady_peak(copied))})"
        for (label, mine), (_, copied) in pairs
        if not mine.metrics.failed and steady_peak(mine) > NEAR * steady_peak(copied)
    ]
    return [f"{called(name)} peaks hardly lower than copying, or higher, at {listed(near)}."] if near else []


def _table(columns: Sequence[tuple[str, Sequence[tuple[str, Cell]]]]) -> Table:
    rows = []
    for title, cells in columns:
        for label, cell in cells:
            end = float((cell.flight.error[-1] ** 2).sum() ** 0.5)
            numbers = (metres(steady_peak(cell)), seconds(cell.metrics.settling_time), metres(end))
            rows.append((f"{title}, {label}", *(("failed", "-", "-") if cell.metrics.failed else numbers)))
    return Table(HEADS, tuple(rows))


def _columns(columns: Sequence[tuple[str, Sequence[tuple[str, Cell]]]]) -> str:
    """Title, legend, x, y, z of each column's flights; two columns stand beside each other, the next ones below."""
    across = min(2, len(columns))
    figure, axes = panels([0.55, 1.1, 1.1, 1.1] * -(-len(columns) // across), across)
    shades = pyplot().get_cmap("viridis")
    for number, axis in enumerate(axes.flat):
        axis.set_visible(number // (4 * across) * across + number % across < len(columns))
    for number, (title, cells) in enumerate(columns):
        top = 4 * (number // across)
        head, *mine = axes[top : top + 4, number % across]
        colours = [shades(0.9 * k / max(len(cells) - 1, 1)) for k in range(len(cells))]
        styles = [{"color": colour, "label": label} for colour, (label, _) in zip(colours, cells, strict=True)]
        draw_position(mine, [cell for _, cell in cells], styles)
        head.set_title(title)
        head.axis("off")
        labels = mine[0].get_legend_handles_labels()
        legend = head.legend(*labels, loc="center", ncol=1 if len(cells) < 4 else 2, frameon=False)
        legend.set_in_layout(False)  # it may be wider than its panels
        for axis in mine if number % across else []:
            axis.set_ylabel("")
        mine[-1].set_xlabel("time [s]")
        mine[-1].tick_params(labelbottom=True)
    return svg.as_text(figure)
