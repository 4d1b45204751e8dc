"""The pair's integrals, what a stand locks, and what the leader measures: one closed loop for simulation and flight."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from tables import rows

from mjxball.config import Config, apply_overrides, preset
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.sim.controllers import BodyState, Controllers
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
PERIOD = 0.01


def body(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), euler=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0)) -> BodyState:
    return BodyState(
        np.array(position, float),
        np.array(velocity, float),
        rotations.quaternion_from_euler(np.array(euler, float)),
        np.array(rates, float),
    )


def started(config: Config) -> tuple[Controllers, np.ndarray]:
    loop = Controllers(config)
    return loop, np.zeros(3)


class TestIntegral:
    def test_height_does_not_wind_up_on_a_way_at_the_pace_that_the_lead_foresees(self) -> None:
        """The error is integrated with its rate: on e' = -e / lead nothing is."""
        config = preset("flight")
        loop, integral = started(config)
        for number in range(500):
            error = 0.2 * math.exp(-number * PERIOD / config.leader.integral_lead_time)
            state = body((0.0, 0.0, -error), (0.0, 0.0, error / config.leader.integral_lead_time))
            integral = loop.integrate(integral, state, np.zeros(3), PERIOD)
        assert abs(integral[2]) < 1e-9


class TestStand:
    def test_neither_law_is_fed_what_the_stand_locks(self) -> None:
        """An estimator that invents 23 mm and 165 mm/s across, pitch and yaw: nothing of it is seen or commanded."""
        config = preset("stand")
        goal = np.array([0.0, 0.0, 0.08])
        true = body((0.0, 0.0, 0.05), (0.0, 0.0, 0.02), (0.03, 0.0, 0.0), (0.1, 0.0, 0.0))
        felt = body((0.023, -0.023, 0.05), (0.165, 0.1, 0.02), (0.03, 0.01, 0.5), (0.1, 0.05, 0.2))
        loop, integral = started(config)
        np.testing.assert_allclose(loop.observe(felt, goal), loop.observe(true, goal), atol=1e-12)
        for state in (true, felt):
            integral = loop.integrate(integral, state, goal, PERIOD)
        leader_command = loop.leader_command(felt, goal, integral)
        np.testing.assert_allclose(leader_command, loop.leader_command(true, goal, integral), atol=1e-12)
        assert leader_command[0] == leader_command[1] == 0
        locked = [0, 1, 4, 5, 6, 7, 10, 11, 12, 13, 15, 16]
        seen = loop.observe(felt, goal)
        assert not seen[locked].any()
        assert np.abs(np.delete(seen, locked)).min() > 0
        of_leader = Controllers(apply_overrides(config, {"follower.error": "leader"}))
        assert not of_leader.observe(felt, goal)[locked].any()

    def test_in_free_flight_everything_is_seen(self) -> None:
        felt = body((0.023, -0.023, 0.05), (0.165, 0.1, 0.02), (0.03, 0.01, 0.5), (0.1, 0.05, 0.2))
        assert np.abs(Controllers(preset("flight")).observe(felt, np.ones(3))).min() > 0


@pytest.mark.parametrize("error", ["object", "leader"])
def test_an_observation_tells_the_body_that_it_was_made_of(error: str) -> None:
    loop = Controllers(apply_overrides(preset("flight"), {"follower.error": error}))
    goal = np.array([0.3, -0.2, 0.4])
    state = body((0.1, 0.2, 0.3), (0.1, -0.2, 0.05), (0.05, -0.03, 0.4), (0.3, 0.2, -0.1))
    again = loop.body_from_observation(loop.observe(state, goal), goal)
    for name in ("position", "velocity", "rates"):
        np.testing.assert_allclose(getattr(again, name), getattr(state, name), atol=1e-12)
    turned = rotations.matrix_from_quaternion(again.quaternion)
    np.testing.assert_allclose(turned, rotations.matrix_from_quaternion(state.quaternion), atol=1e-12)


NO_COMMANDS = {
    "what is masked": (np.ma.masked_less(np.zeros((1, 3)), 1.0), "some are masked"),
    "complex numbers": (np.zeros((1, 3), complex), "not complex128"),
    "words": ([["0.1"] * 3], "not <U3"),
    "truths": (np.ones((1, 3), bool), "not bool"),
    "nothing": (None, "not object"),
    "of no flight": (np.zeros(3), "answered shape (3,) where (1, 3) was wanted"),
    "of two flights": (np.zeros((2, 3)), "answered shape (2, 3) where (1, 3) was wanted"),
}


@rows("answer, named", NO_COMMANDS.values())
def test_an_answer_that_is_no_command_is_refused(answer: Any, named: str) -> None:
    """A follower that is no more than a function of one's own; NumPy would make commands of the first ones."""

    class Own:
        def reset(self) -> None: ...

        def __call__(self, observation: np.ndarray) -> Any:
            return answer

    with pytest.raises(InputError, match=rf"follower Own .*{re.escape(named)}"):
        simulate(preset("paper"), Own(), Scenario(seconds=1.0), "newton-euler")
