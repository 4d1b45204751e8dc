"""Figures and pictures of teams: every follower's commands, the CG's two coordinates, drones in the rendered frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjxball.baselines import make_baseline
from mjxball.config import preset, with_plant
from mjxball.evaluate import plots
from mjxball.evaluate.render import frames
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.plotting import pyplot
from mjxball.sim.scenario import CIRCLE, Scenario

TEAM = with_plant(preset("paper"), "team3")


@pytest.fixture(scope="module")
def flown() -> list[Result]:
    scenario = Scenario(mass=0.3, path=CIRCLE, omega=2.0, seconds=1.0)
    return fly_scenarios(TEAM, [make_baseline(name, TEAM) for name in ("copy", "adaptive")], [scenario], "newton-euler")


def test_commands_are_of_every_follower(flown: list[Result]) -> None:
    flight = flown[1].flight
    for index in range(3):
        found = plots.of_followers(flight, index)
        np.testing.assert_array_equal(found, [flight.follower_command[:, k, index] for k in (0, 1)])


def test_a_figure_has_a_line_for_each_follower_and_coordinate(
    flown: list[Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[list[np.ndarray]] = []
    plt = pyplot()

    def keep(figure: Any) -> None:
        drawn.extend([line.get_ydata() for line in panel.lines] for panel in figure.axes)

    monkeypatch.setattr(plt, "close", keep)
    plots.plot_flights(flown, "title", tmp_path / "figure.png")
    monkeypatch.undo()
    plt.close("all")
    kinds = [kind for kind, _, _ in plots.PANELS]
    offset, commands = drawn[kinds.index("cg_offset")], drawn[kinds.index("command")]
    assert len(offset) == 2  # the same in both flights
    np.testing.assert_array_equal(offset[1], flown[0].flight.cg_offset[:, 1])
    assert len(commands) == 2 * (2 + 1)  # of both results, two followers and their leader
    np.testing.assert_allclose(commands[1], np.degrees(flown[0].flight.follower_command[:, 1, 0]))
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_rendered_frame_shows_all_drones(flown: list[Result]) -> None:
    """Red of the leader once, blue of the two followers, nothing of them at the picture's edge."""
    flight, row = flown[1].flight, slice(49, 51)
    arrays = {
        "time": flight.time[row],
        "position": flight.position[None, row],
        "quaternion": flight.quaternion[None, row],
        "offset": flight.cg_offset[None, row],
        "goal": flight.position[None, row],
    }
    try:
        picture = np.asarray(next(frames([TEAM.plant], ["adaptive"], arrays))).astype(int)
    except RuntimeError as error:
        pytest.skip(f"no GL library: {error}")
    red = (picture[..., 0] > 150) & (picture[..., 1] < 100) & (picture[..., 2] < 100)
    blue = (picture[..., 2] > 150) & (picture[..., 0] < 100) & (picture[..., 1] < 130)
    assert red.sum() > 50
    assert blue.sum() > red.sum()
    edge = np.ones(picture.shape[:2], bool)
    edge[8:-8, 8:-8] = False
    assert not ((red | blue) & edge).any()
