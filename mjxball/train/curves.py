"""Learning curves of a run: `members.csv` of a population, and figures of return and error over environment steps."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.files import MissingFileError
from mjxball.train.events import Events, Point, Session, tags
from mjxball.train.run_directory import METRICS, read_metrics, read_rows, write_rows

LOG = "members.csv"
POLICIES = "members"
COLUMNS = ("steps", "seed", "eval_return")  # then the environment's metrics of an evaluation


class MemberLog:
    """`members.csv` of a run, with one row per member and evaluation, and the same values in TensorBoard's files.

    Without `out` nothing is written.
    """

    def __init__(self, out: Path | None, sessions: Sequence[Session] = (), seed: int = 0, resumed_at: int = 0):
        """`sessions`: one for each member. Rows after `resumed_at` steps are dropped."""
        self._out, self._sessions, self._seed = out, sessions, seed
        self._rows = [row for row in read_members(out) if row["steps"] <= resumed_at] if out else []
        self._at: dict[float, float] = {}  # environment steps -> time of the evaluation [s]
        self._write_events()

    def add(self, steps: int, results: Mapping[str, np.ndarray]) -> None:
        """Append the `results` of one evaluation, arrays (members,) by column."""
        for member, values in enumerate(zip(*results.values(), strict=True)):
            named = dict(zip(results, map(float, values), strict=True))
            self._rows.append({"steps": steps, "seed": self._seed + member, **named})
        if self._out is None:
            return
        write_rows(self._out / LOG, list(self._rows[-1]), self._rows)
        self._at[steps] = time.time()
        self._write_events()

    def _write_events(self) -> None:
        """Rewrite every member's run in TensorBoard: thousands of files cannot stay open."""
        if self._out is None:
            return
        for member, session in enumerate(self._sessions):
            rows = [row for row in self._rows if row["seed"] == self._seed + member]
            named = tags((), (), [name.removeprefix("eval_") for name in (rows[-1] if rows else {}) if "eval_" in name])
            points = [Point(int(row["steps"]), row, self._at.get(row["steps"], time.time())) for row in rows]
            Events(self._out, session, named, points).close()

    def best(self) -> int:
        """Index of the member with the highest return at the last evaluation; 0 before the first."""
        return best_member(self._rows)

    def policy_path(self, member: int) -> Path:
        """Policy file of a member. RuntimeError in a process that does not write the run."""
        if self._out is None:
            raise RuntimeError("this process writes no policies")
        directory = self._out / POLICIES
        directory.mkdir(exist_ok=True)
        return directory / f"seed{self._seed + member}.npz"


def read_members(run: Path) -> list[dict[str, float]]:
    """Rows of a run's `members.csv`; none without the file. InputError if it is damaged."""
    try:
        texts = read_rows(run / LOG)
    except MissingFileError:
        return []
    try:
        rows = [{name: float(row[name]) for name in {**dict.fromkeys(COLUMNS), **row}} for row in texts]
        return [{**row, "steps": int(row["steps"]), "seed": int(row["seed"])} for row in rows]
    except (KeyError, ValueError, OverflowError):
        raise InputError(f"{run / LOG} holds something else than the numbers of a population") from None


def best_member(rows: list[dict[str, float]]) -> int:
    """Index of the member with the highest finite return among the last evaluation's rows; 0 if there are none."""
    last = [row for row in rows if row["steps"] == rows[-1]["steps"]]
    returns = [row["eval_return"] if np.isfinite(row["eval_return"]) else -np.inf for row in last]
    return int(np.argmax(returns)) if returns else 0


def plot_members(run: Path, path: Path) -> None:
    """Figure of all members over training: steady-state error and return of each, with median and quartiles."""
    from mjxball.plotting import BLUE, INK, legend_above, logarithmic, pyplot, save

    rows = read_members(run)
    steps = sorted({row["steps"] for row in rows})
    plt = pyplot()
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 7), constrained_layout=True)
    labels = (("eval_steady_error", "steady-state error [m]"), ("eval_return", "return of an episode"))
    for axis, (name, label) in zip(axes, labels, strict=True):
        table = np.array([[row[name] for row in rows if row["steps"] == step] for step in steps])
        axis.plot(steps, table, ".-", color=INK, alpha=0.5, linewidth=0.8)  # markers show a single evaluation too
        if (known := np.isfinite(table).any(axis=1)).any():  # short episodes have no steady state
            at, (low, middle, high) = np.array(steps)[known], np.nanpercentile(table[known], [25, 50, 75], axis=1)
            axis.fill_between(at, low, high, color=BLUE, alpha=0.25, label="quartiles")
            axis.plot(at, middle, ".-", color=BLUE, linewidth=2, label="median")
        axis.set_ylabel(label)
        axis.grid()
    if any(row["eval_steady_error"] > 0 for row in rows):
        logarithmic(axes[0])
    axes[1].set_xlabel("environment steps of each member")
    legend_above(figure, axes, title=f"{table.shape[1]} followers")
    save(figure, path)


