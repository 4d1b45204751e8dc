"""Flights of both Crazyflie presets on the coupled model, in virtual time: controllers, gains, thrust."""

from __future__ import annotations

import numpy as np
import pytest
from fly_policies import untrained
from fly_virtual import VirtualTwin
from hypothesis import given
from hypothesis import strategies as st

from mjxball import config as configs
from mjxball.control import crazyflie, rotations
from mjxball.errors import InputError
from mjxball.plant import plant_parameters
from mjxball.policy import load_file
from mjxball.policy.file import shipped_policy
from mjxfly import policy_setup
from mjxfly.limits import FlightSettings
from mjxfly.setpoints import ForceCurve, to_setpoint
from mjxfly.supervisor import FlightState
from mjxfly.twin.physics import SimplePair, make_pair

PRESETS = ("flight", "stand")
vertical = st.floats(-4, 4)
tilt = st.floats(-0.5, 0.5)


def world_of(preset: str, seconds: float) -> VirtualTwin:
    contents = untrained(preset)
    config = policy_setup.config_of(contents.metadata)
    settings = FlightSettings(seconds=seconds, goal=policy_setup.goal_of(config))
    return VirtualTwin(settings, contents=contents, physics=make_pair(contents.metadata))


@pytest.mark.slow
def test_a_free_flight_rises_stays_and_lands() -> None:
    world = world_of("flight", 5.0)
    world.fly_until(FlightState.FLY)
    world.fly_for(3.0)
    heights, tilts = [], []
    while world.flight.supervisor.state is FlightState.FLY:
        world.tick()
        heights.append(world.state.position[:, 2].mean())
        tilts.append(np.abs(rotations.euler_from_matrix(rotations.matrix_from_quaternion(world.state.quaternion[0]))))
    world.fly_until(FlightState.DONE)
    assert world.log.transitions() == ["arm", "spin", "ramp", "fly", "land", "stop", "done"]
    assert world.flight.supervisor.cause is None
    assert min(heights) > 0.3
    assert max(heights) < 0.55  # copying leaves what the CG does, but holds
    assert np.degrees(np.max(tilts)) < 8
    world.advance(1.0)
    assert np.abs(world.state.position[:, 2]).max() < 1e-3
    assert world.running() == [False, False]


@pytest.mark.slow
def test_the_papers_stand_lifts_off_rolls_and_comes_down() -> None:
    world = world_of("stand", 3.0)
    world.fly_until(FlightState.FLY)
    world.fly_for(2.9)
    there = world.state.position
    assert (there[:, :1] == 0).all()
    assert there[:, 2].mean() > 0.005  # the paper's gains and its thrust scale let height drift
    world.fly_until(FlightState.DONE, 40.0)
    assert world.log.transitions()[-2:] == ["stop", "done"]
    assert world.flight.supervisor.cause is None
    world.advance(1.0)
    assert np.abs(world.state.position[:, 2]).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_the_leader_flies_the_cards_law(preset: str) -> None:
    config = policy_setup.config_of(untrained(preset).metadata)
    assert config == configs.preset(preset)
    world = world_of(preset, 2.0)
    world.fly_until(FlightState.FLY)
    world.fly_for(1.0)
    commands = world.flight._commands
    own = preset == "stand"  # e_l of the leader's own place feels the roll, e_o does not
    lead = config.leader.integral_lead_time
    error = commands.observation[14] + lead * commands.observation[17]
    integrated = world.flight.controller._integral[2] - world.flight.controller.period * error  # before it
    lift = config.leader.kp[2] * commands.observation[14] + config.leader.kd[2] * commands.observation[17]
    assert (abs(commands.leader[2] - lift - config.leader.ki[2] * integrated) > 1e-3) == own
    # The network says nothing: the follower's command is the PD controller on what it observes.
    limit = config.command.vertical_limit
    assert commands.follower[2] == pytest.approx(np.clip(lift, -limit, limit), abs=1e-5)


@given(st.sampled_from(PRESETS), tilt, tilt, vertical)
def test_what_is_sent_is_what_was_simulated(preset: str, roll: float, pitch: float, lift: float) -> None:
    config = configs.preset(preset)
    constants = plant_parameters(config.plant, config.attitude)
    carried = constants.drone_mass + constants.load_share * config.plant.object_mass
    command = np.array([[roll, pitch, lift]] * 2)
    expected = crazyflie.setpoints(config.autopilot, command, carried, config.plant.gravity)
    for row, known in zip(expected, policy_setup.command_maps(config), strict=True):
        sent = to_setpoint(command[0], known).setpoint
        np.testing.assert_allclose(sent[:3], row[:3], atol=1e-9)
        assert abs(sent.thrust - row[3]) <= 1  # a cut of tilt comes before the thrust there as here; rounding


def test_flags_overrule_the_card() -> None:
    config = configs.preset("stand")
    leader, _ = policy_setup.command_maps(config)
    assert (leader.thrust_model, leader.hover, leader.curve) == ("paper", 50568.0, ForceCurve(0.0, 0.12))
    assert leader.carried_mass == pytest.approx(0.0755 / 2)
    leader, follower = policy_setup.command_maps(config, policy_setup.ThrustOptions("calibrated", 45000.0, None, 0.08))
    assert (leader.thrust_model, leader.hover, leader.curve) == ("calibrated", 45000.0, ForceCurve(0.0, 0.12))
    assert leader.carried_mass + follower.carried_mass == pytest.approx(0.08)


def test_policies_of_other_plants_keep_their_defaults() -> None:
    contents = load_file(shipped_policy("transport-large"))
    config = policy_setup.config_of(contents.metadata)
    assert not policy_setup.is_crazyflie(config)
    assert policy_setup.gains_of(config) == ({}, {})
    assert policy_setup.command_maps(config)[0].carried_mass == pytest.approx(policy_setup.UNKNOWN_MASS / 2)
    assert isinstance(make_pair(contents.metadata), SimplePair)
    broken = {**contents.metadata, "config": {**contents.metadata["config"], "autopilot": {"kind": "magic"}}}
    with pytest.raises(InputError):
        policy_setup.config_of(broken)
