"""The picture of a training run: return and accuracy over environment steps (the paper's Fig. 2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.train.members import read_members
from mjxball.train.reading import read_rows
from mjxball.train.record import METRICS

PANELS = {
    "task": (("steady_error", "eval_steady_error", "steady-state error [m]"),),
    "paper": (
        (None, "eval_tilt_error", "roll and pitch off the leader's [rad rms]"),
        (None, "eval_vertical_error", "vertical command off the leader's [m/s² rms]"),
    ),
}
BLUE, GREY = "#1b6ca8", "#9a9a9a"


def told_by_the_run(run: Path, seed: int) -> dict[str, Any]:
    """What a policy's card says of the run directory `run` so far: its `curve` and the `seconds` it has taken.

    Raises InputError if its tables are damaged.
    """
    try:
        rows = _rows(run)
        return {"curve": training_curve(run, seed), "seconds": round(float(rows[-1]["seconds"])) if rows else 0}
    except (KeyError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{run / METRICS} holds something else than the numbers of a run") from None


def training_curve(run: Path, seed: int) -> dict[str, list[float]]:
    """What a policy's card says of its training: environment steps, returns of an episode exploring and evaluated.

    In a population `episode_return` is the median over all members, `eval_return` the own one of member `seed`.
    """
    rows = _rows(run)
    curve: dict[str, list[float]] = {
        "steps": [int(row["steps"]) for row in rows],
        "episode_return": [round(float(row["episode_return"]), 3) for row in rows],
    }
    own: list[Any] = [row for row in read_members(run) if row["seed"] == seed]
    evaluated: list[Any] = own or [row for row in rows if row["eval_return"]]
    curve["eval_steps"] = [int(row["steps"]) for row in evaluated]
    curve["eval_return"] = [round(float(row["eval_return"]), 3) for row in evaluated]
    return curve


def _rows(run: Path) -> list[dict[str, str]]:
    return read_rows(run / METRICS)


def draw_training(run: Path, config: Config, path: Path) -> None:
    """Draw `metrics.csv` of the directory `run` to `path`, whose directory is made."""
    from mjxball.plotting import pyplot

    rows = _rows(run)

    def column(name: str) -> tuple[np.ndarray, np.ndarray]:
        kept = [(int(row["steps"]), float(row[name])) for row in rows if row[name]]
        return np.array([k for k, _ in kept]), np.array([v for _, v in kept])

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
            axis.plot(*column(exploring), color=GREY, linewidth=1, label="exploring")
        axis.plot(*column(evaluated), color=BLUE, marker="o", markersize=3.5, label="evaluated, deterministic")
        axis.set_ylabel(label, fontsize="small")
        axis.grid(alpha=0.25)
    for axis in axes[1:]:
        if (column(below[0][1])[1] > 0).any():
            axis.set_yscale("log")
    if config.reward.kind == "paper":
        axes[0].axhline(0.0, color="black", linestyle=":", linewidth=1, label="optimum: copy the leader")
    axes[0].legend(fontsize="small")
    axes[-1].set_xlabel("environment steps")
    figure.suptitle(f"training of preset {config.preset}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
