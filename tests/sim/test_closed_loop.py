"""The pair's integrals, what a stand locks, and what the leader measures: one closed loop for simulation and flight."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from tables import rows

from mjxball.config import PRESETS, Config, apply_overrides, preset
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.sim.controllers import MAX_LIFT_DIFFERENCE, WASHOUT_TIME, BodyState, Controllers
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
    return loop, loop.zero_integral(np.zeros(3))


class TestSharedIntegrals:
    def test_both_drones_are_told_the_leaders_whole_law(self) -> None:
        """A network that adds nothing: what the leader is told is what the follower is told, whatever has wound up."""
        config = apply_overrides(preset("flight"), {"leader.tilt_integral_gain": 0.0})
        loop, integral = started(config)
        integral = integral + np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.0, 0.0])
        state, goal = body((0.1, -0.1, 0.05), (0.02, 0.0, 0.01)), np.zeros(3)
        pd = loop.leader_command(state, goal, np.zeros(7))
        leader_command = loop.leader_command(state, goal, integral)
        follower_command = loop.follower_command(pd, integral)
        np.testing.assert_allclose(follower_command, leader_command, atol=1e-12)
        assert np.abs(leader_command - pd).max() > 0.01

    def test_a_stick_that_hangs_is_lifted_apart(self) -> None:
        """Rolled against what is asked, the drone that hangs lifts more and the other less by the same amount."""
        loop, integral = started(preset("flight"))
        hanging, goal = body(euler=(-0.02, 0.0, 0.0)), np.zeros(3)  # the leader, at +y, is low
        for _ in range(50):
            integral = loop.integrate(integral, hanging, goal, PERIOD)
        leader_command = loop.leader_command(hanging, goal, integral)[2]
        follower_command = loop.follower_command(np.zeros(3), integral)[2]
        gain = preset("flight").leader.tilt_integral_gain
        assert leader_command == pytest.approx(gain * 0.02 * 0.5, rel=1e-6)
        assert follower_command == pytest.approx(-leader_command, rel=1e-6)

    def test_lift_apart_has_a_limit(self) -> None:
        loop, integral = started(preset("flight"))
        for _ in range(5000):
            integral = loop.integrate(integral, body(euler=(-0.3, 0.0, 0.0)), np.zeros(3), PERIOD)
        assert loop.leader_command(body(), np.zeros(3), integral)[2] == pytest.approx(MAX_LIFT_DIFFERENCE, rel=1e-6)

    def test_what_a_network_adds_for_ever_is_washed_out(self) -> None:
        """5 degrees of lasting roll command: e^-1 of it is left after the time constant, 2 % after four."""
        loop, integral = started(preset("flight"))
        state, goal, added = body(), np.zeros(3), np.array([math.radians(5), 0.0, 0.0])
        for share in (1, 3):
            for _ in range(round(share * WASHOUT_TIME / PERIOD)):
                follower_command = loop.follower_command(added, integral)
                integral = loop.integrate(integral, state, goal, PERIOD, follower_command=follower_command)
            left = loop.follower_command(added, integral)[0] / added[0]
            # The washed out command itself is followed by the level integral's asked roll of 0.
            assert left == pytest.approx(math.exp(-1) if share == 1 else math.exp(-4), rel=0.02)

    def test_a_follower_with_a_law_of_its_own_shares_nothing(self) -> None:
        loop, integral = started(preset("flight"))
        state = body(euler=(-0.02, 0.0, 0.0))
        alone = loop.integrate(integral, state, np.zeros(3), PERIOD, np.zeros(1), np.ones(3))
        assert not alone[3:].any()

    def test_presets_of_the_1_kg_plant_keep_three_integrals_and_their_commands(self) -> None:
        for name in ("transport", "balance", "paper"):
            loop, integral = started(PRESETS[name])
            assert integral.shape == (3,)
            command = np.array([0.1, 0.2, 0.3])
            assert loop.follower_command(command, integral) is command

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
