"""The paper's figures from our flights: reward, adaptive, speeds, masses, stand (`eval.py figures`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.plots import Figure, distance, panels, thinned
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.evaluate.scenarios import REFERENCE
from mjxball.evaluate.stand_figure import plot_stand
from mjxball.plotting import (
    INK,
    follower_styles,
    legend_above,
    line,
    logarithmic,
    pyplot,
    rendered,
    series_styles,
    style,
)
from mjxball.policy import Policy
from mjxball.sim.scenario import Scenario

NAMES = ("reward", "adaptive", "speeds", "masses", "stand")
SPEEDS = {f"{w:g} rad/s": Scenario(omega=w) for w in (0.31, 0.62, 1.0, 2.0, 3.1)}
MASSES = {f"{m:g} kg": Scenario(mass=m) for m in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)}
CHANGES = {
    f"{', '.join(f'{mass:+g} kg at {time:g} s' for time, mass in changes)}": Scenario(mass_changes=changes)
    for changes in (((15.0, 0.1),), ((15.0, -0.1),), ((12.0, 0.1), (24.0, -0.1)))
}
FONTS = {"font.size": 8, "axes.titlesize": 8.5}  # fonts of the style `screen` [pt]
ERROR_WINDOW = 3.0  # window of the largest error, for errors that oscillate fast [s]
SWING = 0.01  # smallest distance of a swing from the goal [m]
LINEAR = 10.0  # returns nearer to 0 are plotted on a linear scale, the others on a logarithmic one


def on_stand(policy: Policy) -> bool:
    """Whether `policy` was made for the test stand."""
    return policy.metadata["plant"].get("stand", "free") != "free"


def plot_figure(name: str, policies: Sequence[Policy], physics: str, look: str = "screen") -> Figure:
    """Fly and draw the figure `name` in the style `look`; see `check_figures`."""
    free = [policy for policy in policies if not on_stand(policy)]
    makers: dict[str, Callable[[], Figure]] = {
        "reward": lambda: plot_reward(free or policies),
        "adaptive": lambda: plot_adaptive(free, physics),
        "speeds": lambda: plot_speeds(free, physics),
        "masses": lambda: plot_masses(free, physics),
        "stand": lambda: plot_stand([policy for policy in policies if on_stand(policy)], physics),
    }
    with style(look), pyplot().rc_context(FONTS if look == "screen" else {}):
        return makers[name]()


def check_figures(names: Sequence[str], policies: Sequence[Policy]) -> None:
    """Raise InputError if one of the figures `names` lacks a policy or a valid training curve."""
    needy = [name for name in names if name in ("adaptive", "speeds", "masses")]
    if needy and all(on_stand(policy) for policy in policies):
        raise InputError(f"figure {needy[0]} needs a policy made for free flight")
    if "reward" in names and not policies:
        raise InputError("figure reward needs a policy, and none was given or is shipped")
    for policy in policies if "reward" in names else ():
        read_curve(policy)


@dataclass(frozen=True)
class Curve:
    """The training curve stored in a policy file's metadata."""

    steps: list[float]
    returns: list[float]  # of the exploring policy
    evaluated_steps: list[float]
    evaluated: list[float]  # returns of the deterministic policy


def read_curve(policy: Policy) -> Curve | None:
    """The training curve of `policy`, None if its file has none; InputError if it is invalid."""
    stored = policy.metadata.get("curve")
    if stored is None:
        return None
    named = ("steps", "episode_return", "eval_steps", "eval_return")
    columns: list[Any] = [stored.get(name) for name in named] if isinstance(stored, dict) else []
    valid = bool(columns) and all(isinstance(column, list) and all(map(_is_number, column)) for column in columns)
    if not valid or not columns[0] or [*map(len, columns[::2])] != [*map(len, columns[1::2])]:
        raise InputError(f"the metadata of policy {policy.name} has an unsound training curve")
    return Curve(*columns)


