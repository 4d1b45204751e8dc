"""Followers of the user's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjxball.baselines import Stay
from mjxball.config import preset
from mjxball.control.followers import Baseline
from mjxball.errors import InputError
from mjxball.evaluate.followers import follower_factory
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

SOURCE = """
import numpy as np

class Writes:
    def __init__(self, config): pass
    def reset(self): pass
    def __call__(self, observation):
        observation[...] = 7.0
        observation.shape = (-1,)
        return np.zeros((observation.size // 18, 3))
class Natural(Writes):
    def __call__(self, observation):
        return observation[12:15][0]
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_followers.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)


def test_what_it_writes_to_its_observation_stays_with_it(own: None) -> None:
    follower = follower_factory("own_followers:Writes", "--followers")[1](preset("transport"))
    observation = np.linspace(0.0, 1.0, 36).reshape(2, 18)
    kept = observation.copy()
    assert follower(observation).shape == (2, 3)
    np.testing.assert_array_equal(observation, kept)


def test_what_it_raises_has_a_line_and_a_shape(own: None) -> None:
    follower = follower_factory("own_followers:Natural", "--followers")[1](preset("transport"))
    said = r"IndexError: .*, in own_followers.py line 13, given observations of shape \(2, 18\)"
    with pytest.raises(InputError, match=said):
        follower(np.zeros((2, 18)))


def test_a_controller_that_hides_that_it_needs_the_true_cg_gets_zeros() -> None:
    class Sly(Stay):
        needs_privileged = False

    class Honest(Stay):
        needs_privileged = True

    config = preset("paper")
    sly, honest = Baseline(Sly(config), config), Baseline(Honest(config), config)
    for follower in (sly, honest):
        simulate(config, follower, Scenario(seconds=0.1, mass=0.3), "newton-euler")
    assert honest.privileged.total_mass == pytest.approx(2.3)
    assert (sly.privileged.believed_mass, sly.privileged.moment, sly.privileged.total_mass) == (0.3, 0.0, 0.0)
    assert (sly.privileged.moment_acceleration, sly.privileged.thrust) == (0.0, None)
