"""Followers of the user's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.evaluate.followers import follower_factory

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
