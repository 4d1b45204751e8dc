"""Aborts in virtual time: every kind of fault, at either drone, brings both down in the way the table says."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from fly_virtual import VirtualTwin, thrusts
from tables import weekly

from mjxball.policy import Policy, shipped_policy
from mjxfly.limits import FlightSettings, Times
from mjxfly.packets import THRUST_CEILING
from mjxfly.supervisor import Event, FlightState
from mjxfly.twin.conditions import FAULT_KINDS
from virtual_twin import MemoryLog
from virtual_twin import VirtualTwin as CoupledTwin


def silence_down(world: VirtualTwin, number: int) -> None:
    world.fault_link(number, silent_down=True)


def silence_up(world: VirtualTwin, number: int) -> None:
    world.fault_link(number, silent_up=True)


def silence(world: VirtualTwin, number: int) -> None:
    world.fault_link(number, silent_up=True, silent_down=True)


def frozen(world: VirtualTwin, number: int) -> None:
    world.fault_drone(number, frozen=True)


def clock(world: VirtualTwin, number: int) -> None:
    world.fault_drone(number, clock_stopped=True)


def slow(world: VirtualTwin, number: int) -> None:
    world.fault_link(number, delay=0.25)


def jump(world: VirtualTwin, number: int) -> None:
    world.fault_drone(number, offset=(0.0, 0.0, 0.4))


def away(world: VirtualTwin, number: int) -> None:
    for drone in range(2):
        world.fault_drone(drone, offset=(3.0, 0.0, 0.0))


def empty(world: VirtualTwin, number: int) -> None:
    for step in range(1, 15):  # slowly: one that drops at once is about to carry nothing
        world.fault_drone(number, battery=-0.05 * step)
        world.fly_for(0.3)


def crash(world: VirtualTwin, number: int) -> None:
    world.drones[number].firmware.supervisor.crash()


def reboot(world: VirtualTwin, number: int) -> None:
    world.drones[number].reboot()


def lost(world: VirtualTwin, number: int) -> None:
    world.links[number].lost = "dongle unplugged"


def stuck(world: VirtualTwin, number: int) -> None:
    world.links[number].stuck = 0.5


def broken_policy(world: VirtualTwin, number: int) -> None:
    world.flight.controller.policy.reset()
    world.flight.controller.policy._biases[-1][:] = math.nan


def interrupt(world: VirtualTwin, number: int) -> None:
    world.flight.interrupts = 1


def kill(world: VirtualTwin, number: int) -> None:
    world.flight.kill = True


# What is done, whether at one drone or both, the event it shows as, the first state of the abort.
FAULTS: dict[Callable[[VirtualTwin, int], None], tuple[Event | None, str]] = {
    silence_down: (Event.STALE, "hold"),
    silence: (Event.STALE, "hold"),
    slow: (Event.STALE, "hold"),
    clock: (Event.STALE, "hold"),
    reboot: (Event.STALE, "hold"),
    lost: (Event.LINK_LOST, "hold"),
    stuck: (Event.LINK_LOST, "hold"),
    jump: (Event.ESTIMATOR, "descend"),
    crash: (Event.DRONE_DOWN, "stop"),
    away: (Event.ESTIMATOR, "descend"),
    broken_policy: (Event.BAD_STATE, "descend"),
    empty: (Event.BATTERY, "land"),
    interrupt: (None, "land"),
    kill: (Event.KEY_KILL, "kill"),
}
QUICK = Times(arm=0.1, ramp=0.5, stop=0.2)
SECONDS = 8.0
SAFE_WITHIN = 9.0  # [s] battery_time 5, then LAND; all others are far below


FIRST = (lost, jump, crash, interrupt, kill)  # one of each way to end
LIKE = (slow, clock, reboot, stuck)  # end as others do
# Every other fault at one drone, alternately; at both weekly.
AT = [
    pytest.param(fault, number, marks=marks, id=f"{fault.__name__}-{number}")
    for index, fault in enumerate(FAULTS)
    for number in (0, 1)
    for marks in [
        pytest.mark.release if index % 2 != number or fault in LIKE else () if fault in FIRST else pytest.mark.slow
    ]
]


@pytest.mark.parametrize(("fault", "number"), AT)
def test_any_fault_brings_both_down(fault: Callable[[VirtualTwin, int], None], number: int) -> None:
    event, first = FAULTS[fault]
    world = VirtualTwin(FlightSettings(seconds=SECONDS + 10, times=QUICK))
    world.fly_until(FlightState.FLY)
    world.fly_for(1.0)
    fault(world, number)
    world.fly_for(SECONDS + SAFE_WITHIN)
    assert world.flight.supervisor.state is FlightState.DONE
    assert world.log.transitions()[4] == first
    cause = world.flight.supervisor.cause
    assert (cause.event if cause else None) is event
    world.advance(2.5)  # beyond the firmware's own watchdog
    assert world.running() == [False, False]
    assert world.state.position[:, 2].max() < 0.35  # on the ground; the stick has a length, the drones none
    for drone in range(2):
        assert thrusts(world, drone)[-1][1] == 0  # high thrust is never the last command
        assert max(thrust for _, thrust in thrusts(world, drone)) <= THRUST_CEILING


@pytest.mark.parametrize("fault", [silence, lost, silence_up], ids=lambda fault: fault.__name__)
@pytest.mark.parametrize("number", [0, *weekly(1)])
def test_the_drone_that_is_heard_stays_level_with_the_lost_one(
    fault: Callable[[VirtualTwin, int], None], number: int
) -> None:
    world = VirtualTwin(FlightSettings(seconds=20.0))
    world.fly_until(FlightState.FLY)
    world.fly_for(2.5)
    fault(world, number)
    if fault is silence_up:
        world.fault_link(number, silent_up=True, silent_down=True)
    began = world.now
    world.fly_until(FlightState.STOP)
    # The firmware of the lost drone stops it 2 s after its last setpoint; the other must not have stopped long before.
    assert world.now - began == pytest.approx(2.0, abs=0.15)
    tilt = [world.state.quaternion[0, 1], world.state.quaternion[0, 2]]
    assert 2 * np.abs(tilt).max() < math.radians(20)


@pytest.mark.parametrize("number", [0, *weekly(1)])
def test_a_drone_without_power_does_not_keep_the_other_one_up(number: int) -> None:
    world = VirtualTwin(FlightSettings(seconds=20.0, times=QUICK))
    world.fly_until(FlightState.FLY)
    world.fly_for(2.0)
    silence(world, number)
    world.drones[number].firmware.dead = True
    began = world.now
    world.fly_until(FlightState.STOP)
    # It cannot be told from one that only is not heard, but for the stick that tips: 100 ms to miss it, then its fall.
    assert world.now - began < 0.6
    assert world.log.transitions()[4:6] == ["hold", "stop"]
    world.fly_until(FlightState.DONE)
    assert world.running() == [False, False]


@pytest.mark.slow
def test_a_drone_that_hears_nothing_but_is_heard_is_found_by_what_it_acts_on() -> None:
    world = VirtualTwin(FlightSettings(seconds=20.0))
    world.fly_until(FlightState.FLY)
    world.fly_for(1.0)
    silence_up(world, 1)
    began = world.now
    world.fly_until(FlightState.HOLD)
    # Four packets of 50 ms must show a thrust that stands still and was not sent for 0.1 s; its motors stop after 2 s.
    assert world.now - began < 0.35
    assert world.flight.supervisor.cause.event is Event.UNHEARD
    world.fly_until(FlightState.STOP)
    assert world.now - began == pytest.approx(2.0, abs=0.1)
    world.fly_until(FlightState.DONE)
    world.advance(2.5)
    assert world.running() == [False, False]


@pytest.mark.parametrize("seconds", [0.4, *weekly(0.11)])
def test_a_gap_in_the_states_is_flown_through(seconds: float) -> None:
    world = VirtualTwin(FlightSettings(seconds=6.0))
    world.fly_until(FlightState.FLY)
    world.fly_for(2.0)
    for number in range(2):
        world.fault_link(number, silent_down=True)
    world.fly_for(seconds)
    for number in range(2):
        world.fault_link(number, silent_down=False)
    world.fly_until(FlightState.DONE)
    assert world.log.transitions() == ["arm", "spin", "ramp", "fly", "hold", "fly", "land", "stop", "done"]
    assert world.flight.supervisor.cause is None
    assert world.flight.lifted


@pytest.mark.parametrize("state", [FlightState.FLY, *weekly(FlightState.RAMP, FlightState.LAND)])
def test_a_link_that_is_almost_dead_ends_the_flight(state: FlightState) -> None:
    """States that come and go must not let hold and descent take turns for ever."""
    world = VirtualTwin(FlightSettings(seconds=1.0))
    world.fly_until(state)
    world.fly_for(0.5)
    for number in range(2):
        world.fault_link(number, loss=0.95)
    world.fly_for(15.0)
    assert world.flight.supervisor.state is FlightState.DONE
    world.advance(2.5)
    assert world.running() == [False, False]


@pytest.mark.slow
def test_states_that_break_off_again_and_again_end_the_flight() -> None:
    world = VirtualTwin(FlightSettings(seconds=60.0))
    world.fly_until(FlightState.FLY)
    for _ in range(world.flight.settings.limits.gaps + 1):
        world.fly_for(0.5)
        silence_down(world, 1)
        world.fly_for(0.15)
        world.fault_link(1, silent_down=False)
    world.fly_until(FlightState.LAND)
    world.fly_until(FlightState.DONE)
    assert world.flight.supervisor.cause.event is Event.GAPS


def test_a_frozen_estimator_is_found() -> None:
    world = VirtualTwin(FlightSettings(seconds=20.0, goal=(0.8, 0.5, 0.8)))
    world.fly_until(FlightState.FLY)
    world.fly_for(0.4)
    frozen(world, 0)
    world.fly_until(FlightState.DONE)
    assert world.flight.supervisor.cause is not None
    assert world.running() == [False, False]


def test_poses_that_stand_still_in_the_ramp_end_it_on_the_ground() -> None:
    """Its thrust follows the measured height: it rose to 3 m while none was measured, and fell at 5.8 m/s."""
    pytest.importorskip("mujoco")
    policy = Policy.load(shipped_policy("flight"))
    world = CoupledTwin(policy, FlightSettings(seconds=5.0), log=MemoryLog(False), settle=1.0)
    world.fly_until(FlightState.RAMP)
    world.fly_for(0.2)
    for drone in world.drones:
        drone.inject(FAULT_KINDS["pose-frozen"].what)
    world.run(15.0)
    assert world.flight.supervisor.cause.event is Event.ESTIMATOR
    assert max(moment.position[2] for moment in world.track) - world.rest < 0.005
    assert world.running() == [False, False]


def test_a_pair_that_never_acted_on_a_thrust_is_held_for_the_whole_time_of_its_watchdogs() -> None:
    """Nobody knows when it heard the last one: that raised an error, and locked both drones."""
    world = VirtualTwin(FlightSettings(seconds=5.0))
    for watch in world.flight._monitor.uplinks:
        watch.sent = lambda thrust, now: None
    world.fly_until(FlightState.HOLD)
    began = world.now
    world.fly_until(FlightState.STOP)
    assert world.flight.supervisor.cause.event is Event.UNHEARD
    assert 0.2 < world.now - began <= world.flight.settings.times.drone_watchdog + 0.02
    world.fly_until(FlightState.DONE)
    assert [drone.firmware.locked for drone in world.drones] == [False, False]
