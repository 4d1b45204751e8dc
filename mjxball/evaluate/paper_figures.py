"""The paper's figures from our own flights: reward, adaptive, speeds, masses, stand (`eval.py --figures`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.config import Config, ball_limit
from mjxball.control import rotations
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.metrics import STEADY_AFTER
from mjxball.evaluate.plots import as_svg, colours
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.evaluate.scenarios import REFERENCE
from mjxball.evaluate.suites import BY_NAME
from mjxball.plotting import pyplot
from mjxball.policy import Policy
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

NAMES = ("reward", "adaptive", "speeds", "masses", "stand")
WIDTH, POINTS = 4.5, 700  # [in] of a drawing, so that its letters stay readable on a phone; points of a curve
LETTERS = {"font.size": 8, "axes.titlesize": 8.5, "legend.fontsize": 7.5, "legend.handlelength": 1.3}  # [pt]
SWING = 0.01  # [m] on either side of the goal
LINEAR = 10.0  # returns nearer to 0 are drawn on a linear scale, the others on a logarithmic one
SETTINGS = {"paper": "the paper's gains", "better": "better settings"}
# The leader's height loop of free flight with a quarter of its integral, and thrust by the motors' curve.
BETTER = {
    "leader.kp": (1.0, 1.0, 4.0),
    "leader.kd": (2.0, 2.0, 3.5),
    "leader.ki": (0.2, 0.1, 0.5),
    "autopilot.thrust_law": "calibrated",
}
LEVEL = 0.08  # height of the leader at rest on the level stand, its goal p_l^d (paper) [m]
# Slightly off (ours): 3 degrees of roll, 3 cm too low, the ball 3 cm from the middle and at rest.
STAND_START = Scenario(
    amplitude=0.0,
    mass=configs.preset("stand").plant.object_mass,
    goal=(0.0, 0.0, 0.0),
    start_position=(0.0, 0.0, -0.03),
    start_tilt=(0.0524, 0.0),
    ball_start=0.03,
    seconds=60.0,
)


@dataclass(frozen=True)
class Figure:
    """One figure: its drawing, a caption, and a table of numbers computed from the curves."""

    name: str
    title: str
    number: int  # of the paper's figure
    svg: str
    caption: str
    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


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


# --- Fig. 2: training ------------------------------------------------------------------------------------------------


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
    figure, axes = _panels([2.0] * max(len(curves), 1))
    shade, rows = colours([policy.name for policy in policies]), []
    for axis, (policy, curve) in zip(axes[:, 0], curves, strict=False):
        mimics = _reward_kind(policy) == "paper"
        axis.plot(curve.steps, curve.returns, color="#9a9a9a", linewidth=1, label="exploring")
        style: dict[str, Any] = {"color": shade[policy.name], "marker": "o", "markersize": 3, "linewidth": 1.1}
        axis.plot(curve.evaluated_steps, curve.evaluated, label="evaluated, deterministic", **style)
        if mimics:
            axis.axhline(0.0, color="black", linestyle=":", linewidth=1, label="optimum: copy the leader")
        axis.set_yscale("symlog", linthresh=LINEAR)
        axis.set_ylim(top=min(axis.get_ylim()[1], LINEAR / 2))
        axis.xaxis.set_major_formatter(EngFormatter())
        axis.set(title=policy.name, ylabel="return of an episode")
        last = f"{curve.evaluated[-1]:.4g}" if curve.evaluated else "-"
        ends = (f"{curve.returns[0]:.4g}", f"{curve.returns[-1]:.4g}", last)
        rows.append((policy.name, "paper" if mimics else "task (ours)", f"{curve.steps[-1]:,.0f}", *ends))
    rows += [(p.name, "no training curve in its card", "-", "-", "-", "-") for p in policies if read_curve(p) is None]
    _legend(figure, axes[:, 0])
    axes[-1, 0].set_xlabel("environment steps")
    caption = (
        "Return of an episode of 1000 steps during training, from the policy files: grey the exploring policy, in "
        "colour the deterministic one. The scale is logarithmic below -10. The optimum of the paper's reward is 0."
    )
    heads = ("follower", "reward", "steps", "first", "last", "last evaluated")
    return Figure("reward", "Training", 2, as_svg(figure), caption, heads, rows)


# --- Figs. 3 to 5: free flight ---------------------------------------------------------------------------------------


def draw_adaptive(policies: Sequence[Policy], physics: str) -> Figure:
    """The policies beside `copy` and `adaptive` on the reference scenario."""
    setup = configs.preset("paper")
    followers: list[Follower] = [make_baseline("copy", setup), make_baseline("adaptive", setup), *policies]
    results = fly_scenarios(setup, followers, [REFERENCE], physics)
    shade = colours([result.follower for result in results])
    figure, axes = _panels([1.5] * 3)
    _draw_position(axes[:, 0], results, [{"color": shade[r.follower], "label": r.follower} for r in results])
    axes[-1, 0].set_xlabel("time [s]")
    _legend(figure, axes[:1, 0])
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
    figure, axes = _panels([0.55, 1.1, 1.1, 1.1] * -(-len(columns) // across), across)
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


# --- Fig. 7: the test stand ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StandFlight:
    """A flight on the stand, one row per control step."""

    time: np.ndarray  # (T,) [s]
    height: np.ndarray  # (T,) of the leader, `LEVEL` where the stick is level and O at its goal [m]
    roll: np.ndarray  # (T,) of the assembly [rad]
    vertical: np.ndarray  # (T,) follower's vertical acceleration command [m/s2]
    ball: np.ndarray  # (T,) from O along the stick, towards the leader [m]

    @property
    def steady(self) -> np.ndarray:
        """(T,) true from 20 s on."""
        return self.time >= STEADY_AFTER

    @property
    def roll_rms(self) -> float:
        """Root mean square of the roll after 20 s [deg]."""
        return float(np.degrees(np.sqrt(np.mean(self.roll[self.steady] ** 2))))

    @property
    def ball_range(self) -> float:
        """Distance between the ball's outermost positions after 20 s [m]."""
        return float(np.ptp(self.ball[self.steady]))

    @property
    def height_peak(self) -> float:
        """Largest height error of the leader after 20 s [m]."""
        return float(np.abs(self.height[self.steady] - LEVEL).max())


