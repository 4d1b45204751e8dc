"""The paper's figures from our own flights: reward, adaptive, speeds, masses, stand (`eval.py --figures`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.plots import Figure, as_svg, colours, legend_above, panels, thinned
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.evaluate.scenarios import REFERENCE
from mjxball.evaluate.stand_figure import draw_stand
from mjxball.evaluate.suites import BY_NAME
from mjxball.plotting import logarithmic, pyplot
from mjxball.policy import Policy

NAMES = ("reward", "adaptive", "speeds", "masses", "stand")
LETTERS = {"font.size": 8, "axes.titlesize": 8.5, "legend.fontsize": 7.5, "legend.handlelength": 1.3}  # [pt]
SWING = 0.01  # [m] on either side of the goal
LINEAR = 10.0  # returns nearer to 0 are drawn on a linear scale, the others on a logarithmic one


def find_figures(names: Sequence[str]) -> list[str]:
    """The figures called `names` in the paper's order, all of them for 'all'; InputError for an unknown one."""
    unknown = [name for name in names if name not in (*NAMES, "all")]
    if unknown:
        raise InputError(f"unknown figure {unknown[0]!r}; there are all, {', '.join(NAMES)}")
    if not names:
        raise InputError(f"--figures takes a name: all, {', '.join(NAMES)}")
    return [name for name in NAMES if name in names or "all" in names]


def on_stand(policy: Policy) -> bool:
    """Whether `policy` was made for the test stand."""
    return policy.card["plant"].get("stand", "free") != "free"


def draw_figure(name: str, policies: Sequence[Policy], physics: str) -> Figure:
    """Fly and draw the figure `name`; see `check_figures`."""
    free = [policy for policy in policies if not on_stand(policy)]
    makers: dict[str, Callable[[], Figure]] = {
        "reward": lambda: draw_reward(free or policies),
        "adaptive": lambda: draw_adaptive(free, physics),
        "speeds": lambda: draw_speeds(free, physics),
        "masses": lambda: draw_masses(free, physics),
        "stand": lambda: draw_stand([policy for policy in policies if on_stand(policy)], physics),
    }
    with pyplot().rc_context(LETTERS):
        return makers[name]()


def check_figures(names: Sequence[str], policies: Sequence[Policy]) -> None:
    """Raise InputError if one of the figures `names` lacks a policy or a sound training curve."""
    needy = [name for name in names if name in ("adaptive", "speeds", "masses")]
    if needy and all(on_stand(policy) for policy in policies):
        raise InputError(f"figure {needy[0]} needs a policy made for free flight")
    if "reward" in names and not policies:
        raise InputError("figure reward needs a policy, and none was given or is shipped")
    for policy in policies if "reward" in names else ():
        read_curve(policy)


@dataclass(frozen=True)
class Curve:
    """The training curve in a policy's card."""

    steps: list[float]
    returns: list[float]  # of the exploring policy
    evaluated_steps: list[float]
    evaluated: list[float]  # returns of the deterministic policy


def read_curve(policy: Policy) -> Curve | None:
    """The curve in the card of `policy`, None if it has none; InputError if it is unsound."""
    stored = policy.card.get("curve")
    if stored is None:
        return None
    named = ("steps", "episode_return", "eval_steps", "eval_return")
    columns: list[Any] = [stored.get(name) for name in named] if isinstance(stored, dict) else []
    sound = bool(columns) and all(isinstance(column, list) and all(map(_is_number, column)) for column in columns)
    if not sound or not columns[0] or [*map(len, columns[::2])] != [*map(len, columns[1::2])]:
        raise InputError(f"the card of policy {policy.name} has an unsound training curve")
    return Curve(*columns)


