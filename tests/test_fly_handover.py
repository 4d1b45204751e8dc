"""A policy that takes over in flight: no jump, and the first one comes back."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT
from fly_virtual import VirtualTwin

from mjxball.fly.handover import AWAY, BLEND, LEAST, SETTLING, Handover, HandoverMonitor, difference
from mjxball.fly.limits import FlightSettings
from mjxball.fly.supervisor import State
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import shipped_policy

NEAR = 0.01  # [m] from the goal


def pushed(contents: PolicyFile, roll: float, vertical: float = 0.0) -> PolicyFile:
    """The same policy with more of roll and vertical acceleration in its network's output."""
    bias = contents.biases[-1] + np.array([roll, 0, vertical, 0, 0, 0], np.float32)
    return dataclasses.replace(contents, biases=(*contents.biases[:-1], bias))


@pytest.fixture(scope="module")
def flown() -> PolicyFile:
    """A policy that remembers averages."""
    return load_file(shipped_policy("flight"))


@pytest.fixture
def observation() -> np.ndarray:
    return 0.02 * np.random.default_rng(0).normal(size=18)


def broken(value: float) -> Any:
    """A policy whose commands are not finite."""
    policy = Policy.load(shipped_policy("flight"))
    policy._biases[-1] = np.full_like(policy._biases[-1], value)
    return policy


def test_the_command_goes_from_one_policy_to_the_other(flown: PolicyFile, observation: np.ndarray) -> None:
    both = Handover(Policy(flown, "first"))
    alone = Policy(flown, "alone")
    before = [both(observation) for _ in range(3)]
    np.testing.assert_array_equal(before, [alone(observation) for _ in range(3)])
    second = Policy(pushed(flown, 0.5, 0.5), "second")
    both.begin(second, NEAR)
    ticks = round(BLEND / both.first.control_period)
    # The second one starts from what the first one remembers, and both go on by themselves.
    other = Policy(pushed(flown, 0.5, 0.5), "other")
    other.memory = copy.deepcopy(alone.memory)
    ends = [(alone(observation), other(observation)) for _ in range(ticks + 5)]
    commands = [both(observation) for _ in range(ticks + 5)]
    for command, (old, new) in zip(commands, ends, strict=True):
        assert (np.minimum(old, new) - 1e-9 <= command).all()
        assert (command <= np.maximum(old, new) + 1e-9).all()
    np.testing.assert_allclose(commands[ticks - 1 :], [new for _, new in ends][ticks - 1 :], atol=1e-9)
    # No step is larger than the blend's steepest share of the way, and what the policies themselves do.
    apart = max(float(np.abs(new - old).max()) for old, new in ends)
    own = max(float(np.abs(np.diff([end[k] for end in ends], axis=0)).max()) for k in (0, 1))
    assert np.abs(np.diff([before[-1], *commands], axis=0)).max() <= 1.5 / ticks * apart + 2 * own


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_command_that_is_not_finite_is_never_flown(flown: PolicyFile, observation: np.ndarray, value: float) -> None:
    both, alone = Handover(Policy(flown, "first")), Policy(flown, "alone")
    second = broken(value)
    if np.isinf(value):  # tanh bounds it: the same is broken deeper down
        second._weights[0] = np.full_like(second._weights[0], np.nan)
    both.begin(second, NEAR)
    for _ in range(80):
        np.testing.assert_array_equal(both(observation), alone(observation))
    assert "not finite" in both.returned


def test_the_first_policy_comes_back_when_the_object_goes_astray(flown: PolicyFile, observation: np.ndarray) -> None:
    both, alone = Handover(Policy(flown, "first")), Policy(flown, "alone")
    both.begin(Policy(pushed(flown, 1.0), "second"), NEAR)
    ticks = round(BLEND / both.first.control_period)
    for _ in range(2 * ticks):
        both(observation)
        alone(observation)
    assert both.share == 1.0
    shares = []
    for _ in range(ticks):
        both.check_distance(NEAR + AWAY + 0.01)
        command = both(observation)
        shares.append(both.share)
        old = alone(observation)
    assert np.all(np.diff(shares) <= 0)
    np.testing.assert_array_equal(command, old)
    assert "0.17 m from its goal" in both.returned
    # It is not tried again.
    np.testing.assert_array_equal(both(observation), alone(observation))


def test_a_new_flight_begins_with_the_first_policy(flown: PolicyFile, observation: np.ndarray) -> None:
    both = Handover(Policy(flown, "first"))
    both.begin(broken(np.nan), NEAR)
    both(observation)
    both.reset()
    assert (both.second, both.returned, both.share) == (None, "", 0.0)
    np.testing.assert_array_equal(both(observation), Policy(flown, "alone")(observation))


def test_only_a_policy_of_the_same_rig_and_laws_takes_over(flown: PolicyFile) -> None:
    first = Policy(flown, "first")
    assert difference(first, Policy(pushed(flown, 0.1), "other")) == ""
    limits = dataclasses.replace(flown, card={**flown.card, "command_limits": [0.2, 6.0]})
    assert difference(first, Policy(limits, "other")) == "command_limits"
    assert difference(first, Policy.load(TRANSPORT)) != ""


def flight(successor: Any, contents: PolicyFile) -> VirtualTwin:
    """A flight on the stand-in, in virtual time."""
    world = VirtualTwin(FlightSettings(seconds=4.0), contents=contents)
    world.flight.succession._successor = successor
    world.run()
    return world


def test_in_flight(trained: Any) -> None:
    """Sent angles do not jump, and a policy that does the same as the first changes nothing."""
    contents = trained.contents
    world = VirtualTwin(FlightSettings(seconds=4.0), contents=contents)
    calm = flight(None, contents)
    offers: list[Policy | None] = []

    def once() -> Policy | None:
        offers.append(None)
        return Policy(contents, "the same") if len(offers) == 100 else None

    same = flight(once, contents)
    assert [record for record in same.log.records if record["kind"] == "retrain"]
    sent = [[record["sent"] for record in one.log.records if record["kind"] == "tick"] for one in (calm, same)]
    np.testing.assert_allclose(*(np.array(one, float) for one in sent), atol=1e-3)
    assert same.flight.supervisor.state is State.DONE
    assert set(same.flight.succession.figures) <= {"first policy", "second policy"}
    assert world.flight.succession.figures == {}


def test_figures_are_of_two_seconds_at_least_and_show_the_motors(flown: PolicyFile) -> None:
    """Motors that give 8 % more and 8 % less are sent 7 % less and 9 % more; what is settling counts for nothing."""
    monitor = HandoverMonitor(Handover(Policy(flown, "first")), None, lambda *given, **fields: None)
    for tick in range(round(100 * (SETTLING + LEAST)) + 10):
        settled = tick >= 100 * SETTLING
        shares = (1 / 1.08, 1 / 0.92) if settled else (0.5, 0.5)
        monitor.update(10 + tick / 100, tick / 100, 0.02 if settled else 1.0, 0.01, shares)
        if tick < 100 * (SETTLING + LEAST) - 1:
            assert monitor.figures == {}
    (figures,) = monitor.figures.values()
    assert figures.error_rms == pytest.approx(0.02)
    np.testing.assert_allclose(figures.thrust, shares)
    assert "thrust -7 / +9 %" in str(figures)