def plot_reward(policies: Sequence[Policy]) -> Figure:
    """Return of an episode during training, one panel per policy."""
    from matplotlib.ticker import EngFormatter

    curves = [(policy, curve) for policy in policies if (curve := read_curve(policy))]
    figure, axes = panels([2.0] * max(len(curves), 1), sharex=False)
    looks, rows = follower_styles(policy.name for policy in policies), []
    for axis, (policy, curve) in zip(axes[:, 0], curves, strict=False):
        mimics = _reward_kind(policy) == "paper"
        axis.plot(curve.steps, curve.returns, color=INK, linewidth=0.8, alpha=0.7, label="exploring")
        own = {**looks[policy.name], "markersize": 4, "clip_on": False}
        axis.plot(curve.evaluated_steps, curve.evaluated, label=f"{policy.name}, deterministic", **own)
        if mimics:
            axis.axhline(0.0, color=INK, linestyle=":", linewidth=1, label="optimum: copy the leader")
        logarithmic(axis, "symlog", linthresh=LINEAR)
        axis.set_ylim(top=min(axis.get_ylim()[1], LINEAR / 2))
        axis.xaxis.set_major_formatter(EngFormatter())
        axis.set(title=policy.name, ylabel="return of an episode", xlabel="environment steps")
        last = f"{curve.evaluated[-1]:.4g}" if curve.evaluated else "-"
        ends = (f"{curve.returns[0]:.4g}", f"{curve.returns[-1]:.4g}", last)
        rows.append((policy.name, "paper" if mimics else "task (ours)", f"{curve.steps[-1]:,.0f}", *ends))
    rows += [
        (p.name, "no training curve in its metadata", "-", "-", "-", "-") for p in policies if read_curve(p) is None
    ]
    legend_above(figure, axes[:, 0], 3)
    caption = (
        "Return of an episode of 1000 steps during training, from the policy files: grey the exploring policy, in "
        "colour the deterministic one. The scale is logarithmic below -10. The optimum of the paper's reward is 0."
    )
    heads = ("follower", "reward", "steps", "first", "last", "last evaluated")
    return Figure("reward", "Training", 2, rendered(figure), caption, heads, rows)


def plot_adaptive(policies: Sequence[Policy], physics: str) -> Figure:
    """The policies, `copy` and `adaptive` on the reference scenario."""
    setup = configs.preset("paper")
    followers: list[Follower] = [make_baseline("copy", setup), make_baseline("adaptive", setup), *policies]
    results = fly_scenarios(setup, followers, [REFERENCE], physics)
    looks = follower_styles(result.follower for result in results)
    figure, axes = panels([1.3, 1.3, 1.3, 1.7])
    _plot_flights([*axes[:, 0]], results, [{**line(looks[r.follower]), "label": r.follower} for r in results])
    axes[-1, 0].set_xlabel("time [s]")
    legend_above(figure, axes[:1, 0])
    rows = []
    for result in results:
        over = result.metrics.overshoot
        percent = "-" if over is None else f"{100 * over:.1f} %"
        rows.append((result.follower, str(swings(result.flight.error)), percent, *_settled(result)))
    caption = (
        "Position of the object's centre O, goal dotted, and its distance from there: CG ±0.05 m at 0.31 rad/s, "
        "object of 0.2 kg. The adaptive follower is ours; copy is the optimum of the paper's reward. Swings: passages "
        "of O from more than 1 cm on one side of its goal to more than 1 cm on the other, all axes. Peak: largest "
        "error after 20 s."
    )
    heads = ("follower", "swings", "overshoot", "peak", "settles")
    return Figure("adaptive", "Beside the adaptive controller", 3, rendered(figure), caption, heads, rows)


def swings(error: np.ndarray) -> int:
    """Number of swings of e_o (T, 3) from beyond `SWING` on one side of zero to the other side, summed over axes."""
    sides = [np.sign(along[np.abs(along) > SWING]) for along in error.T]
    return sum(int(np.count_nonzero(np.diff(side))) for side in sides)


def plot_speeds(policies: Sequence[Policy], physics: str) -> Figure:
    """Flights with five CG speeds, one column per policy, and one for `copy`."""
    setup = configs.preset("paper")
    columns = _fly([*policies, make_baseline("copy", setup)], SPEEDS, physics)
    caption = (
        "Position of O, goal dotted, and its largest distance from there in the next 3 s, for five speeds of the CG: "
        "±0.05 m along the rod, object of 0.2 kg."
    )
    return _variations("speeds", "CG speeds", 4, columns, caption, ERROR_WINDOW)


def plot_masses(policies: Sequence[Policy], physics: str) -> Figure:
    """Flights with several object masses: per policy a column of known masses and one of changes in flight."""
    known, changed = (_fly(policies, scenarios, physics) for scenarios in (MASSES, CHANGES))
    columns = [pair for both in zip(known, changed, strict=True) for pair in both]
    titles = ("known mass", "mass changes")
    columns = [(f"{name}, {titles[k % 2]}", results) for k, (name, results) in enumerate(columns)]
    caption = (
        "Position of O, goal dotted, and its distance from there: CG ±0.05 m at 0.31 rad/s. Known: the hover thrust "
        "assumes the true mass. Changes: mass added to or dropped from 0.2 kg in flight, unknown to the drones; "
        "the leader has no integral term."
    )
    return _variations("masses", "Object masses", 5, columns, caption)