def draw_reward(policies: Sequence[Policy]) -> Figure:
    """Return of an episode over training, one panel for each policy."""
    from matplotlib.ticker import EngFormatter

    curves = [(policy, curve) for policy in policies if (curve := read_curve(policy))]
    figure, axes = panels([2.0] * max(len(curves), 1))
    shade, rows = colours([policy.name for policy in policies]), []
    for axis, (policy, curve) in zip(axes[:, 0], curves, strict=False):
        mimics = _reward_kind(policy) == "paper"
        axis.plot(curve.steps, curve.returns, color="#9a9a9a", linewidth=1, label="exploring")
        style: dict[str, Any] = {"color": shade[policy.name], "marker": "o", "markersize": 3, "linewidth": 1.1}
        axis.plot(curve.evaluated_steps, curve.evaluated, label="evaluated, deterministic", **style)
        if mimics:
            axis.axhline(0.0, color="black", linestyle=":", linewidth=1, label="optimum: copy the leader")
        logarithmic(axis, "symlog", linthresh=LINEAR)
        axis.set_ylim(top=min(axis.get_ylim()[1], LINEAR / 2))
        axis.xaxis.set_major_formatter(EngFormatter())
        axis.set(title=policy.name, ylabel="return of an episode")
        last = f"{curve.evaluated[-1]:.4g}" if curve.evaluated else "-"
        ends = (f"{curve.returns[0]:.4g}", f"{curve.returns[-1]:.4g}", last)
        rows.append((policy.name, "paper" if mimics else "task (ours)", f"{curve.steps[-1]:,.0f}", *ends))
    rows += [(p.name, "no training curve in its card", "-", "-", "-", "-") for p in policies if read_curve(p) is None]
    legend_above(figure, axes[:, 0])
    axes[-1, 0].set_xlabel("environment steps")
    caption = (
        "Return of an episode of 1000 steps during training, from the policy files: grey the exploring policy, in "
        "colour the deterministic one. The scale is logarithmic below -10. The optimum of the paper's reward is 0."
    )
    heads = ("follower", "reward", "steps", "first", "last", "last evaluated")
    return Figure("reward", "Training", 2, as_svg(figure), caption, heads, rows)


def draw_adaptive(policies: Sequence[Policy], physics: str) -> Figure:
    """The policies beside `copy` and `adaptive` on the reference scenario."""
    setup = configs.preset("paper")
    followers: list[Follower] = [make_baseline("copy", setup), make_baseline("adaptive", setup), *policies]
    results = fly_scenarios(setup, followers, [REFERENCE], physics)
    shade = colours([result.follower for result in results])
    figure, axes = panels([1.5] * 3)
    _draw_position(axes[:, 0], results, [{"color": shade[r.follower], "label": r.follower} for r in results])
    axes[-1, 0].set_xlabel("time [s]")
    legend_above(figure, axes[:1, 0])
    rows = []
    for result in results:
        over = result.metrics.overshoot
        percent = "-" if over is None else f"{100 * over:.1f} %"
        rows.append((result.follower, str(swings(result.flight.error)), percent, *_settled(result)))
    caption = (
        "Position of the object's centre O, goal dotted: CG ±0.05 m at 0.31 rad/s, object of 0.2 kg. The adaptive "
        "follower is ours; copy is the optimum of the paper's reward. Swings: passages of O from more than 1 cm on one "
        "side of its goal to more than 1 cm on the other, all axes. Peak: largest error after 20 s."
    )
    heads = ("follower", "swings", "overshoot", "peak", "settles")
    return Figure("adaptive", "Beside the adaptive controller", 3, as_svg(figure), caption, heads, rows)


def swings(error: np.ndarray) -> int:
    """Passages of e_o (T, 3) from beyond `SWING` on one side of zero to beyond it on the other, summed over axes."""
    sides = [np.sign(along[np.abs(along) > SWING]) for along in error.T]
    return sum(int(np.count_nonzero(np.diff(side))) for side in sides)


def draw_speeds(policies: Sequence[Policy], physics: str) -> Figure:
    """Five CG speeds: each policy a column, copying the last one."""
    setup = configs.preset("paper")
    columns = _fly_suite([*policies, make_baseline("copy", setup)], "cg-speed", physics, " rad/s")
    caption = "Position of O, goal dotted, for five speeds of the CG: ±0.05 m along the rod, object of 0.2 kg."
    return _variations("speeds", "CG speeds", 4, columns, caption)


