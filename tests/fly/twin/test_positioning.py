"""The twin's positioning systems against published figures."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from mjxball import config as configs
from mjxball.errors import InputError
from mjxfly.positioning import system_of
from mjxfly.twin.conditions import DELIVERED, Conditions, Surroundings, add_twin_options, surroundings
from mjxfly.twin.coupled import CoupledPair
from mjxfly.twin.drone import TwinDrone
from mjxfly.twin.positioning import Lighthouse, Loco

TICK = 0.005  # [s]


def resting(system: str, seconds: float, around: Surroundings | None = None) -> np.ndarray:
    """(T, 2, 3) errors of both drones' estimated positions [m] on the ground, once they have settled for 3 s."""
    config = configs.preset("flight")
    around = around or Surroundings(positioning=system, seed=2)
    pair = CoupledPair(config, Conditions(config.plant.object_mass), DELIVERED, around)
    states = [pair.advance(np.zeros((2, 4)), TICK) for _ in range(round((3 + seconds) / TICK))]
    return np.array([state.report.position - state.position for state in states[round(3 / TICK) :]])


def test_an_estimate_on_loco_moves_as_bitcraze_measured() -> None:
    """At rest, TWR, four places: 7 to 20 mm, 7 to 10 mm, 5 to 16 mm along x, y, z; errors of 3 to 16 cm sideways.

    The noise is fitted to these: it is no independent check of the model, but notices a change of it.
    """
    errors = resting("loco", 5.0)
    moved = errors.std(axis=0)
    assert moved.min() > 5e-3
    assert moved.max() < 20e-3
    assert 0.01 < np.linalg.norm(errors.mean(axis=0)[:, :2], axis=1).max() < 0.2


def test_an_estimate_on_lighthouse_moves_as_in_the_public_data() -> None:
    """At rest 0.1 to 2 mm (lh2_kalman_jitter 00, 01); the world is distorted by a percent."""
    errors = resting("lighthouse", 4.0)
    assert errors.std(axis=0).min() > 0.1e-3
    assert errors.std(axis=0).max() < 2e-3
    exact = resting("lighthouse", 1.0, Surroundings(positioning="lighthouse", noise=0.0))
    assert np.abs(exact).max() < 1e-4


def test_lighthouse_is_blind_as_often_as_in_the_public_flights() -> None:
    """1.2 gaps of more than 50 ms a second, 17 % of the time; a tenth of them longer than 250 ms."""
    deck = Lighthouse(Surroundings(seed=3), 0)
    seen = np.array([step for step in range(300_000) if deck.due(step)])
    gaps = np.diff(seen)[np.diff(seen) > 50]
    assert len(gaps) / 300 == pytest.approx(1.2, rel=0.25)
    assert gaps.sum() / 300_000 == pytest.approx(0.18, abs=0.05)
    assert 0.05 < (gaps > 250).mean() < 0.25


def test_both_drones_see_one_distorted_world() -> None:
    one, other = (Loco(Surroundings(seed=5), drone) for drone in range(2))
    np.testing.assert_array_equal(one._bias, other._bias)
    assert one._bias.std() == pytest.approx(Loco.BIAS, rel=0.6)


def test_flow_measures_heights_and_ways_but_no_place() -> None:
    """On the ground the place stays where the filter began, whatever the truth; its variance stays at the start's."""
    config = configs.preset("flight")
    around = Surroundings(positioning="flow", noise=0.0)
    pair = CoupledPair(config, Conditions(config.plant.object_mass), DELIVERED, around)
    for drone in range(2):
        pair.set_parameter(drone, "kalman.initialX", 0.5)
        pair.set_parameter(drone, "kalman.resetEstimation", 1.0)
    for _ in range(600):
        state = pair.advance(np.zeros((2, 4)), TICK)
    np.testing.assert_allclose(state.report.position[:, 0], 0.5, atol=0.02)
    np.testing.assert_allclose(state.report.position[:, 2], state.position[:, 2], atol=0.01)
    assert state.report.variance[:, 0].min() > 50
    assert state.report.variance[:, 2].max() < 1e-3


@pytest.mark.parametrize("system", ["mocap", "lighthouse", "loco", "flow"])
def test_a_drone_lists_the_deck_that_it_has(system: str) -> None:
    config = configs.preset("flight")
    around = Surroundings(positioning=system)
    drone = TwinDrone(CoupledPair(config, Conditions(config.plant.object_mass), DELIVERED, around), 0)
    assert system_of(drone.peer.values.defaults).name.lower() == {"mocap": "unknown"}.get(system, system)


@pytest.mark.parametrize("flags", ["--twin-deck no", "--twin-pose-hz 50"])
def test_what_is_motion_captures_alone_is_refused(flags: str) -> None:
    parser = argparse.ArgumentParser()
    add_twin_options(parser)
    with pytest.raises(InputError, match="for --twin-positioning mocap, not loco"):
        surroundings(parser.parse_args(["--twin-positioning", "loco", *flags.split()]))
    assert surroundings(parser.parse_args(["--twin-positioning", "loco"])).positioning == "loco"