def stand_config(settings: str = "paper") -> Config:
    """The preset `stand`, with the paper's settings of the leader or `better` ones."""
    config = configs.preset("stand")
    for name, value in BETTER.items() if settings == "better" else ():
        config = configs.replace(config, name, value)
    return configs.validate(config)


def fly_stand(config: Config, follower: Follower, leader_error: bool, physics: str, scenario: Scenario) -> StandFlight:
    """Fly `follower` on the stand; it sees the object's error or, with `leader_error`, the leader's, as in the paper.

    The leader's law is eq. 5 on e_l = p_l^d - p_l, p_l^d its position when the stick is level and O at its goal.
    """
    config = configs.replace(config, "follower.error", "leader" if leader_error else "object")
    flown = simulate(config, follower, scenario, physics)
    lever = rotations.rotate(rotations.matrix_from_quaternion(flown.quaternion), np.array(config.plant.leader_mount))
    rise = flown.position[:, 2] - flown.target[:, 2] + lever[:, 2] - config.plant.leader_mount[2]
    ball = flown.cg_offset / config.plant.moving_fraction
    return StandFlight(flown.time, LEVEL + rise, flown.euler[:, 0], flown.follower_command[:, 2], ball)


def draw_stand(policies: Sequence[Policy], physics: str) -> Figure:
    """Classical followers and the policies made for the stand, with both settings of the leader."""
    flown: dict[str, dict[str, StandFlight]] = {}
    for settings in SETTINGS:
        config = stand_config(settings)
        followers: list[Follower] = [*(make_baseline(name, config) for name in ("copy", "adaptive", "lqg")), *policies]
        flown[settings] = {f.name: fly_stand(config, f, f.name == "copy", physics, STAND_START) for f in followers}
    rows = [
        (
            f"{SETTINGS[settings]}, {name}",
            f"{flight.roll_rms:.2f} deg",
            *(f"{1e3 * value:.1f} mm" for value in (flight.ball_range, flight.height_peak)),
        )
        for settings, flights in flown.items()
        for name, flight in flights.items()
    ]
    caption = (
        "Height of the leader (goal dotted), roll, the follower's vertical command (its first 2 s may leave the panel) "
        "and the ball (end stops dotted): two Crazyflies on a stand that frees roll and height, a ball that rolls "
        "freely and is not measured. Left: the leader's gains and thrust law of the paper. Right: a stiffer height "
        "loop and thrust by the motors' curve. copy sees the leader's error, as in the paper, the others the object's."
    )
    heads = ("settings, follower", "roll rms", "ball range", "height off")
    return Figure("stand", "The experiment on the test stand", 7, _stand_svg(flown), caption, heads, rows)