PANELS = {
    "task": (("steady_error", "eval_steady_error", "steady-state error [m]"),),
    "paper": (
        (None, "eval_tilt_error", "roll and pitch off\nthe leader's [rad rms]"),
        (None, "eval_vertical_error", "vertical command off\nthe leader's [m/s² rms]"),
    ),
}


def training_summary(run: Path, seed: int) -> dict[str, Any]:
    """Metadata for the policy of member `seed`: the `curve` of the run so far and the `seconds` it has taken.

    Raises InputError if the run's tables are damaged.
    """
    try:
        rows = _rows(run)
        return {"curve": training_curve(run, seed), "seconds": round(float(rows[-1]["seconds"])) if rows else 0}
    except (KeyError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{run / METRICS} holds something else than the numbers of a run") from None


def training_curve(run: Path, seed: int) -> dict[str, list[float]]:
    """Learning curve for a policy's metadata: environment steps, and returns of an episode exploring and evaluated.

    In a population `episode_return` is the median over all members, `eval_return` that of the member with `seed`.
    """
    rows = _rows(run)
    curve: dict[str, list[float]] = {
        "steps": [int(row["steps"]) for row in rows],
        "episode_return": [round(float(row["episode_return"]), 3) for row in rows],
    }
    of_member: list[Any] = [row for row in read_members(run) if row["seed"] == seed]
    evaluated: list[Any] = of_member or [row for row in rows if row["eval_return"]]
    curve["eval_steps"] = [int(row["steps"]) for row in evaluated]
    curve["eval_return"] = [round(float(row["eval_return"]), 3) for row in evaluated]
    return curve


def _rows(run: Path) -> list[dict[str, str]]:
    return read_metrics(run / METRICS)


def plot_training(run: Path, config: Config, path: Path) -> None:
    """Plot `metrics.csv` of the directory `run` to `path`, whose directory is created."""
    from mjxball.plotting import BLUE, INK, legend_above, logarithmic, pyplot, save

    rows = _rows(run)

    def column(name: str) -> tuple[np.ndarray, np.ndarray]:
        points = [(int(row["steps"]), float(row[name])) for row in rows if row[name]]
        return np.array([steps for steps, _ in points]), np.array([value for _, value in points])

    known = set(rows[0]) if rows else set()
    below = tuple(panel for panel in PANELS[config.reward.kind] if {name for name in panel[:2] if name} <= known)
    plt = pyplot()
    size = (8, 3 + 2.2 * len(below))
    figure, grid = plt.subplots(1 + len(below), 1, sharex=True, figsize=size, constrained_layout=True, squeeze=False)
    axes = grid[:, 0]
    for axis, (exploring, evaluated, label) in zip(
        axes, (("episode_return", "eval_return", "return of an episode"), *below), strict=True
    ):
        if exploring:
            axis.plot(*column(exploring), color=INK, alpha=0.7, linewidth=1, label="exploring")
        axis.plot(
            *column(evaluated), color=BLUE, marker="o", markersize=3.5, clip_on=False, label="evaluated, deterministic"
        )
        axis.set_ylabel(label, fontsize="small")
        axis.grid()
    for axis in axes[1:]:
        if (column(below[0][1])[1] > 0).any():
            logarithmic(axis)
    if config.reward.kind == "paper":
        axes[0].axhline(0.0, color=INK, linestyle=":", linewidth=1, label="optimum: copy the leader")
    axes[-1].set_xlabel("environment steps")
    legend_above(figure, axes, title=f"training of preset {config.preset}")
    path.parent.mkdir(parents=True, exist_ok=True)
    save(figure, path)
