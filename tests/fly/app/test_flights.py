"""Followers on board, flown by the twin in virtual time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from onboard_bench import cores_of, needs_gcc
from tables import weekly

import fly_faults_virtual
from fly_faults_virtual import SETTLE, cause_of, code_of, settings_of
from mjxball.control import rotations
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxfly.app.protocol import AppPhase
from mjxfly.controller import FlightController
from mjxfly.supervisor import FlightState as Laptop
from mjxfly.twin import avionics
from mjxfly.twin.conditions import FAULT_KINDS, Conditions, Surroundings, drone_kind
from virtual_twin import VirtualTwin


def world(seconds: float = 6.0, curve: str = "linear", **around: Any) -> VirtualTwin:
    policy = Policy.load(shipped_policy("flight"))
    settings = settings_of(policy, seconds)
    kind, outside = drone_kind("2.1", curve), Surroundings(**around)
    return VirtualTwin(policy, settings, kind=kind, surroundings=outside, settle=SETTLE, cores=cores_of())


@needs_gcc
def test_radio_delay_does_not_matter_on_board():
    errors = []
    for delay in (0.0, 0.04):
        twin = world(seconds=5.0, delay=delay)
        twin.run()
        assert code_of(twin) == 0
        flown = [moment for moment in twin.track if moment.state == "fly"][250:]
        off = np.array([moment.position for moment in flown]) - twin.flight.goal(twin.now)
        errors.append(float(np.sqrt((off**2).sum(axis=1).mean())))
    assert max(errors) < 0.03
    assert abs(errors[1] - errors[0]) < 0.005  # other phases of the noise


@needs_gcc
def test_the_apps_land_without_a_laptop():
    twin = world()
    twin.fly_until(Laptop.FLY)
    twin.fly_for(3.0)
    height = twin.moment().position[2] - twin.rest
    assert height > 0.2
    for _ in range(400):  # no tick of the flight any more
        twin.advance(0.02)
        twin.track.append(twin.moment())
    assert twin.running() == [False, False]
    assert twin.touchdown_speed() < 0.4
    assert [drone.app.phase for drone in twin.drones if drone.app] == [AppPhase.IDLE] * 2
    assert not any(drone.firmware.locked for drone in twin.drones)


@needs_gcc
@pytest.mark.slow
@pytest.mark.parametrize("ball", [-0.06, *weekly(0.06)])
def test_a_ball_at_either_end_is_lifted_and_kept(ball: float):
    """By the clock the controller took over on the ground, and one of these never left it."""
    policy = Policy.load(shipped_policy("stand"))
    config = FlightController(policy).config
    conditions, most = replace(Conditions.of(config), ball=ball), config.plant.moving_fraction * config.plant.ball_stop
    cores = fly_faults_virtual.cores_of(shipped_policy("stand"), "float32")
    twin = VirtualTwin(policy, settings_of(policy, 8.0), conditions=conditions, settle=SETTLE, cores=cores)
    twin.run(40.0)
    assert code_of(twin) == 0
    assert twin.flight.lifted
    flown = [moment for moment in twin.track if moment.state == "fly"]
    assert max(abs(moment.ball) for moment in flown) < 0.95 * most
    assert abs(flown[-1].ball) < 0.1 * most
    assert twin.touchdown_speed() < 0.3


@needs_gcc
@pytest.mark.slow
def test_motors_that_give_less_on_one_side_do_not_push_it_away():
    """As on the laptop: 175 mm sideways where the controller began with equal thrusts."""
    twin = world(seconds=3.0, gains=(0.92, 1.08))
    twin.fly_until(Laptop.FLY)
    twin.fly_for(2.5)
    gone = np.array([moment.position for moment in twin.track])
    assert np.hypot(gone[:, 0], gone[:, 1]).max() < 0.06


@needs_gcc
@pytest.mark.slow
def test_attitudes_that_disagree_are_not_taken_for_motors_that_do(monkeypatch: pytest.MonkeyPatch):
    """Each app found another difference, 15 and -15 %: both took the pair for lighter, and it sank to the ground."""
    rolls = [rotations.quaternion_from_euler(np.array([np.radians(roll), 0.0, 0.0])) for roll in (1.5, -1.5)]
    true = avionics.OnboardComputers._attitude
    monkeypatch.setattr(
        avionics.OnboardComputers,
        "_attitude",
        lambda own, drone: rotations.multiply_quaternions(true(own, drone), rolls[drone]),
    )
    twin = world(seconds=3.0)
    twin.fly_until(Laptop.FLY)
    twin.fly_for(2.5)
    assert min(moment.position[2] for moment in twin.track if moment.state == "fly") - twin.rest > 0.04
    twin.run()
    assert code_of(twin) == 0


@needs_gcc
def test_a_low_battery_lands_both():
    """One drone finds its battery low for 5 s, without the laptop's knowledge; a moment does not count."""
    twin = world(seconds=30.0)
    twin.fly_until(Laptop.FLY)
    twin.fly_for(1.0)
    follower = twin.links[1]
    follower.write_parameters({"mjxb.battery": 4.2})
    twin.fly_for(4.0)
    follower.write_parameters({"mjxb.battery": 3.2})
    twin.fly_for(1.0)
    assert twin.flight.supervisor.state is Laptop.FLY
    follower.write_parameters({"mjxb.battery": 4.2})
    twin.fly_for(4.5)
    assert twin.flight.supervisor.state is Laptop.FLY
    twin.run()
    notes = [record for record in twin.log.records if record["kind"] == "app" and record["phase"] == "land"]
    causes = {one["drone"]: one["cause"] for one in notes}
    assert causes["follower"] == "the battery is low"
    assert causes["leader"] in ("the other drone does", "asked for by the laptop")  # whom it hears first
    assert cause_of(twin).startswith("APP_LANDS")
    assert twin.touchdown_speed() < 0.4
    assert twin.running() == [False, False]


@needs_gcc
def test_firmware_of_the_older_curve_is_flown_with_its_map():
    """The laptop finds the curve while the motors spin, and tells the apps."""
    twin = world(seconds=2.0, curve="older")
    twin.run()
    assert code_of(twin) == 0
    assert twin.flight.spin.curves == ["older"] * 2
    assert {one["refusal"] for one in twin.log.records if one["kind"] == "app"} == {"good"}


@needs_gcc
def test_why_a_flight_ended_is_what_laptop_and_apps_act_on():
    """Not what the apps see to: their thrust is none that the laptop sent."""
    twin = world(seconds=30.0)
    twin.fly_until(Laptop.FLY)
    twin.fly_for(1.0)
    twin.drones[1].inject(FAULT_KINDS["peer"].what)
    twin.run()
    told = " ".join(twin.flight.how_it_ended())
    assert "the other drone is not heard" in told
    assert "unheard" not in told
    assert "that led to" not in told

    twin = world(seconds=30.0)
    twin.fly_until(Laptop.FLY)
    twin.fly_for(1.0)
    twin.links[0].lost = "unplugged"
    twin.run()
    told = " ".join(twin.flight.how_it_ended())
    assert told.startswith("ended early: link lost: leader: unplugged")
    assert "unheard" not in told