Column = tuple[str, list[tuple[str, Result]]]  # title, (label, flight)


def _fly(followers: Sequence[Any], scenarios: Mapping[str, Scenario], physics: str) -> list[Column]:
    results = fly_scenarios(configs.preset("paper"), followers, [*scenarios.values()], physics)
    count = len(followers)
    return [(f.name, list(zip(scenarios, results[k::count], strict=True))) for k, f in enumerate(followers)]


def _variations(
    name: str, title: str, number: int, columns: Sequence[Column], caption: str, ahead: float = 0.0
) -> Figure:
    """x, y, z and error of each column's flights; two columns side by side, further ones below."""
    across = min(2, len(columns))
    figure, axes = panels([0.9, 0.9, 0.9, 1.4] * -(-len(columns) // across), across)
    looks, rows = series_styles(list(dict.fromkeys(label for _, flown in columns for label, _ in flown))), []
    places = [axes[4 * (k // across) : 4 * (k // across) + 4, k % across] for k in range(len(columns))]
    for axis in axes[-4:, 1:].flat if len(columns) % across else []:
        axis.set_visible(False)
    for k, (mine, (head, flown)) in enumerate(zip(places, columns, strict=True)):
        styles = [{**line(looks[label]), "linewidth": 1.0, "label": label} for label, _ in flown]
        _plot_flights([*mine], [result for _, result in flown], styles, ahead)
        mine[0].set_title(head)
        for axis in mine if k % across else []:
            axis.set_ylabel("")
        mine[-1].set_xlabel("time [s]")
        mine[-1].tick_params(labelbottom=True)
        rows += [(f"{head}, {label}", *_settled(result), _final(result)) for label, result in flown]
    errors = [mine[-1] for mine in places]
    low, high = zip(*(axis.get_ylim() for axis in errors), strict=True)
    for axis in errors:
        axis.set_ylim(min(low), max(high))
        logarithmic(axis)
    legend_above(figure, [mine[0] for mine in places], 2 if len(looks) > 6 else 3)
    heads = ("flown", "peak after 20 s", "settles", "error at the end")
    return Figure(name, title, number, rendered(figure), caption, heads, rows)


def _settled(result: Result) -> tuple[str, str]:
    """(steady-state peak, settling time) as text."""
    if result.metrics.failed:
        return "failed", "-"
    time = result.metrics.settling_time
    return f"{result.metrics.peak:.3f} m", "never" if time is None else f"{time:.1f} s"


def _final(result: Result) -> str:
    return "-" if result.metrics.failed else f"{np.linalg.norm(result.flight.error[-1]):.3f} m"


def _plot_flights(
    axes: Sequence[Any], results: Sequence[Result], styles: Sequence[dict[str, Any]], ahead: float = 0.0
) -> None:
    """Plot x, y, z of O with the goal dotted into three panels, and its distance from the goal into a fourth."""
    for k, axis in enumerate(axes[:3]):
        first = results[0].flight
        axis.plot(first.time, first.target[:, k], color=INK, linestyle=":", linewidth=1)
        axis.set_ylabel(f"{'xyz'[k]} [m]")
    for result, look in zip(results, styles, strict=True):
        rows = thinned(len(result.flight.time))
        values = *result.flight.position.T, _largest_ahead(distance(result.flight), result.flight.time, ahead)
        for axis, value in zip(axes, values, strict=True):
            axis.plot(result.flight.time[rows], value[rows], **look)
    logarithmic(axes[3])
    axes[3].set_ylabel("error [mm]")


def _largest_ahead(error: np.ndarray, time: np.ndarray, ahead: float) -> np.ndarray:
    """(T,) the largest `error` (T,) within the next `ahead` [s] of each time, which hides dips where it passes 0."""
    count = max(round(ahead / (time[1] - time[0])), 1)
    longer = np.concatenate([error, np.full(count - 1, error[-1])])
    return np.lib.stride_tricks.sliding_window_view(longer, count).max(axis=1)


def _reward_kind(policy: Policy) -> str | None:
    trained = policy.metadata.get("config")
    reward = trained.get("reward") if isinstance(trained, dict) else None
    return reward.get("kind") if isinstance(reward, dict) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
