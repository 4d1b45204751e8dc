"""Flights in virtual time on the coupled twin: delays, several flights of the same drones, the truth about landing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fly_policies import untrained

from mjxball import config as configs
from mjxball.physics.step import start_state
from mjxball.policy import Policy
from mjxfly import packets
from mjxfly.controller import FlightController
from mjxfly.limits import FlightSettings
from mjxfly.policy_setup import goal_of, variants
from mjxfly.supervisor import FlightState
from mjxfly.twin.conditions import Conditions, Surroundings, drone_kind
from virtual_twin import VirtualTwin

pytest.importorskip("mujoco")


def policy_of(preset: str) -> Policy:
    return Policy(untrained(preset), preset)


def settings_of(policy: Policy, seconds: float) -> FlightSettings:
    return FlightSettings(seconds=seconds, goal=goal_of(FlightController(policy).config))


def zeros(world: VirtualTwin, seconds: float) -> None:
    """Both drones are sent zeros, for as long as they count as flying."""
    for _ in range(round(seconds / 0.05)):
        for link in world.links:
            link.send(packets.setpoint_packet(packets.ZERO))
        world.advance(0.05)


@pytest.mark.parametrize("delay", [0.0, 0.01])
def test_setpoints_and_states_are_late_by_the_links_delay(delay: float) -> None:
    policy = policy_of("flight")
    world = VirtualTwin(policy, surroundings=Surroundings(delay=delay))
    world.advance(0.2)
    states = [record for record in world.log.records if record["kind"] == "state"]
    stamps = [int.from_bytes(bytes.fromhex(record["raw"])[1:4], "little") / 1000 for record in states]
    ages = np.array([record["t"] for record in states]) - stamps
    np.testing.assert_allclose(ages, delay, atol=1.1e-3)  # stamps have whole milliseconds
    world.links[0].send(packets.setpoint_packet(packets.ZERO))
    sent = world.now
    world.advance(0.05)
    assert world.drones[0].firmware.commander.time == pytest.approx(sent + delay, abs=1e-9)


@pytest.mark.slow
def test_two_flights_of_the_same_drones_and_how_they_touch_down() -> None:
    policy = policy_of("flight")
    world = VirtualTwin(policy, settings_of(policy, 2.0), kind=drone_kind(curve="older"), settle=0.5, checks=True)
    for number in range(2):
        if number:
            world.next_flight(pause=1.0, settle=0.5)
        world.track.clear()
        assert world.run() == "done"
        assert max(moment.position[2] for moment in world.track) > 0.2
        assert 0.05 < world.touchdown_speed() < 0.8  # the goal sinks at 0.25 m/s
        zeros(world, 2.6)
    assert not any(drone.firmware.locked for drone in world.drones)


def test_a_pair_that_locked_itself_is_refused() -> None:
    policy = policy_of("flight")
    world = VirtualTwin(policy, settings_of(policy, 1.0), kind=drone_kind(curve="older"), settle=0.5, checks=True)
    world.fly_until(FlightState.FLY)
    world.advance(4.0)  # the laptop is silent
    assert all(drone.firmware.locked for drone in world.drones)
    world.next_flight(pause=0.0, settle=0.5)
    assert world.run() == "done"
    assert "arm" not in world.log.transitions()[3:]


def test_maps_convert_a_cards_hover_to_the_drones_curve() -> None:
    """firmware.md: the stand's 46 000 of the older curve is 50 562 of the linear one."""
    leader, _ = variants(FlightController(policy_of("stand")).config)
    older, linear = leader["older"].map, leader["linear"].map
    assert older.hover == pytest.approx(46000, abs=3)  # 50 568 is rounded
    force = older.curve.force(older.hover)
    assert linear.curve.force(linear.hover) == pytest.approx(force, rel=1e-6)
    assert linear.hover == pytest.approx(50562, rel=0.01)
    rise = [one.curve.force(one.hover + one.per_acceleration) - force for one in (older, linear)]
    assert rise[0] == pytest.approx(rise[1], rel=0.02)  # the older curve is not straight


def test_a_stand_that_starts_in_the_air_with_its_ball_anywhere() -> None:
    config = configs.preset("stand")
    policy = policy_of("stand")
    conditions = dataclasses.replace(Conditions.of(config), ball=-0.03)
    world = VirtualTwin(policy, settings_of(policy, 1.0), kind=drone_kind(curve="older"), conditions=conditions)
    vectors = ([0.0, 0.0, 0.08], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    mass = np.float64(conditions.object_mass)
    world.start_in_air(start_state(config, *map(np.array, vectors), mass, np.float64(-0.03)))
    assert world.flight.supervisor.state is FlightState.FLY
    world.fly_for(0.05)
    np.testing.assert_allclose([moment.position[2] for moment in world.track], 0.08, atol=5e-3)
    assert world.track[0].ball == pytest.approx(-0.03 * config.plant.moving_fraction, abs=2e-3)
    assert world.running() == [True, True]
    assert all(drone.firmware.info & packets.FLYING for drone in world.drones)