def _stand_svg(flown: dict[str, dict[str, StandFlight]]) -> str:
    figure, axes = _panels([1.4] * 4, len(flown))
    shade = colours([name for flights in flown.values() for name in flights])
    stop = ball_limit(stand_config().plant)
    for column, (settings, flights) in zip(axes.T, flown.items(), strict=True):
        for axis, lines in zip(column, ((LEVEL,), (0.0,), (), (-stop, stop)), strict=True):
            for value in lines:
                axis.axhline(value, color="black", linestyle=":", linewidth=1)
        for name, flight in flights.items():
            rows = _thinned(len(flight.time))
            curves = flight.height, np.degrees(flight.roll), flight.vertical, flight.ball
            for axis, curve in zip(column, curves, strict=True):
                axis.plot(flight.time[rows], curve[rows], color=shade[name], linewidth=1.1, label=name)
        late = np.concatenate([flight.vertical[flight.time >= 2.0] for flight in flights.values()])
        column[2].set_ylim(*(1.15 * limit for limit in (min(late.min(), -0.01), max(late.max(), 0.01))))
        column[0].set_title(SETTINGS[settings])
        column[-1].set_xlabel("time [s]")
    labels = ("leader height [m]", "roll [deg]", "follower az [m/s²]", "ball [m]")
    for axis, label in zip(axes[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    _legend(figure, axes[0])
    return as_svg(figure)


# --- shared ----------------------------------------------------------------------------------------------------------


def _panels(heights: Sequence[float], columns: int = 1) -> tuple[Any, np.ndarray]:
    """A figure with panels (rows, columns) of `heights` [in] over one time axis."""
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


def _draw_position(axes: Iterable[Any], results: Sequence[Result], styles: Sequence[dict[str, Any]]) -> None:
    """x, y, z of O over time into three panels, the goal dotted."""
    for k, axis in enumerate(axes):
        first = results[0].flight
        axis.plot(first.time, first.target[:, k], color="black", linestyle=":", linewidth=1)
        for result, style in zip(results, styles, strict=True):
            rows = _thinned(len(result.flight.time))
            axis.plot(result.flight.time[rows], result.flight.position[rows, k], linewidth=1.1, **style)
        axis.set_ylabel(f"{'xyz'[k]} [m]")


def _legend(figure: Any, axes: Iterable[Any]) -> None:
    """One legend above the panels with every label of `axes`, each once."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles, loc="outside upper center", ncol=4, frameon=False)


def _thinned(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, POINTS).astype(int))


def _reward_kind(policy: Policy) -> str | None:
    trained = policy.card.get("config")
    reward = trained.get("reward") if isinstance(trained, dict) else None
    return reward.get("kind") if isinstance(reward, dict) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