def draw_masses(policies: Sequence[Policy], physics: str) -> Figure:
    """Object masses: for each policy a column of known ones and one of changes in flight."""
    known, changed = (_fly_suite(policies, name, physics) for name in ("mass-known", "mass-change"))
    columns = [pair for both in zip(known, changed, strict=True) for pair in both]
    titles = ("known mass", "mass changes")
    columns = [(f"{name}, {titles[k % 2]}", results) for k, (name, results) in enumerate(columns)]
    caption = (
        "Position of O, goal dotted: CG ±0.05 m at 0.31 rad/s. Known: the hover thrust assumes the true mass. Changes: "
        "mass added to or dropped from 0.2 kg in flight without telling the drones; the leader has no integral term."
    )
    return _variations("masses", "Object masses", 5, columns, caption)


Column = tuple[str, list[tuple[str, Result]]]  # title, (label, flight)


def _fly_suite(followers: Sequence[Any], name: str, physics: str, unit: str = "") -> list[Column]:
    suite = BY_NAME[name]
    results = fly_scenarios(configs.preset("paper"), followers, [v.seeded(0) for v in suite.variants], physics)
    labels = [variant.label + unit for variant in suite.variants]
    count = len(followers)
    return [(f.name, list(zip(labels, results[k::count], strict=True))) for k, f in enumerate(followers)]


def _variations(name: str, title: str, number: int, columns: Sequence[Column], caption: str) -> Figure:
    """x, y, z of each column's flights; two columns beside each other, the next ones below."""
    across = min(2, len(columns))
    figure, axes = panels([0.55, 1.1, 1.1, 1.1] * -(-len(columns) // across), across)
    shades, rows = pyplot().get_cmap("viridis"), []
    for k, axis in enumerate(axes.flat):
        axis.set_visible(k // (4 * across) * across + k % across < len(columns))
    for k, (head, flown) in enumerate(columns):
        top = 4 * (k // across)
        legend_axis, *mine = axes[top : top + 4, k % across]
        styles = [
            {"color": shades(0.9 * i / max(len(flown) - 1, 1)), "label": label} for i, (label, _) in enumerate(flown)
        ]
        _draw_position(mine, [result for _, result in flown], styles)
        legend_axis.set_title(head)
        legend_axis.axis("off")
        handles = mine[0].get_legend_handles_labels()
        legend = legend_axis.legend(*handles, loc="center", ncol=1 if len(flown) < 4 else 2, frameon=False)
        legend.set_in_layout(False)  # it may be wider than its panels
        for axis in mine if k % across else []:
            axis.set_ylabel("")
        mine[-1].set_xlabel("time [s]")
        mine[-1].tick_params(labelbottom=True)
        rows += [(f"{head}, {label}", *_settled(result), _final(result)) for label, result in flown]
    heads = ("flown", "peak after 20 s", "settles", "error at the end")
    return Figure(name, title, number, as_svg(figure), caption, heads, rows)


def _settled(result: Result) -> tuple[str, str]:
    """(steady-state peak, settling time) as text."""
    if result.metrics.failed:
        return "failed", "-"
    time = result.metrics.settling_time
    return f"{result.metrics.peak:.3f} m", "never" if time is None else f"{time:.1f} s"


def _final(result: Result) -> str:
    return "-" if result.metrics.failed else f"{np.linalg.norm(result.flight.error[-1]):.3f} m"


def _draw_position(axes: Iterable[Any], results: Sequence[Result], styles: Sequence[dict[str, Any]]) -> None:
    """x, y, z of O over time into three panels, the goal dotted."""
    for k, axis in enumerate(axes):
        first = results[0].flight
        axis.plot(first.time, first.target[:, k], color="black", linestyle=":", linewidth=1)
        for result, style in zip(results, styles, strict=True):
            rows = thinned(len(result.flight.time))
            axis.plot(result.flight.time[rows], result.flight.position[rows, k], linewidth=1.1, **style)
        axis.set_ylabel(f"{'xyz'[k]} [m]")


def _reward_kind(policy: Policy) -> str | None:
    trained = policy.card.get("config")
    reward = trained.get("reward") if isinstance(trained, dict) else None
    return reward.get("kind") if isinstance(reward, dict) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
