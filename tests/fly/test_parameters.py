"""Gains and other parameters from files: what would not fly is refused, by the loop that it closes."""

from __future__ import annotations

import pytest

from mjxball.control.crazyflie import PARAMETERS, Gains, pair_gains
from mjxball.errors import InputError
from mjxball.policy import Policy, shipped_policy
from mjxfly.controller import FlightController
from mjxfly.parameters import check_parameters
from mjxfly.policy_setup import load_policy, variants


def refused(name: str, leader: Gains, follower: Gains) -> str:
    """Why the shipped policy `name` does not fly with these, empty if it does."""
    config = FlightController(Policy(load_policy(shipped_policy(name)), name)).config
    try:
        check_parameters(config, list(variants(config)[0]), (leader, follower), "gains.json")
    except InputError as error:
        return str(error)
    return ""


def own(name: str) -> tuple[Gains, Gains]:
    """The metadata's gains."""
    return pair_gains(FlightController(Policy(load_policy(shipped_policy(name)), name)).config.autopilot)


@pytest.mark.parametrize("name", ["flight", "stand", "universal"])
def test_gains_far_from_those_of_the_training_are_refused(name: str) -> None:
    """Zeros, 1e30 and a wrong sign passed all checks and flew: 2.3 m/s at the ground."""
    leader, follower = own(name)
    assert not refused(name, leader, follower)
    for factor, flies in ((0.0, False), (-1.0, False), (1e30, False), (0.1, False), (0.5, True), (4.0, False)):
        for scaled in ((factor, factor), (factor, 1.0), (1.0, factor)):
            shares = zip(own(name), scaled, strict=True)
            gains = [{key: share * value for key, value in one.items()} for one, share in shares]
            assert bool(refused(name, *gains)) != flies, (factor, scaled)


def test_one_gain_suffices() -> None:
    for parameter in PARAMETERS:
        for value in (-1e-3, 1e30, 1e5):
            assert refused("flight", {}, {parameter: value}), (parameter, value)
        if parameter.endswith("_kp"):
            assert "leader" in refused("flight", {parameter: 0.0}, {})


def test_other_parameters_are_those_of_the_positioning() -> None:
    for parameter, value, good in (
        ("kalman.pNAcc_xy", 0.5, True),
        ("kalman.pNAcc_xy", 0.0, False),
        ("locSrv.extPosStdDev", 1e30, False),
        ("kalman.initialX", 0.0, False),
        ("stabilizer.stop", 1.0, False),
        ("pid_rate.rpFiltFreq", 1.0, False),
    ):
        assert bool(refused("flight", {parameter: value}, {})) is not good, parameter


def test_a_policy_of_another_rig_is_held_against_one_drone_alone() -> None:
    assert not refused("balance-sac", {"pid_attitude.roll_kp": 4.5, "pid_rate.roll_kd": 3.0}, {})
    assert refused("balance-sac", {}, {"pid_attitude.roll_kp": 0.0})
