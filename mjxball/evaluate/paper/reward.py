"""The paper's Fig. 2: the return of an episode while the follower is trained, from the policies' cards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mjxball.errors import InputError
from mjxball.evaluate import svg
from mjxball.evaluate.paper.figure import Figure, Table, called, legend_above, listed, mimics, panels
from mjxball.policy import Policy

LINEAR = 10.0  # returns nearer to 0 than this are drawn on a linear scale, the others on a logarithmic one
PAPER_STEPS = 1_000_000  # that the paper trained for, "over a million time steps"
SHOWS = (
    "Return of an episode of 1000 steps while the followers were trained, read from their policy files: grey the "
    "exploring policy, in colour the deterministic one in fresh worlds, scaled to as many steps. The scale is "
    "logarithmic below -10."
)


@dataclass(frozen=True)
class Curve:
    """Training of one policy."""

    name: str
    mimics: bool  # it was trained on the paper's reward, whose optimum is 0
    steps: list[float]
    returns: list[float]  # of the exploring policy
    evaluated_steps: list[float]
    evaluated: list[float]  # returns of the deterministic policy


def read_curve(policy: Policy) -> Curve | None:
    """The curve in the card of `policy`, None if it has none; raise InputError if it is unsound."""
    stored = policy.card.get("curve")
    if stored is None:
        return None
    named = ("steps", "episode_return", "eval_steps", "eval_return")
    columns: list[Any] = [stored.get(name) for name in named] if isinstance(stored, dict) else []
    sound = bool(columns) and all(isinstance(column, list) and all(map(_is_number, column)) for column in columns)
    if not sound or not columns[0] or [*map(len, columns[::2])] != [*map(len, columns[1::2])]:
        raise InputError(f"the card of policy {policy.name} has an unsound training curve")
    return Curve(policy.name, mimics(policy), *columns)


def draw(policies: Sequence[Policy]) -> Figure:
    """Draw every curve that the policies have, one panel each: rewards of different kinds share no scale."""
    curves = [(policy.name, read_curve(policy)) for policy in policies]
    drawn = [curve for _, curve in curves if curve]
    without = [name for name, curve in curves if not curve]
    together = [p for p, (_, curve) in zip(policies, curves, strict=True) if curve and _is_several(p.card.get("seeds"))]
    several = [f"{called(p.name)} ({p.card['seeds']})" for p in together]
    shows = f"{SHOWS} Grey is the median of all that were trained together: {listed(several)}." if several else SHOWS
    agrees, differs = judged(drawn)
    if without:
        have = "has" if len(without) == 1 else "have"
        differs = (
            *differs,
            f"{listed([*map(called, without)])} {have} no training curve in the policy file and cannot be drawn.",
        )
    return Figure(
        name="reward",
        title="Training",
        number=2,
        drawing=_draw(drawn),
        shows=shows,
        table=_table(drawn) if drawn else None,
        agrees=agrees,
        differs=differs,
    )


def judged(curves: Sequence[Curve]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Whether the return rises as the paper says, over how many steps, and how far from the optimum it ends."""
    agrees, differs = [], []
    for curve in curves:
        name, first, last = called(curve.name), curve.returns[0], curve.returns[-1]
        rise = f"from {first:.4g} to {last:.4g} over {curve.steps[-1]:,.0f} steps"
        if last > first:
            agrees.append(f"The return of {name} rises {rise}.")
        else:
            differs.append(f"The return of {name} does not rise: it goes {rise}.")
        if not curve.mimics:
            differs.append(f"{name} was trained on our task reward, not on the paper's.")
        elif curve.evaluated:
            ended = curve.evaluated[-1]
            differs.append(f"{name} ends at {ended:.4g} without exploration; the known optimum is 0.")
            if last < ended:
                differs.append(f"Exploring, it has {last:.4g}: the rest is what its own noise costs.")
        if curve.steps[-1] < PAPER_STEPS:
            differs.append(f"{name} was trained for less than the paper's million steps.")
    return tuple(agrees), tuple(differs)


def _table(curves: Sequence[Curve]) -> Table:
    rows = []
    for curve in curves:
        last, best = (f"{curve.evaluated[-1]:.4g}", f"{max(curve.evaluated):.4g}") if curve.evaluated else ("-", "-")
        ends = (f"{curve.returns[0]:.4g}", f"{curve.returns[-1]:.4g}")
        rows.append((curve.name, "paper" if curve.mimics else "task (ours)", *ends, last, best))
    return Table(("follower", "reward", "first", "last", "last evaluated", "best evaluated"), tuple(rows))


def _draw(curves: Sequence[Curve]) -> str:
    from matplotlib.ticker import EngFormatter

    figure, axes = panels([2.0] * max(len(curves), 1))
    if not curves:
        axes[0, 0].text(0.5, 0.5, "no policy here has a training curve", ha="center", transform=axes[0, 0].transAxes)
    shade = svg.colours([curve.name for curve in curves])
    for axis, curve in zip(axes[:, 0], curves, strict=False):
        axis.plot(curve.steps, curve.returns, color="#9a9a9a", linewidth=1, label="exploring")
        style: dict[str, Any] = {"color": shade[curve.name], "marker": "o", "markersize": 3, "linewidth": 1.1}
        axis.plot(curve.evaluated_steps, curve.evaluated, label="evaluated, deterministic", **style)
        if curve.mimics:
            axis.axhline(0.0, color="black", linestyle=":", linewidth=1, label="optimum: copy the leader")
        axis.set_yscale("symlog", linthresh=LINEAR)
        axis.set_ylim(top=min(axis.get_ylim()[1], LINEAR / 2))
        axis.xaxis.set_major_formatter(EngFormatter())
        axis.set_title(curve.name)
        axis.set_ylabel("return of an episode")
    legend_above(figure, axes[:, 0])
    axes[-1, 0].set_xlabel("environment steps")
    return svg.as_text(figure)


def _is_several(seeds: Any) -> bool:
    return isinstance(seeds, int) and seeds > 1


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
