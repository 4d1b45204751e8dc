"""Eigenvalues about hover against what is known of the classical followers."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import stability
from batch import controller_of
from mjxball.baselines import make_baseline
from mjxball.cli import plant_setup
from mjxball.config import Config, preset
from mjxball.evaluate.policies import load_policy
from mjxball.policy.file import shipped_policy
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import Scenario
from stability import AWAY, delay_margins, linearised_hovers, of_rig

CASES = [(0.0, 0.2, 0.2), (0.1, 0.2, 0.2), (0.05, 0.4, 0.4)]
UNIVERSAL, TEAM = shipped_policy("universal"), plant_setup(Path("team6"))
MISTAKEN = (0.0, 0.25, 0.2)  # the hover thrust believes 0.2 kg


@pytest.fixture(scope="module")
def paper() -> Config:
    return preset("paper")


@pytest.mark.slow
def test_copy_hovers_where_the_closed_form_says_and_decays_as_its_pd_law(paper: Config) -> None:
    """x = (g / kp) m c g / (2 Kp_theta); slowest mode s^2 + kd s + kp, a little faster for the attitude loop's lag.

    Of a mass that is not believed each drone holds half: z = dm g / (2 m^ kp), m^ what one drone believes to lift.
    """
    *known, mistaken = linearised_hovers(paper, controller_of(make_baseline("copy", paper)), [*CASES, MISTAKEN])
    for (offset, mass, _), hover in zip(CASES, known, strict=True):
        sway = 9.81 / 0.5 * mass * offset * 9.81 / (2 * 3.2196)
        assert hover.error == pytest.approx(sway, rel=1e-3, abs=1e-9)
        assert hover.residual < 1e-12
        assert hover.stable
        assert math.log(hover.radius) / 0.02 == pytest.approx(-0.5, rel=0.03)
    assert mistaken.error == pytest.approx(0.05 * 9.81 / (2 * 1.1 * 0.5), rel=1e-3)


@pytest.mark.release
def test_delay_margin_is_where_flights_begin_to_grow(paper: Config) -> None:
    """The hover of `lqg` with the CG at O bears a delay of two control steps and not of three."""
    lqg, margin = make_baseline("lqg", paper), 2
    hovers = [linearised_hovers(paper, controller_of(lqg), CASES[:1], delay)[0] for delay in (margin, margin + 1)]
    assert [hover.stable for hover in hovers] == [True, False]
    still = {"amplitude": 0.0, "goal": (0.0, 0.0, 0.0), "start_position": (0.001, 0.0, 0.0)}
    delays = [0.02 * margin, 0.02 * (margin + 1)]
    scenarios = [Scenario(**still, disturbance=Disturbance(delay=delay)) for delay in delays]
    errors = np.abs(simulate_batch(paper, [(lqg, scenarios)], "newton-euler").error[:, :, 0])
    late = errors[-500:].max(axis=0)
    assert late[0] < 0.0005
    assert late[1] > 0.01


def test_the_margin_of_a_case_is_the_last_delay_before_its_first_unstable_one(
    paper: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of four cases, one of which is never stable, and one stable again later."""
    stable = [(1, 1, 0, 0), (0, 0, 0, 0), (1, 0, 1, 1), (1, 1, 1, 0)]
    asked = []

    def hovers(config: Config, controller: Any, cases: Any, delay: int) -> list[SimpleNamespace]:
        asked.append(delay)
        return [SimpleNamespace(stable=bool(row[delay])) for row in stable[: len(cases)]]

    monkeypatch.setattr(stability, "linearised_hovers", hovers)
    controller = controller_of(make_baseline("lqg", paper))
    assert delay_margins(paper, controller, [CASES[0]] * 4, longest=3) == [1, -1, 0, 2]
    assert delay_margins(paper, controller, CASES[:1], longest=3) == [1]
    assert asked == [0, 1, 2, 3, 0, 1, 2]  # no further than the first delay that nobody bears


@pytest.mark.release
def test_the_hover_of_a_team_with_delay_is_where_it_flies_to() -> None:
    (row,) = (row for row in of_rig(UNIVERSAL, "team6", TEAM) if (row["offset"], row["delay"]) == (AWAY, 0.04))
    start = {"goal": (0.0, 0.0, 0.0), "omega": 0.0, "phase": np.pi / 2, "amplitude": AWAY}
    scenario = Scenario(**start, seconds=60.0, disturbance=Disturbance(delay=0.04))
    error = simulate_batch(TEAM, [(load_policy(UNIVERSAL, TEAM), [scenario])], "newton-euler").error[-1, 0]
    assert row["stable"]
    assert np.linalg.norm(error) == pytest.approx(row["error"], abs=1e-5)
